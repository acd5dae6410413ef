"""Wind: a gust of side force with an arm, between two ticks."""

from typing import Any, NamedTuple

from ..backend.decorators import jit
from ..backend.primitives import select


class Wind(NamedTuple):
    """A side wind between two ticks."""

    force: Any  # N, to the left
    arm: Any  # m, ahead of the centre of gravity
    start: Any
    end: Any
    height: Any = 0.0  # m, above the roll axis


@jit
def compute_wind(tick: Any, wind: Any) -> Any:
    """Compute force and moments of the wind from this tick to the next.

    Args:
        tick: Tick since the start of the episode.
        wind: `Wind`.

    Returns:
        Force (N), yaw moment and roll moment (N m).
    """
    force = select((tick >= wind.start) & (tick < wind.end), wind.force, 0.0)
    return force, force * wind.arm, 0.0 - force * wind.height
