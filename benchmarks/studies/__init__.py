"""Suites about one question each: a file measures, tabulates and answers it."""
