"""What an observation contains: the name, unit and bounds of each entry."""

from collections.abc import Sequence
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from ..record import FAST, FAST_UNITS
from ..sensors.slow import SLOW


class Entry(NamedTuple):
    """One number of an observation: its name, unit and finite bounds, low and high."""

    name: str
    unit: str
    low: float
    high: float


SEEN = ("fast", "with_map")
"""The options of an environment that change what is observed, and nothing of a drive."""
SAMPLED = 6  # the first columns of a fast row are sensors; the policy sees last and mean of each
AGE_CAP = 10.0  # s

_FAST_BOUNDS = (10.0, 50.0, 50.0, 10.0, 100.0, 100.0, 1.0, 2000.0, 2000.0, 1.0, 50.0, 1.0)
_LAST = ("steer", "torque_left", "torque_right", "steer_command")  # seen as they were last


def space_of(layout: Sequence[Entry], frames: int = 1) -> "gym.spaces.Box[np.float32]":
    """The space of an observation; of a stack of frames each bound is repeated in place."""
    low, high = np.array([entry[2:] for entry in layout]).T.astype(np.float32)
    return gym.spaces.Box(np.repeat(low, frames), np.repeat(high, frames), dtype=np.float32)


def observation_layout(
    slow: tuple[str, ...], n: int, fast: str, with_map: bool = False
) -> tuple[Entry, ...]:
    """The entries of an observation.

    slow: names of the slow sensors present. n: ticks of a control period. fast: "summary" (last
    sample and mean over the step) or "all" (every sample of the step). with_map: the road's
    curvature is seen.
    """
    entries = []
    for column in range(SAMPLED):
        name, unit, bound = FAST._fields[column], FAST_UNITS[column], _FAST_BOUNDS[column]
        names = (name, f"{name}_mean") if fast == "summary" else [f"{name}_{j}" for j in range(n)]
        entries += [Entry(each, unit, -bound, bound) for each in names]
    for name in (*_LAST, "curvature") if with_map else _LAST:
        column = getattr(FAST, name)
        bound = _FAST_BOUNDS[column]
        entries.append(Entry(name, FAST_UNITS[column], -bound, bound))
    for kind in SLOW:
        if kind.name in slow:
            for value in kind.values:
                name = f"{kind.name}_{value.name}"
                entries.append(Entry(name, value.unit, -value.bound, value.bound))
            entries.append(Entry(f"{kind.name}_age", "s", 0.0, AGE_CAP))
            entries.append(Entry(f"{kind.name}_fresh", "-", 0.0, 1.0))
    entries.append(Entry("beta_ref", "rad", -1.0, 1.0))
    entries.append(Entry("gamma_ref", "rad/s", -10.0, 10.0))
    return tuple(entries)
