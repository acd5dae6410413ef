"""The preview of an episode after its lead-in: driver, wind and disturbances, step by step."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import EpisodeArrays, P, StepVariant, TaskParams, Z
from ...envs.engine.step import make_step_variant, step_vehicle
from ...envs.engine.window import compute_profile_angle, make_window
from ...envs.numerics.jit import as_python
from ...envs.numerics.packed import read
from ...envs.numerics.primitives import Scalar
from ...envs.record import Array
from ...envs.scenarios.driver import SpeedProfile, compute_acceleration_command, compute_wind
from ...envs.task import REPORT, ReferenceParams
from ...envs.ticks import FOREVER, TICK
from ...envs.vehicle.actuators import Lag, apply_lag, make_lag
from ...envs.vehicle.dynamics import CarParams, RoadParams


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


class PlanState(NamedTuple):
    """States of a plan in SI units: motion, actuators, the driver's integral."""

    v_x: Scalar
    v_y: Scalar
    gamma: Scalar
    psi: Scalar
    X: Scalar
    Y: Scalar
    s: Scalar
    y: Scalar
    theta: Scalar
    phi: Scalar
    phi_dot: Scalar
    slip_f: Scalar
    slip_r: Scalar
    T_l: Scalar  # torque of the left motor (N m)
    T_r: Scalar
    integral: Scalar
    slewing: Scalar  # added steering that is commanded (rad)
    added: Scalar  # added steering that is applied (rad)
    command_l: Scalar  # command of the left motor (N m)
    command_r: Scalar


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
    """Make the forecast of an episode whose lead-in, if it has one, just ended.

    Args:
        base: Unwrapped env at the manoeuvre's start.
        actions: Actions of a run, shape (K, width), to which driver and place react; None: zeros.

    Returns:
        Forecast from the manoeuvre's start to the episode's end.

    Raises:
        ValueError: The env is elsewhere in its episode.
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

    Returns:
        State in SI units.
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
