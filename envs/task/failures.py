"""Failures of an episode, by code and name."""

from typing import Any

from ..backend.decorators import jit
from ..backend.primitives import select

RUNNING, SPIN, OFF_ROAD, NOT_FINITE, BAD_ACTION, COLLISION, DEPARTURE = range(7)
FAILURES = ("none", "spin", "off-road", "not-finite", "bad-action", "collision", "departure")
REFUSED = -1
WILD = 1 << 30
"""Added to what a step returns where an action was beyond `WILD_LIMIT`."""
WILD_LIMIT = 10.0
"""An action beyond it, a fraction of full scale, is a mistake, not a request for all of it."""


@jit
def select_failure(lost: Any, spun: Any, off: Any) -> Any:
    """Select the failure's code.

    Args:
        lost: Whether the numbers are no longer finite.
        spun: Whether the car spins.
        off: Whether it has left the road.

    Returns:
        The code, as a float; the first that applies, in this order.
    """
    failure = select(spun, SPIN * 1.0, select(off, OFF_ROAD * 1.0, RUNNING * 1.0))
    return select(lost, NOT_FINITE * 1.0, failure)
