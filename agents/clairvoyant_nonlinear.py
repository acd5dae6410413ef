"""The clairvoyant's plan on the nonlinear plant: multiple shooting, solved by IPOPT."""

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ..envs.actuators import within_stop
from ..envs.backend import ARRAYS, plain
from .foreseen import Fixed, Foreseen, Known, State
from .foreseen_plant import advance, carried, node_cost, scales

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-6
MOST_ITERATIONS = 200
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True)
class Problem:
    """A solver for every episode with the same Fixed.

    Its variables are (len(names) + width, periods + 1), states in units of `scale`, then the
    action; its parameters (len(Known), periods + 1); its constraints (len(names), periods) zeros
    and, where the action steers, the movement of the added steering (1, periods).
    """

    fixed: Fixed
    names: tuple[str, ...]
    scale: Array
    solver: Any


@functools.lru_cache(maxsize=8)
def problem_of(fixed: Fixed) -> Problem:
    """Build the solver; one is kept for each of the newest few kinds of episode."""
    if fixed.steps != 1:
        raise ValueError(f"the plan takes one step a control period, got {fixed.steps}")
    names = carried(fixed)
    scale, size, K = np.array(scales(fixed, names)), len(names), fixed.periods
    w, known = ca.SX.sym("w", size + fixed.width), ca.SX.sym("known", len(Known._fields))
    zero = State(*(0.0,) * len(State._fields))
    x = zero._replace(**{name: scale[i] * w[i] for i, name in enumerate(names)})
    told = Known(*ca.vertsplit(known))
    step = advance(fixed, x, ca.vertsplit(w[size:]), told)
    after = ca.vertcat(*(getattr(step.state, name) for name in names)) / scale
    inside = ca.Function("inside", [w, known], [after, step.effort, step.slewed], {"cse": True})
    node = ca.Function("node", [w, known], [node_cost(fixed, x, told)])
    W, C = ca.MX.sym("W", w.numel(), K + 1), ca.MX.sym("C", known.numel(), K + 1)
    ahead, effort, moved = inside.map(K)(W[:, :K], C[:, :K])
    rest = [ca.vec(ahead - W[:size, 1:])]
    if fixed.width > 1:
        rest.append(ca.vec(moved))
    nlp = {
        "x": ca.vec(W),
        "p": ca.vec(C),
        "f": ca.sum2(node.map(K + 1)(W, C)) + ca.sum2(effort),
        "g": ca.vertcat(*rest),
    }
    options = {
        "print_time": False,
        "error_on_fail": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": TOLERANCE,
        "ipopt.max_iter": MOST_ITERATIONS,
    }
    return Problem(fixed, names, scale, ca.nlpsol("clairvoyant", "ipopt", nlp, options))


def solve(foreseen: Foreseen, actions: Array, states: list[State]) -> tuple[Array, float, str]:
    """(actions (K, width), objective, IPOPT's return text) from a start.

    actions: (K, width) shares of full scale. states: at the start of every period and at the end,
    of the run that the actions gave.
    """
    fixed = foreseen.fixed
    problem = problem_of(fixed)
    size, K = len(problem.names), fixed.periods
    at = [State._fields.index(name) for name in problem.names]
    guess = np.zeros((size + fixed.width, K + 1))
    guess[:size] = (np.array(states)[:, at] / problem.scale).T
    guess[size:, :K] = actions.T
    low, high = np.full_like(guess, -np.inf), np.full_like(guess, np.inf)
    low[:size, 0] = high[:size, 0] = np.array(foreseen.start)[at] / problem.scale
    low[size:], high[size:] = -1.0, 1.0
    limits = np.zeros(size * K)
    if fixed.width > 1:
        low[size + 1, :K], high[size + 1, :K] = _steering_room(foreseen)
        limits = np.concatenate([limits, np.full(K, fixed.task.slew * fixed.ticks)])
    low[size:, K] = high[size:, K] = 0.0  # nothing acts after the end
    with np.errstate(all="ignore"):
        found = problem.solver(
            x0=_flat(guess), p=_flat(foreseen.known), lbx=_flat(low), ubx=_flat(high),
            lbg=-limits, ubg=limits,
        )  # fmt: skip
    best = np.array(found["x"]).reshape(guess.shape, order="F")[size:, :K].T
    return best, float(found["f"]), str(problem.solver.stats()["return_status"])


def _flat(columns: Array) -> Array:
    return columns.ravel(order="F")


def _steering_room(foreseen: Foreseen) -> tuple[Array, Array]:
    """The least and most share of added steering in each period, within the stop of the wheels."""
    task = foreseen.fixed.task
    inside = plain(within_stop, ARRAYS)
    low = inside(-task.authority, foreseen.driver, task.stop).max(axis=1)
    high = inside(task.authority, foreseen.driver, task.stop).min(axis=1)
    return low / task.authority, high / task.authority
