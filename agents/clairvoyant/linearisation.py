"""Linearisation of an episode's runs on CasADi's symbols."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...envs.engine.tick import compute_lagged_load, compute_motor_torques
from ...envs.numerics.casadi_backend import SYMBOLS, to_casadi
from ...envs.numerics.jit import as_python
from ...envs.numerics.primitives import Scalar
from ...envs.record import Array
from ...envs.scenarios.road import NOMINAL_PATH
from ...envs.task import LAGGED, RATE_TICKS, compute_cost_rate, compute_reference
from ...envs.ticks import TICK
from ...envs.vehicle.actuators import apply_lag, compute_yaw_moment
from ...envs.vehicle.dynamics import DisturbanceForces, Motion, compute_sideslip_angle, rk4
from ...envs.vehicle.tyres import MAGIC_FORMULA
from .preview import PlanParams, PlanState, PreviewStep

_Errors = tuple[Scalar, Scalar]
N_INPUTS = 2  # in a sweep: fractions of moment and added steering; the latter is 0 if unused
_rk4, _load_at = to_casadi(rk4), to_casadi(compute_lagged_load)
_motor_torques, _sideslip = to_casadi(compute_motor_torques), to_casadi(compute_sideslip_angle)
_apply_lag, _yaw_moment = to_casadi(apply_lag), to_casadi(compute_yaw_moment)
_reference = to_casadi(compute_reference)
# compute_cost_rate as a plain sum of squares, smooth for the solver: its cap and its `absolute`,
# whose slope is undefined at zero, are identities here
_uncapped_cost_rate = as_python(
    compute_cost_rate, SYMBOLS | {"minimum": lambda rate, cap: rate, "absolute": lambda rate: rate}
)


def _list_active_states(fixed: PlanParams) -> tuple[str, ...]:
    """List the states that matter to an episode's cost, in the order of `PlanState`."""
    road, active = fixed.road, {"v_x", "v_y", "gamma", "T_l", "T_r"}
    if fixed.task.moment_rate or fixed.task.torque_slew:
        active |= {"command_l", "command_r"}
    if fixed.kind.roll:
        active |= {"phi", "phi_dot"}
    if fixed.kind.law == MAGIC_FORMULA and fixed.car.relaxation:
        active |= {"slip_f", "slip_r"}
    if fixed.speed_profile.hold and fixed.speed_profile.k_i:
        active |= {"integral"}
    if fixed.width > 1:
        active |= {"slewing", "added"}
    if road.curvature or road.lateral or road.longitudinal or road.wave:
        active |= {"psi", "s", "y", "theta"}
    return tuple(name for name in PlanState._fields if name in active)


def _compute_node_errors(fixed: PlanParams, x: PlanState, known: PreviewStep) -> _Errors:
    """Compute the errors of sideslip angle (rad) and yaw rate (rad/s) at a step's start."""
    kind, beta_ref, gamma_ref = fixed.kind, known.beta_ref, known.gamma_ref
    beta = _sideslip(x.v_x, x.v_y, kind.small_angle)
    if kind.reference != LAGGED and not kind.has_errors:
        beta_ref, gamma_ref = _reference(known.command, x.v_x, fixed.target, kind.reference)
    return beta - beta_ref, x.gamma - gamma_ref


def _compute_node_cost(fixed: PlanParams, errors: _Errors, known: PreviewStep) -> Scalar:
    """Compute the weighted cost of a step's first errors, without the cap."""
    return known.weight * _uncapped_cost_rate(*errors, 0.0, 0.0, fixed.kind.reference)


def _compute_mean_command(end: Scalar, start: Scalar, slew: Scalar, ticks: int) -> Scalar:
    """Compute the mean over ticks of a command that moves at `slew` a tick and then rests."""
    # m = |moved| / slew ticks, of which the first moves at its start: m (m - 1) slew / 2 are missed
    moved = end - start
    return end - moved * ca.fmax(ca.fabs(moved) / slew - 1.0, 0.0) / (2.0 * ticks)


def _compute_moments(
    fixed: PlanParams, command: Scalar, moment: Scalar, ticks: Sequence[int]
) -> list[Scalar]:
    """Compute the mean yaw moment over ticks (of full scale) from command and moment at tick 0."""
    lag = fixed.motor_tick
    rests = [lag.mean * lag.end**tick if lag.end else 0.0 for tick in ticks]
    return [_apply_lag(command, moment, rest) / fixed.task.yaw_scale for rest in rests]


def _advance(
    fixed: PlanParams, x: PlanState, action: Sequence[Scalar], known: PreviewStep
) -> tuple[PlanState, Scalar]:
    """Advance a plan by one Runge-Kutta step of the env's plant: next state, cost of effort."""
    # the driver's acceleration is that of the step's start; added steering acts by its mean
    car = fixed.car._replace(C_f=known.C_f, C_r=known.C_r, mu=known.mu, mu_r=known.mu_r)
    task, kind, q = fixed.task, fixed.kind, fixed.ticks
    speed_profile = fixed.speed_profile._replace(speed=known.speed, acceleration=known.acceleration)
    start = x.v_x, x.integral, speed_profile, car, task.yaw_first
    *commands, _, integral = _motor_torques(action[0] * task.yaw_scale, 0.0, *start)
    T_l, T_r = commands
    if task.torque_slew:
        T_l = _compute_mean_command(T_l, x.command_l, task.torque_slew, q)
        T_r = _compute_mean_command(T_r, x.command_r, task.torque_slew, q)
    slewing = action[1] * task.authority if fixed.width > 1 else 0.0
    mean_added = _compute_mean_command(slewing, x.slewing, task.slew, q)
    motor, steering, road = fixed.motor, fixed.steering, fixed.road
    if kind.road == NOMINAL_PATH:
        road = road._replace(turn=known.turn)
    loads = tuple(
        _load_at(angle + _apply_lag(mean_added, x.added, rest), T_l, T_r, x, motor_rest, car, kind)
        for angle, rest, motor_rest in (
            (known.steer_start, steering.start, motor.start),
            (known.steer_middle, steering.middle, motor.middle),
            (known.steer_end, steering.end, motor.end),
        )
    )
    motion = Motion(*x[: len(Motion._fields)])
    forces = DisturbanceForces(known.F_d, known.N_d, known.N_x)
    motion = _rk4(motion, loads, forces, car, road, q * TICK, kind)
    # a rate is taken over `RATE_TICKS`, in shorter periods over one of them
    span = min(q, RATE_TICKS)
    sides = (x.command_l, x.command_r), (T_l, T_r), (x.T_l, x.T_r)
    held, command, moment = (_yaw_moment(left, right, car) for left, right in sides)
    moments = _compute_moments(fixed, held, moment, range(-span, 0))
    moments += _compute_moments(fixed, command, moment, range(q))
    effort, steering_tick = 0.0, fixed.steering_tick
    for tick in range(q):
        added = _apply_lag(mean_added, x.added, steering_tick.mean * steering_tick.end**tick)
        change = (moments[tick + span] - moments[tick]) / (span * TICK)
        shares = moments[tick + span], added, kind.reference, task.moment_rate * change * change
        effort += TICK * _uncapped_cost_rate(0.0, 0.0, *shares)
    torques = _apply_lag(T_l, x.T_l, motor.end), _apply_lag(T_r, x.T_r, motor.end)
    new_integral = x.integral + q * (integral - x.integral)
    new_added = _apply_lag(mean_added, x.added, steering.end)
    return PlanState(*motion, *torques, new_integral, slewing, new_added, *commands), effort


def _get_state_scales(fixed: PlanParams, names: tuple[str, ...]) -> list[float]:
    """Get the SI unit of each state in the solver, in which all are of order one."""
    scales = {"phi_dot": 0.5} | dict.fromkeys(("phi", "slewing", "added", "slip_f", "slip_r"), 0.1)
    scales |= dict.fromkeys(("T_l", "T_r", "command_l", "command_r"), float(fixed.car.T_max))
    return [scales.get(name, 1.0) for name in names]


@dataclass(frozen=True)
class PlanRun:
    """The env's run of actions."""

    states: Array  # `PlanState` at the start of every period and at the end, shape (K + 1, n)
    actions: Array  # applied, fractions of full scale, shape (K, width)
    cost: float  # cost J
    length: int  # periods until it ended


class Linearisation(NamedTuple):
    """The derivatives along a run by n = size + N_INPUTS variables: scaled states, then inputs."""

    F: Array  # derivative of the state after each period, shape (K, size, n)
    g: Array  # gradient of the cost, shape (K + 1, n); the last one is of the episode's end
    H: Array  # Gauss-Newton's Hessian of the cost, shape (K + 1, n, n), likewise


@dataclass(frozen=True)
class IlqrProblem:
    """The functions that all episodes with the same `PlanParams` share."""

    fixed: PlanParams
    names: tuple[str, ...]  # of the active states
    scale: Array  # unit of each active state, shape (size,)
    differentiate: Any  # CasADi's function of the derivatives, for all nodes at once

    @property
    def state_indices(self) -> list[int]:
        """Indices of the active states in a `PlanState`."""
        return [PlanState._fields.index(name) for name in self.names]


@functools.lru_cache(maxsize=8)
def make_problem(fixed: PlanParams) -> IlqrProblem:
    """Make the functions, cached for the newest few kinds of episode.

    Args:
        fixed: Parameters of the episode.
    """
    names = _list_active_states(fixed)
    scale, size = np.array(_get_state_scales(fixed, names)), len(names)
    w, known = ca.SX.sym("w", size + fixed.width), ca.SX.sym("known", len(PreviewStep._fields))
    values = {name: scale[i] * w[i] for i, name in enumerate(names)}
    x = PlanState(*(values.get(name, 0.0) for name in PlanState._fields))
    step_inputs = PreviewStep(*ca.vertsplit(known))
    state, effort = _advance(fixed, x, ca.vertsplit(w[size:]), step_inputs)
    next_state = ca.vertcat(*(getattr(state, name) for name in names)) / scale
    e, errors = ca.SX.sym("e", 2), ca.vertcat(*_compute_node_errors(fixed, x, step_inputs))
    node_cost = _compute_node_cost(fixed, (e[0], e[1]), step_inputs)
    error_hessian, error_gradient = ca.hessian(node_cost, e)
    error_jacobian = ca.jacobian(errors, w)
    # the effort is a sum of squares of nearly linear terms
    effort_hessian, effort_gradient = ca.hessian(step_inputs.effort * effort, w)
    gradient = error_jacobian.T @ ca.substitute(error_gradient, e, errors) + effort_gradient
    hessian = error_jacobian.T @ error_hessian @ error_jacobian + effort_hessian
    derivatives = [ca.jacobian(next_state, w), gradient, hessian]
    node = ca.Function("node", [w, known], derivatives, {"cse": True})
    return IlqrProblem(fixed, names, scale, node.map(fixed.periods + 1))


def linearise(problem: IlqrProblem, known: Array, run: PlanRun) -> Linearisation:
    """Linearise every period of a run; an input that the action lacks has a unit Hessian alone.

    Args:
        problem: Functions of the episode.
        known: Columns of `PreviewStep`, shape (len(PreviewStep), K + 1).
        run: States and actions.

    Returns:
        Derivatives along the run, in scaled states and fractions of full scale.
    """
    size, K = len(problem.names), problem.fixed.periods
    n_used, n = size + problem.fixed.width, size + N_INPUTS
    points = np.zeros((n_used, K + 1))
    points[:size] = (run.states[:, problem.state_indices] / problem.scale).T
    points[size:, :K] = run.actions.T
    F, g, H = (np.nan_to_num(value.full()) for value in problem.differentiate(points, known))
    identities = np.tile(np.eye(n), (K + 1, 1, 1))
    result = Linearisation(np.zeros((K, size, n)), np.zeros((K + 1, n)), identities)
    result.F[:, :, :n_used] = F.reshape(size, K + 1, n_used).transpose(1, 0, 2)[:K]
    result.g[:, :n_used] = g.T
    result.H[:, :n_used, :n_used] = H.reshape(n_used, K + 1, n_used).transpose(1, 0, 2)
    return result
