"""Shared by all suites: rows, metrics, statistics, parallel cases, drives, the explorer's data."""
