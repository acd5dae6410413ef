"""Kinds of memory in the linear environments, whose optimum is known."""
