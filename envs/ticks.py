"""Time: the base tick, whole ticks of a time in seconds, never and for ever."""

from typing import Any

from .backend.decorators import jit, plain
from .backend.primitives import floor

TICK = 0.001
"""The base tick of the simulated car in seconds."""
FOREVER = 1e15  # ticks
NEVER = -1.0


@jit
def whole_ticks(seconds: Any) -> Any:
    """Whole ticks of a time in seconds."""
    return floor(seconds / TICK + 0.5)


_whole_ticks = plain(whole_ticks)


def ticks(seconds: float) -> float:
    """`whole_ticks` without the compiler."""
    return float(_whole_ticks(seconds))
