"""What an estimator adds to an observation: states, under which names, within which bounds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.layout import Entry
from .models import UNITS

BOUNDS = {
    "beta": np.pi / 2.0,
    "gamma": 10.0,
    "psi": np.pi,
    "y_l": 200.0,
    "d1": 100.0,
    "d2": 1000.0,
    "F_d": 1e5,
    "N_d": 1e5,
}
"""Estimates are clipped here, the heading is wrapped."""

_TRUE = ("beta", "gamma")  # states whose truth stands in the info


@dataclass(frozen=True)
class Outputs:
    """The entries of a wrapped observation.

    layout: all of them; the first `kept` are the inner observation's. plan, limits: as `observe`
    takes them. keys: of `info`, for beta, its standard deviation and the nees. judged: whether
    the truth of an output is known, so that there is a nees.
    """

    layout: tuple[Entry, ...]
    kept: int
    plan: npt.NDArray[np.int64]
    limits: npt.NDArray[np.float64]
    keys: tuple[str, str, str]
    judged: bool

    @property
    def bounds(self) -> Any:
        """The lowest and the highest observation, (2, width) float32."""
        return np.array([each[2:] for each in self.layout]).T.astype(np.float32)


def outputs_of(
    estimator: str,
    states: tuple[str, ...],
    outputs: Sequence[str],
    std: bool,
    name: str | None,
    inner: tuple[Entry, ...],
) -> Outputs:
    """The outputs of an estimator with these states after the entries of an inner observation.

    Raises ValueError for an output that is no state, or where names would stand twice.
    """
    for output in outputs:
        if output not in states:
            raise ValueError(f"{estimator} has no state {output!r}; it has: {', '.join(states)}")
    before = "" if name is None else f"{name}_"
    hats = [Entry(f"{before}{s}_hat", UNITS[s], -BOUNDS[s], BOUNDS[s]) for s in outputs]
    stds = [Entry(f"{before}{s}_std", UNITS[s], 0.0, BOUNDS[s]) for s in outputs]
    layout = (*inner, *hats, *(stds if std else ()))
    names = [each.name for each in layout]
    twice = sorted({each for each in names if names.count(each) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)} would stand twice; give this wrapper a name=...")
    judged = [s in _TRUE for s in outputs]
    columns = [states.index(s) for s in outputs], [s == "psi" for s in outputs], judged
    limits = np.array([BOUNDS[s] for s in outputs]).astype(np.float32).astype(np.float64)
    return Outputs(
        layout,
        len(inner),
        np.array(columns, np.int64).T.copy(),
        limits,
        (f"{before}beta_hat", f"{before}beta_std", f"{before}nees"),
        any(judged),
    )
