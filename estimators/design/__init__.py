"""From a filter's name and options to its numbers: models, noise, gains, schedules, checks.

The offline half of a filter, in NumPy: what `make_estimator` calls before the first tick.
"""
