"""Failures of an episode, by code and name."""

RUNNING, SPIN, OFF_ROAD, NOT_FINITE, BAD_ACTION = range(5)
FAILURES = ("none", "spin", "off-road", "not-finite", "bad-action")
REFUSED = -1
