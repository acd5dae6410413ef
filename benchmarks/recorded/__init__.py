"""Replay of recorded drives: estimators on a log, scored where the log knows the truth."""
