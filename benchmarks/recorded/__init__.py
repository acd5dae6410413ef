"""Recorded drives: estimators scored where a log has the truth, and fits of the car that drove."""
