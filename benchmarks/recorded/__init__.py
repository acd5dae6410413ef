"""Recorded drives: estimators on a log, scored where it knows the truth, and the car behind it."""
