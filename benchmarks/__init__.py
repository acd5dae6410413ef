"""The comparisons, their tables and report, and the command line."""
