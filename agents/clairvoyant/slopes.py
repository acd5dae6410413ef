"""Slopes of an episode along a run: the plant's and the cost's, for every control period."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from ...envs.backend.decorators import plain
from ...envs.backend.primitives import ARRAYS
from ...envs.vehicle.actuators import within_stop
from .foresight import Fixed, Forecast, Known, State
from .plant import advance, carried, node_cost, node_errors, scales

Array = npt.NDArray[np.float64]

INPUTS = 2  # in a sweep: share of the moment and of the steering, which may be held at zero


@dataclass(frozen=True)
class Trajectory:
    """States (K + 1, len(State)) at the start of every period and at the end, actions (K, width)
    as shares of full scale."""

    states: Array
    actions: Array


class Slopes(NamedTuple):
    """Of n = len(names) + INPUTS variables, the states in their scales, then the inputs.

    F: (K, len(names), n), of the state after each period. g, H: (K + 1, n), (K + 1, n, n),
    gradient of the cost and Gauss and Newton's Hessian; the last are of the episode's end.
    """

    F: Array
    g: Array
    H: Array


class Limits(NamedTuple):
    """Of the inputs in every period: (K, INPUTS) low and high; (K,) the steering's again where its
    rate ends, with how much of it a unit of the state at `column` moves."""

    low: Array
    high: Array
    rate_low: Array
    rate_high: Array
    column: int
    slope: float


@dataclass(frozen=True)
class Problem:
    """What is the same in every episode with the same Fixed."""

    fixed: Fixed
    names: tuple[str, ...]
    scale: Array
    slopes: Any  # of CasADi, for all nodes at once

    @property
    def at(self) -> list[int]:
        """Where the carried states stand in a State."""
        return [State._fields.index(name) for name in self.names]


@functools.lru_cache(maxsize=8)
def problem_of(fixed: Fixed) -> Problem:
    """The functions, cached for each of the newest few kinds of episode."""
    names = carried(fixed)
    scale, size = np.array(scales(fixed, names)), len(names)
    w, known = ca.SX.sym("w", size + fixed.width), ca.SX.sym("known", len(Known._fields))
    zero = State(*(0.0,) * len(State._fields))
    x = zero._replace(**{name: scale[i] * w[i] for i, name in enumerate(names)})
    each = Known(*ca.vertsplit(known))
    step = advance(fixed, x, ca.vertsplit(w[size:]), each)
    after = ca.vertcat(*(getattr(step.state, name) for name in names)) / scale
    e, errors = ca.SX.sym("e", 2), ca.vertcat(*node_errors(fixed, x, each))
    curve, pull = ca.hessian(node_cost(fixed, (e[0], e[1]), each), e)
    slope = ca.jacobian(errors, w)
    work_curve, work_pull = ca.hessian(step.effort, w)  # a sum of squares of nearly linear terms
    gradient = slope.T @ ca.substitute(pull, e, errors) + work_pull
    hessian = slope.T @ curve @ slope + work_curve
    node = ca.Function(
        "node", [w, known], [ca.jacobian(after, w), gradient, hessian], {"cse": True}
    )
    return Problem(fixed, names, scale, node.map(fixed.periods + 1))


def slopes_along(problem: Problem, known: Array, run: Trajectory) -> Slopes:
    """Of every period of a run; an input that the action lacks has none but its own square."""
    size, K, width = len(problem.names), problem.fixed.periods, problem.fixed.width
    at = np.zeros((size + width, K + 1))
    at[:size] = (run.states[:, problem.at] / problem.scale).T
    at[size:, :K] = run.actions.T
    some, n = size + width, size + INPUTS
    F, g, H = (np.nan_to_num(value.full()) for value in problem.slopes(at, known))
    made = Slopes(np.zeros((K, size, n)), np.zeros((K + 1, n)), np.tile(np.eye(n), (K + 1, 1, 1)))
    made.F[:, :, :some] = F.reshape(size, K + 1, some).transpose(1, 0, 2)[:K]
    made.g[:, :some] = g.T
    made.H[:, :some, :some] = H.reshape(some, K + 1, some).transpose(1, 0, 2)
    return made


def limits_along(problem: Problem, forecast: Forecast, run: Trajectory) -> Limits:
    """Full scale, the stop of the wheels, and the steering's rate from where it stands in a run."""
    fixed, K = problem.fixed, problem.fixed.periods
    low, high, zero = np.zeros((K, INPUTS)), np.zeros((K, INPUTS)), np.zeros(K)
    low[:, : fixed.width], high[:, : fixed.width] = -1.0, 1.0
    if fixed.width < INPUTS:
        return Limits(low, high, zero, zero, 0, 0.0)
    task, column = fixed.task, problem.names.index("slewing")
    inside = plain(within_stop, ARRAYS)
    low[:, 1] = inside(-task.authority, forecast.driver, task.stop).max(axis=1) / task.authority
    high[:, 1] = inside(task.authority, forecast.driver, task.stop).min(axis=1) / task.authority
    stands = run.states[:K, State._fields.index("slewing")] / task.authority
    most = task.slew * fixed.ticks / task.authority
    slope = problem.scale[column] / task.authority
    return Limits(low, high, stands - most, stands + most, column, slope)
