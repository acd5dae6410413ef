"""What all suites share: rows of results, statistics, parallel cases, the explorer's data."""
