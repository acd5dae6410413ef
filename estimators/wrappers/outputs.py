"""What an estimator adds to an observation: states, under which names, within which bounds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.task.observation import Entry
from ..design.models import UNITS

BOUNDS = {
    "beta": np.pi / 2.0,
    "gamma": 10.0,
    "psi": np.pi,
    "y_l": 200.0,
    "psi_late": np.pi,
    "y_l_late": 200.0,
    "v_x": 100.0,
    "v_y": 100.0,
    "phi": np.pi / 2.0,
    "phi_rate": 10.0,
    "F_yf": 1e5,
    "F_yr": 1e5,
    "d1": 100.0,
    "d2": 1000.0,
    "d3": 100.0,
    "d": 1000.0,
    "F_d": 1e5,
    "N_d": 1e5,
}
"""Estimates are clipped here, headings are wrapped."""

TRUTHS = {"beta": 1, "gamma": 2}  # states whose truth stands in the info
BETA, STD, NEES = 0, 1, 2  # places of what `observe` says
_WRAPPED = ("psi", "psi_late")


@dataclass(frozen=True)
class Outputs:
    """The entries of a wrapped observation.

    layout: all of them; the first `kept` are the inner observation's. plan, limits: as `observe`
    takes them. keys: of `info`, each with its place in what `observe` said: beta and its standard
    deviation where the filter estimates it, the nees where the truth of an output is known.
    """

    layout: tuple[Entry, ...]
    kept: int
    plan: npt.NDArray[np.int64]
    limits: npt.NDArray[np.float64]
    keys: tuple[tuple[str, int], ...]

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
    truths = [TRUTHS.get(s, 0) for s in outputs]
    columns = [states.index(s) for s in outputs], [s in _WRAPPED for s in outputs], truths
    keys = [("beta_hat", BETA), ("beta_std", STD)] if states[0] == "beta" else []
    keys += [("nees", NEES)] if any(truths) else []
    return Outputs(
        layout,
        len(inner),
        np.array(columns, np.int64).T.copy(),
        np.array([BOUNDS[s] for s in outputs]).astype(np.float32).astype(np.float64),
        tuple((before + key, place) for key, place in keys),
    )
