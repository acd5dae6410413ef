"""Failures of an episode, by code and name."""

from typing import Any

from ..backend.decorators import jit
from ..backend.primitives import select

RUNNING, SPIN, OFF_ROAD, NOT_FINITE, BAD_ACTION, COLLISION, DEPARTURE = range(7)
FAILURES = ("none", "spin", "off-road", "not-finite", "bad-action", "collision", "departure")
REFUSED = -1


@jit
def failure_of(seen: Any) -> Any:
    """The failure's code, as a float, from what is `lost`, `spun` or `off` (`engine.tick.Seen`)."""
    failure = select(seen.spun, SPIN * 1.0, select(seen.off, OFF_ROAD * 1.0, RUNNING * 1.0))
    return select(seen.lost, NOT_FINITE * 1.0, failure)
