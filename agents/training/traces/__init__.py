"""Demonstrations for students, and moving averages: by torch, and as observations of an env."""
