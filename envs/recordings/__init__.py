"""Recorded drives: logs read from CSV and Parquet files into the record of a drive."""
