"""What an observation contains: the name, unit and bounds of each entry."""

from collections.abc import Sequence
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from ..record import FAST, FAST_UNITS
from ..sensors.slow import SLOW


class ObservationEntry(NamedTuple):
    """One number of an observation.

    Attributes:
        name: Name of the entry.
        unit: Its unit.
        low: Lower bound, finite.
        high: Upper bound, finite.
    """

    name: str
    unit: str
    low: float
    high: float


OBSERVATION_OPTIONS = ("fast", "with_map")
"""The options of an environment that change what is observed, and nothing of a drive."""
N_SAMPLED = 6  # the first columns of a fast row are sensors; the policy sees last and mean of each
AGE_CAP = 10.0  # s

_FAST_BOUNDS = (10.0, 50.0, 50.0, 10.0, 100.0, 100.0, 1.0, 2000.0, 2000.0, 1.0, 50.0, 1.0)
_LAST_ONLY = ("steer", "torque_left", "torque_right", "steer_command")  # seen as they were last


def make_space(layout: Sequence[ObservationEntry], frames: int = 1) -> "gym.spaces.Box[np.float32]":
    """Make the space of an observation; of a stack of frames each bound is repeated in place.

    Args:
        layout: Entries of the observation.
        frames: Number of frames in the stack.

    Returns:
        A box of shape (len(layout) * frames,).
    """
    low, high = np.array([entry[2:] for entry in layout]).T.astype(np.float32)
    return gym.spaces.Box(np.repeat(low, frames), np.repeat(high, frames), dtype=np.float32)


def make_observation_layout(
    slow: tuple[str, ...], n: int, fast: str, with_map: bool = False
) -> tuple[ObservationEntry, ...]:
    """Make the entries of an observation.

    Args:
        slow: Names of the slow sensors present.
        n: Ticks of a control period.
        fast: "summary" (last sample and mean over the step) or "all" (every sample of the step).
        with_map: Whether the road's curvature is an entry.

    Returns:
        The entries in their order.
    """
    entries = []
    for column in range(N_SAMPLED):
        name, unit, bound = FAST._fields[column], FAST_UNITS[column], _FAST_BOUNDS[column]
        names = (name, f"{name}_mean") if fast == "summary" else [f"{name}_{j}" for j in range(n)]
        entries += [ObservationEntry(entry_name, unit, -bound, bound) for entry_name in names]
    for name in (*_LAST_ONLY, "curvature") if with_map else _LAST_ONLY:
        column = getattr(FAST, name)
        bound = _FAST_BOUNDS[column]
        entries.append(ObservationEntry(name, FAST_UNITS[column], -bound, bound))
    for kind in SLOW:
        if kind.name in slow:
            for value in kind.values:
                name = f"{kind.name}_{value.name}"
                entries.append(ObservationEntry(name, value.unit, -value.bound, value.bound))
            entries.append(ObservationEntry(f"{kind.name}_age", "s", 0.0, AGE_CAP))
            entries.append(ObservationEntry(f"{kind.name}_fresh", "-", 0.0, 1.0))
    entries.append(ObservationEntry("beta_ref", "rad", -1.0, 1.0))
    entries.append(ObservationEntry("gamma_ref", "rad/s", -10.0, 10.0))
    return tuple(entries)
