"""Time: the base tick, whole ticks of a time in seconds, never and for ever."""

from typing import Any

from .backend.decorators import jit
from .backend.primitives import floor

TICK = 0.001
"""The base tick of the simulated car in seconds."""
FOREVER = 1e15  # ticks


@jit
def whole_ticks(seconds: Any) -> Any:
    """Whole ticks of a time in seconds."""
    return floor(seconds / TICK + 0.5)


NEVER = -1.0


def ticks(seconds: float) -> float:
    """Whole ticks of a time in seconds."""
    return float(round(seconds / TICK))
