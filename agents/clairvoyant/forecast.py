"""The forecast of an episode after its lead-in, and its linearisation on CasADi's symbols.

The forecast has driver, wind and disturbances of every step, which the actions hardly affect.
"""

import functools
from collections import namedtuple
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import EpisodeArrays, P, StepVariant, TaskParams, Z
from ...envs.engine.step import make_step_variant, step_vehicle
from ...envs.engine.tick import compute_lagged_load, compute_motor_torques
from ...envs.engine.window import compute_profile_angle, make_window
from ...envs.numerics.functions import FOREVER, TICK
from ...envs.numerics.jit import as_python
from ...envs.numerics.packed import read
from ...envs.numerics.primitives import Scalar
from ...envs.record import Array
from ...envs.scenarios.driver import SpeedProfile, compute_acceleration_command, compute_wind
from ...envs.scenarios.road import NOMINAL_PATH
from ...envs.task import (
    LAGGED,
    RATE_TICKS,
    REPORT,
    ReferenceParams,
    compute_cost_rate,
    compute_reference,
)
from ...envs.vehicle.actuators import Lag, apply_lag, compute_yaw_moment, make_lag
from ...envs.vehicle.dynamics import (
    CarParams,
    DisturbanceForces,
    Motion,
    RoadParams,
    compute_sideslip_angle,
    rk4,
)
from ...envs.vehicle.tyres import MAGIC_FORMULA


class PreviewStep(NamedTuple):
    """Inputs and parameters of one step of the plan, which actions hardly affect."""

    steer_start: Scalar  # rad, front steering angle without the added one, at the step's start
    steer_middle: Scalar  # rad, at the step's middle
    steer_end: Scalar  # rad, at its end
    command: Scalar  # rad, the driver's steering command at the step's start
    F_d: Scalar  # N, lateral force of disturbance and wind, mean over the step
    N_d: Scalar  # N m, yaw moment of both, mean over the step
    N_x: Scalar  # N m, roll moment of the wind, mean over the step
    C_f: Scalar  # N/rad, of a front tyre
    C_r: Scalar  # N/rad, of a rear tyre
    mu: Scalar  # under the left wheels
    mu_r: Scalar  # under the right wheels
    speed: Scalar  # m/s, the driver's set point
    acceleration: Scalar  # m/s2, the driver's acceleration, fed forward
    turn: Scalar  # rad/s, mean turning rate of a road that the nominal car lays, else 0
    weight: Scalar  # s, quadrature weight of the cost rate at the step's start
    beta_ref: Scalar  # rad, at the step's start; read if it is lagged or of sensors with errors
    gamma_ref: Scalar  # rad/s
    effort: Scalar  # 1, and 0 at the episode's end, after which no effort counts


# States of a plan: those of `Motion`, the motors' torques (N m), the driver's integral, the added
# steering as it is commanded and applied (rad), and the motors' commands (N m).
PlanState = namedtuple("PlanState", "v_x v_y gamma psi X Y s y theta phi phi_dot slip_f slip_r "
                       "T_l T_r integral slewing added command_l command_r")  # fmt: skip


class PlanParams(NamedTuple):
    """Parameters that are constant within an episode; hashable, as the key of a solver."""

    car: CarParams  # C_f, C_r, mu and mu_r are 0: `PreviewStep` has them
    road: RoadParams
    speed_profile: SpeedProfile  # speed, acceleration, start, surge are 0: see `PreviewStep`
    motor: Lag  # lag of the motors over a step
    steering: Lag  # lag of the steering over a step
    motor_tick: Lag  # lag of the motors over a tick
    steering_tick: Lag  # lag of the steering over a tick
    target: ReferenceParams
    task: TaskParams
    kind: StepVariant  # of the plant
    width: int  # entries of an action
    ticks: int  # ticks of a step: the control period
    periods: int  # steps of the episode


@dataclass(frozen=True)
class Forecast:
    """Parameters, preview and start of an episode, from which a plan is computed."""

    fixed: PlanParams
    known: Array  # columns of `PreviewStep` (its fields, periods + 1); the last: the episode's end
    start: PlanState  # where the lead-in ends
    driver: Array  # the driver's steering command at every tick (rad), shape (periods, n)


def make_forecast(base: Any, actions: Array | None = None) -> Forecast:
    """Make the forecast of an episode, whose lead-in just ended if it has one, to its end.

    Args:
        base: Unwrapped env at the manoeuvre's start; ValueError elsewhere in its episode.
        actions: Actions of a run, shape (K, width), to which driver and place react; None: zeros.
    """
    n = base.control_period
    snapshot = base.get_state()
    p, z = snapshot["params"], snapshot["state"]
    if z[Z.clock.tick] != p[P.task.lead_in]:
        raise ValueError("a forecast starts where a manoeuvre does: call reset() first")
    start = read_plan_state(z)
    fixed = _make_plan_params(base, p, snapshot["config"].start.switches, n)
    ticks = np.arange(fixed.periods * n + 1) + int(z[Z.clock.tick])
    if actions is None:
        actions = np.zeros((fixed.periods, fixed.width))
    # disturbances, and a steering profile's front wheels, do not depend on the actions
    states = _simulate_actions(base, snapshot, actions, n)
    command = states[:, Z.driver]
    if not fixed.kind.has_driver and base.scenario.steering != "wander":
        command = np.array([compute_profile_angle(p, float(k)) for k in ticks])
    known = _compute_preview(p, fixed, ticks, states, command)
    return Forecast(fixed, known, start, command[:-1].reshape(-1, n))


def read_plan_state(z: Array) -> PlanState:
    """Read the `PlanState` in a packed state of the env.

    Args:
        z: Packed state of one car.
    """
    motion, drive = read(z, Z.motion), read(z, Z.drive)
    actuators = drive.T_l, drive.T_r, drive.integral, drive.slewing, drive.added
    return PlanState(*motion, *actuators, drive.command_l, drive.command_r)


def _make_plan_params(base: Any, p: Array, switches: Array, n: int) -> PlanParams:
    """Make the parameters of an episode in steps of n ticks."""
    x, delays = base.vehicle, (0.0, 0.0)
    if base.scenario.lags:
        delays = x.motor_lag, x.steering_lag
    road, target, task = read(p, P.road), read(p, P.target), read(p, P.task)
    car = read(p, P.car)._replace(C_f=0.0, C_r=0.0, mu=0.0, mu_r=0.0)
    profile = read(p, P.speed_profile)._replace(end=FOREVER, speed=0.0, acceleration=0.0)
    profile = profile._replace(start=0.0, surge=0.0)
    lags: Any = [make_lag(delay, period) for period in (n * TICK, TICK) for delay in delays]
    kind, width = as_python(make_step_variant)(p, switches), base.action_space.shape[0]
    periods = -int((task.lead_in - task.duration) // n)
    return PlanParams._make((car, road, profile, *lags, target, task, kind, width, n, periods))


def _simulate_actions(base: Any, snapshot: dict[str, Any], actions: Array, n: int) -> Array:
    """Simulate the packed states at every tick by the env, shape (K n + 1, STATE_WIDTH)."""
    names = ("params", "state", "switches", "rows", "packets")
    p, z, switches, rows, packets = (snapshot[name] for name in names)
    bounds = np.array([[entry.low, entry.high] for entry in base.layout]).T.copy()
    obs, report = np.empty(len(base.layout), np.float32), np.zeros(len(REPORT))
    row = EpisodeArrays(p, z, switches, obs, rows, packets, report, bounds, make_window(1))
    held_actions = np.repeat(np.vstack([actions, actions[-1:]]).astype(np.float32), n, axis=0)
    states = np.empty((n * len(actions) + 1, len(z)))
    for state, action in zip(states, held_actions, strict=False):
        state[:] = z
        step_vehicle(row, action, 1)
    return np.nan_to_num(states)  # an unstable simulation may give NaN or inf


def _compute_preview(
    p: Array, fixed: PlanParams, ticks: npt.NDArray[np.int64], states: Array, command: Array
) -> Array:
    """Compute the columns of `PreviewStep`, shape (len(PreviewStep), periods + 1)."""
    n, last = fixed.ticks, len(command) - 1
    nodes = np.arange(0, last, n)
    angle = states[:, Z.drive.delta_f] - states[:, Z.drive.added]
    lag, middle = fixed.steering_tick, nodes + n // 2
    wind = read(p, P.wind)
    wind_forces = np.array([compute_wind(float(tick), wind) for tick in ticks[:-1]])
    forces = np.column_stack([states[:-1, [Z.drive.F_d, Z.drive.N_d]], np.zeros(last)])
    mean_forces = (forces + wind_forces).reshape(-1, n, 3).mean(axis=1)
    profile = read(p, P.speed_profile)
    set_points = np.array([_compute_set_point(float(tick), profile) for tick in ticks[nodes]])
    car, change = read(p, P.car), read(p, P.tyre_change)
    is_changed, wave = ticks[nodes] >= change.tick, read(p, P.friction_wave)
    patch = 1.0 + wave.share * np.sin(wave.rate * states[middle, Z.motion.s] + wave.phase)
    numbers = car.C_f, car.C_r, car.mu * patch, car.mu_r * patch
    factors = (change.front, change.rear, change.friction, change.friction)
    pairs = zip(factors, numbers, strict=True)
    tyres = [np.where(is_changed, factor * number, number) for factor, number in pairs]
    # the direction of a nominal car's path, gamma + beta'; another road's does not turn so
    beta, gamma = states[:, Z.nominal_motion.beta], states[:, Z.nominal_motion.gamma]
    turns = gamma[:-1] + np.diff(beta) / TICK
    # Weights (s) of the cost rates at every n-th tick, by the trapezoid rule: n / 2 ticks at either
    # end. J sums ticks 1 to the last: the start, which does not count, has half a tick less, and
    # the last one, which counts whole, half a tick more. This is exact for n = 1.
    weights = np.full(len(nodes), n * TICK)
    weights[0] = 0.5 * (n - 1) * TICK
    rests = lag.start, lag.middle if n % 2 else lag.start, lag.end
    places = zip((nodes, middle, nodes + n - 1), rests, strict=True)
    # the front wheels' angle without the added one, after a tick's lag
    wheels = [as_python(apply_lag)(command[i], angle[i], rest) for i, rest in places]
    turn, refs = turns.reshape(-1, n).mean(axis=1), states[np.ix_(nodes, Z.refs)].T
    inputs = *wheels, command[nodes], *mean_forces.T, *tyres, *set_points.T
    known = np.array([*inputs, turn, weights, *refs, np.ones(len(nodes))])
    end = known[:, -1:].copy()  # of the episode's end only command, references and weight count
    column, is_complete = PreviewStep._fields.index, ticks[-1] == fixed.task.duration
    end[column("command")] = command[last]
    end[column("beta_ref") :, 0] = *states[last, list(Z.refs)], 0.0
    end[column("weight")] = 0.5 * (n + 1) * TICK if is_complete else 0.0
    return np.hstack([known, end])


def _compute_set_point(tick: float, speed_profile: SpeedProfile) -> tuple[float, float]:
    """Compute the driver's speed (m/s) and feedforward acceleration (m/s^2) at a tick."""
    # at v_x = 0, k_p = 0 leaves the feedforward alone, and k_p = 1 /s adds the speed to it
    profiles = [speed_profile._replace(hold=1.0, k_p=k_p, k_i=0.0) for k_p in (0.0, 1.0)]
    commands = [compute_acceleration_command(tick, 0.0, 0.0, x, np.inf)[0] for x in profiles]
    feedforward, total = commands
    return total - feedforward, feedforward


_Errors = tuple[Scalar, Scalar]
N_INPUTS = 2  # in a sweep: fractions of moment and added steering; the latter is 0 if unused
SYMBOLS: dict[str, Callable[..., Any]] = {
    "minimum": ca.fmin, "maximum": ca.fmax, "absolute": ca.fabs, "floor": ca.floor,
    "sqrt": ca.sqrt, "select": ca.if_else, "to_float": lambda a: a * 1.0,
    "any_lane": lambda condition: isinstance(condition, ca.SX | ca.MX) or condition,
    # its own functions agree with our polynomials to 1e-15 and have shorter derivatives
    "sincos": lambda x: (ca.sin(x), ca.cos(x)),
    "atan": ca.atan, "atan2": ca.atan2, "compute_sine": ca.sin,
}  # fmt: skip
"""The primitives for CasADi's SX and MX, by name; & and | raise TypeError on symbols."""
_rk4, _load_at = as_python(rk4, SYMBOLS), as_python(compute_lagged_load, SYMBOLS)
_motor_torques = as_python(compute_motor_torques, SYMBOLS)
_sideslip = as_python(compute_sideslip_angle, SYMBOLS)
_reference = as_python(compute_reference, SYMBOLS)
_apply_lag, _yaw_moment = as_python(apply_lag, SYMBOLS), as_python(compute_yaw_moment, SYMBOLS)
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


def _list_moments(fixed: PlanParams, command: Scalar, moment: Scalar, ticks: range) -> list[Scalar]:
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
    moments = _list_moments(fixed, held, moment, range(-span, 0))
    moments += _list_moments(fixed, command, moment, range(q))
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
