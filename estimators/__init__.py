"""Sideslip estimators: filters for fast, slow and late sensors."""
