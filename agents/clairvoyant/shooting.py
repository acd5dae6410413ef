"""The clairvoyant's plan on the nonlinear plant: multiple shooting, solved by IPOPT."""

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ...envs.backend.primitives import ARRAYS
from ...envs.backend.rebuild import plain
from ...envs.task.cost import BETA_SCALE, GAMMA_SCALE
from ...envs.vehicle.actuators import within_stop
from ...envs.vehicle.tyres import SLOW
from .foresight import Fixed, Forecast, Known, State
from .plant import advance, carried, node_cost, scales

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-6
MOST_ITERATIONS = 30
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": TOLERANCE,
    "ipopt.max_iter": MOST_ITERATIONS,
    "ipopt.mu_strategy": "adaptive",
    # where tyres and motors saturate the text has kinks, at which dual variables do not settle:
    # a feasible plan whose cost stands still will do
    "ipopt.acceptable_tol": 1e10,
    "ipopt.acceptable_dual_inf_tol": 1e10,
    "ipopt.acceptable_compl_inf_tol": 1e-2,
    "ipopt.acceptable_constr_viol_tol": 1e-3,
    "ipopt.acceptable_obj_change_tol": 1e-3,
    "ipopt.acceptable_iter": 4,
}


@dataclass(frozen=True)
class Problem:
    """A solver for every episode with the same Fixed.

    Its variables are (len(names) + width, periods + 1), states in units of `scale`, then the
    action; its parameters (len(Known), periods + 1); its constraints (len(names), periods) zeros
    and, where the action steers, the movement of the added steering (1, periods). slopes: of the
    states after a step by the variables of its start, (len(names), len(names) + width) a period.
    """

    fixed: Fixed
    names: tuple[str, ...]
    scale: Array
    solver: Any
    slopes: Any

    @property
    def at(self) -> list[int]:
        """Where the carried states stand in a State."""
        return [State._fields.index(name) for name in self.names]


@dataclass(frozen=True)
class Trajectory:
    """States (K + 1, len(State)) at the start of every period and at the end, actions (K, width)
    as shares of full scale."""

    states: Array
    actions: Array


@dataclass(frozen=True)
class Solution:
    """IPOPT's trajectory from a start, its objective, return text and iterations."""

    trajectory: Trajectory
    objective: float
    status: str
    iterations: int

    @property
    def solved(self) -> bool:
        """Whether IPOPT returned a solution."""
        return self.status in SOLVED


@functools.lru_cache(maxsize=8)
def problem_of(fixed: Fixed) -> Problem:
    """The solver, cached for each of the newest few kinds of episode."""
    if fixed.steps != 1:
        raise ValueError(f"the plan takes one step a control period, got {fixed.steps}")
    names = carried(fixed)
    scale, size, K = np.array(scales(fixed, names)), len(names), fixed.periods
    w, known = ca.SX.sym("w", size + fixed.width), ca.SX.sym("known", len(Known._fields))
    zero = State(*(0.0,) * len(State._fields))
    x = zero._replace(**{name: scale[i] * w[i] for i, name in enumerate(names)})
    each = Known(*ca.vertsplit(known))
    step = advance(fixed, x, ca.vertsplit(w[size:]), each)
    after = ca.vertcat(*(getattr(step.state, name) for name in names)) / scale
    inside = ca.Function("inside", [w, known], [after, step.effort, step.slewed], {"cse": True})
    node = ca.Function("node", [w, known], [node_cost(fixed, x, each)])
    W, C = ca.MX.sym("W", w.numel(), K + 1), ca.MX.sym("C", known.numel(), K + 1)
    ahead, effort, moved = inside.map(K)(W[:, :K], C[:, :K])
    rest = [ca.vec(ahead - W[:size, 1:])]
    if fixed.width > 1:
        rest.append(ca.vec(moved))
    nlp: dict[str, Any] = {
        "x": ca.vec(W),
        "p": ca.vec(C),
        "f": ca.sum2(node.map(K + 1)(W, C)) + ca.sum2(effort),
        "g": ca.vertcat(*rest),
    }
    solver = ca.nlpsol("clairvoyant", "ipopt", nlp, _OPTIONS)
    slopes = ca.Function("slopes", [w, known], [ca.jacobian(after, w)], {"cse": True})
    return Problem(fixed, names, scale, solver, slopes.map(K))


def solve(forecast: Forecast, start: Trajectory, grip: float = 1.0) -> Solution:
    """The plan that IPOPT finds from a trajectory, which need not obey the plant.

    grip: factor on the friction of road and tyres. Where IPOPT ends with numbers that are not
    finite the solution is the start, with IPOPT's return text.
    """
    fixed = forecast.fixed
    problem = problem_of(fixed)
    size, K, at = len(problem.names), fixed.periods, problem.at
    guess = _packed(problem, start)
    known = forecast.known.copy()
    known[[Known._fields.index(name) for name in ("mu", "mu_r")]] *= grip
    low, high = np.full_like(guess, -np.inf), np.full_like(guess, np.inf)
    low[:size, 0] = high[:size, 0] = np.array(forecast.start)[at] / problem.scale
    low[size:], high[size:] = -1.0, 1.0
    limits = np.zeros(size * K)
    if fixed.width > 1:
        low[size + 1, :K], high[size + 1, :K] = _steering_limits(forecast)
        limits = np.concatenate([limits, np.full(K, fixed.task.slew * fixed.ticks)])
    low[size:, K] = high[size:, K] = 0.0  # nothing acts after the end
    found = problem.solver(
        x0=_flat(guess), p=_flat(known), lbx=_flat(low), ubx=_flat(high),
        lbg=-limits, ubg=limits,
    )  # fmt: skip
    stats = problem.solver.stats()
    status, iterations = str(stats["return_status"]), int(stats["iter_count"])
    objective = float(found["f"])
    if not np.isfinite(objective):
        return Solution(start, objective, status, iterations)
    best = found["x"].full().reshape(guess.shape, order="F")
    states = start.states.copy()
    states[:, at] = best[:size].T * problem.scale
    actions = np.clip(best[size:, :K].T, -1.0, 1.0)
    return Solution(Trajectory(states, actions), objective, status, iterations)


def tracking_gains(forecast: Forecast, plan: Trajectory) -> Array:
    """(K, width, len(State)): gains from a deviation from the plan to the actions.

    A car that slides is unstable: the plan alone, on a plant that differs by its step's error,
    would be lost. The gains are those of the linear-quadratic regulator along the plan.
    """
    problem = problem_of(forecast.fixed)
    size, K, at = len(problem.names), forecast.fixed.periods, problem.at
    slopes = problem.slopes(_packed(problem, plan)[:, :K], forecast.known[:, :K]).full()
    slopes = slopes.reshape(size, K, -1).transpose(1, 0, 2)
    v = max(float(plan.states[0, 0]), SLOW)
    weight = {"v_y": 1.0 / (BETA_SCALE * v), "gamma": 1.0 / GAMMA_SCALE}
    wanted = np.array([weight.get(name, 0.0) for name in problem.names])
    Q = np.diag((wanted * problem.scale) ** 2)
    R = np.eye(forecast.fixed.width)
    P, gains = Q, np.zeros((K, len(R), len(State._fields)))
    for k in reversed(range(K)):
        A, B = slopes[k, :, :size], slopes[k, :, size:]
        gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        gains[k][:, at] = gain / problem.scale
        P = Q + A.T @ P @ (A - B @ gain)
        P = 0.5 * (P + P.T)
    return gains


def _packed(problem: Problem, trajectory: Trajectory) -> Array:
    """The solver's variables of a trajectory."""
    size, K = len(problem.names), problem.fixed.periods
    packed = np.zeros((size + problem.fixed.width, K + 1))
    packed[:size] = (trajectory.states[:, problem.at] / problem.scale).T
    packed[size:, :K] = trajectory.actions.T
    return packed


def _flat(columns: Array) -> Array:
    return columns.ravel(order="F")


def _steering_limits(forecast: Forecast) -> tuple[Array, Array]:
    """The least and most share of added steering in each period, within the stop of the wheels."""
    task = forecast.fixed.task
    inside = plain(within_stop, ARRAYS)
    low = inside(-task.authority, forecast.driver, task.stop).max(axis=1)
    high = inside(task.authority, forecast.driver, task.stop).min(axis=1)
    return low / task.authority, high / task.authority
