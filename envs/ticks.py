"""Time in ticks: the base tick, conversion from seconds, and the values of never and for ever."""

from .numerics.jit import as_python, jit
from .numerics.primitives import Scalar, floor

TICK = 0.001
"""The base tick of the simulated car in seconds."""
FOREVER = 1e15  # ticks
NEVER = -1.0


@jit
def round_to_ticks(seconds: Scalar) -> Scalar:
    """Round a time in seconds to whole ticks.

    Args:
        seconds: The time (s).
    """
    return floor(seconds / TICK + 0.5)


_round_to_ticks = as_python(round_to_ticks)


def count_ticks(seconds: float) -> float:
    """Round a time in seconds to whole ticks, without the compiler.

    Args:
        seconds: The time (s).
    """
    return float(_round_to_ticks(seconds))
