"""Drives that students learn from, and running means that they remember with: by torch, and as
observations of an env."""
