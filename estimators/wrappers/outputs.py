"""States of an estimator as entries of an observation: names, units, bounds, and their values."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import as_python
from ...envs.numerics.primitives import ARRAYS
from ...envs.record import Array
from ...envs.task import ObservationEntry
from ..design.models import FOREIGN_STATE, STATES
from ..protocol import EstimatorLike, compute_std

TRUTHS = {"beta": 1, "gamma": 2}  # code of each state whose truth `observe` gets; 0: none
BETA, STD, NEES = 0, 1, 2  # places in the summary of a step
_WRAPPED = ("psi", "psi_late")  # angles that are wrapped to +-pi
_wrap = as_python(wrap, ARRAYS)


@dataclass(frozen=True)
class Outputs:
    """The entries of a wrapped observation."""

    layout: tuple[ObservationEntry, ...]  # the first `inner` are the inner observation's
    inner: int
    # of each output the state's index, 1 to wrap an angle, the code in `TRUTHS`; (m, 3)
    plan: npt.NDArray[np.int64]
    limits: npt.NDArray[np.float64]  # bounds of the outputs in their units, (m,)
    keys: tuple[tuple[str, int], ...]  # keys of `info`, with their places in the summary


def make_outputs(
    estimator: str,
    states: tuple[str, ...],
    outputs: Sequence[str],
    std: bool,
    name: str | None,
    inner: tuple[ObservationEntry, ...],
) -> Outputs:
    """Make the outputs of an estimator behind the entries of an inner observation.

    Args:
        estimator: Name of the estimator for messages.
        states: Names of its states.
        outputs: States to append.
        std: Whether standard deviations are appended.
        name: Prefix of all names, or None.
        inner: Entries of the inner observation.

    Returns:
        The entries, and how `observe` writes them.

    Raises:
        ValueError: An output is no state, or names would stand twice.
    """
    for output in outputs:
        if output not in states:
            raise ValueError(f"{estimator} has no state {output!r}; it has: {', '.join(states)}")
    prefix = "" if name is None else f"{name}_"
    kinds = [STATES.get(s, FOREIGN_STATE) for s in outputs]
    layout = list(inner)
    for ending, low in (("hat", -1.0), ("std", 0.0)) if std else (("hat", -1.0),):
        for s, (unit, _, bound) in zip(outputs, kinds, strict=True):
            layout.append(ObservationEntry(f"{prefix}{s}_{ending}", unit, low * bound, bound))
    names = [entry.name for entry in layout]
    duplicates = sorted({entry for entry in names if names.count(entry) > 1})
    if duplicates:
        raise ValueError(f"{', '.join(duplicates)} would stand twice; give this wrapper a name=...")
    truths = [TRUTHS.get(s, 0) for s in outputs]
    columns = [states.index(s) for s in outputs], [s in _WRAPPED for s in outputs], truths
    keys = [("beta_hat", BETA), ("beta_std", STD)] if "beta" in states else []
    keys += [("nees", NEES)] if any(truths) else []
    return Outputs(
        tuple(layout),
        len(inner),
        np.array(columns, np.int64).T.copy(),
        np.array([kind.bound for kind in kinds]).astype(np.float32).astype(np.float64),
        tuple((prefix + key, place) for key, place in keys),
    )


def write_outputs(
    estimator: EstimatorLike,
    obs: npt.NDArray[np.float32],
    inner: int,
    plan: npt.NDArray[np.int64],
    limits: Array,
    beta: float,
    gamma: float,
    out: npt.NDArray[np.float32],
    summary: Array,
) -> None:
    """Write a user's estimates as `kernel.observe` writes those of a compiled filter.

    Raises what `ForeignEstimator.x` raises.

    Args:
        estimator: The user's estimator.
        obs: Observation of the env, shape (at least inner,).
        inner: Number of entries of `obs` to copy.
        plan: Of each output the state's index, 1 to wrap an angle, its code in `TRUTHS`; (m, 3).
        limits: Bounds of the outputs in their units, shape (m,).
        beta: True sideslip angle (rad).
        gamma: True yaw rate (rad/s).
        out: Output, shape (inner + m,), or (inner + 2 m,) with standard deviations.
        summary: Output, shape (3,): beta (the first state where there is no beta), its standard
            deviation, and the normalised estimation error squared of the outputs beta and gamma
            per state, e' P_e^-1 e / len(e), with expectation 1; 0 where P_e is singular.
    """
    x, P = np.asarray(estimator.x), np.asarray(estimator.P)
    std, states, m = compute_std(P), plan[:, 0], len(plan)
    out[:inner] = obs[:inner]
    with np.errstate(invalid="ignore"):
        values = np.where(plan[:, 1] == 1, _wrap(x[states]), x[states])
    out[inner : inner + m] = np.clip(values, -limits, limits)
    if len(out) > inner + m:
        out[inner + m :] = np.clip(std[states], -limits, limits)
    first = estimator.names.index("beta") if "beta" in estimator.names else 0
    truth_plan = plan[plan[:, 2] > 0]
    e = x[truth_plan[:, 0]] - np.where(truth_plan[:, 2] == 1, beta, gamma)
    P_e = P[np.ix_(truth_plan[:, 0], truth_plan[:, 0])]
    nees = e @ np.linalg.solve(P_e, e) / len(e) if len(e) and np.linalg.det(P_e) > 0.0 else 0.0
    summary[:] = x[first], std[first], nees
