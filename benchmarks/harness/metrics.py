"""Metrics with their units, those of an episode step by step, and the tyres' dissipated power.

A new metric of an episode is one entry of `EPISODE`: its rows, its column and its unit follow.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...envs.engine.layout import P, Z
from ...envs.engine.step import make_step_variant
from ...envs.engine.tick import apply_tyre_change
from ...envs.numerics.functions import sincos
from ...envs.numerics.jit import jit_nrt
from ...envs.numerics.packed import read
from ...envs.numerics.primitives import Matrix, Vector
from ...envs.record import Array
from ...envs.vehicle.dynamics import compute_gravity
from ...envs.vehicle.tyres import compute_tyre_forces, compute_tyre_load

_FULL = 0.999  # fraction of full scale from which on an input counts as saturated


class StepSample(NamedTuple):
    """An env-step of N cars."""

    command: Array  # fractions of yaw moment and added steering, shape (N, 2)
    last_command: Array  # commands of the last step, shape (N, 2)
    reward: Array  # rewards, shape (N,)
    info: Mapping[str, Array]  # info of the env after the step
    last: Mapping[str, Array]  # info of the env before the step
    full_scale: Array  # yaw moment (N m) and added steering (rad) at a fraction of 1, shape (2,)
    dt: float  # control period (s)
    lateral_deviation: Array  # distance from the path of the reference (m), shape (N,)
    power: Array  # power of the motors (W), shape (N,)
    tyre_dissipation: Array  # power that the tyres dissipate (W), shape (N,)


class _Reduction(NamedTuple):
    """Reduction of the values of an episode's steps to one number, which starts at 0."""

    add: Callable[[Array, Array], Array]  # (number so far, a step's value) -> number
    finish: Callable[[Array, Array], Array]  # (last number, count of steps) -> result


def _keep_total(total: Array, _: Array) -> Array:
    return total


REDUCTIONS = {
    "sum": _Reduction(np.add, _keep_total),
    "mean": _Reduction(np.add, np.divide),
    "rms": _Reduction(lambda total, x: total + x * x, lambda total, n: np.sqrt(total / n)),
    "max": _Reduction(np.maximum, _keep_total),
    "last": _Reduction(lambda _, x: x, _keep_total),
}


@dataclass(frozen=True)
class Metric:
    """A number of an episode."""

    name: str
    unit: str
    compute: Callable[[StepSample], Array]  # function from a `StepSample` to values, shape (N,)
    reduction: str  # key of `REDUCTIONS`
    heading: str = ""  # heading of its column in the matrix's table of motion, "" for none
    scale: float = 1.0  # factor of a number there
    digits: int = 1  # decimal places of a number there
    turning: bool = False  # whether it is meaningful only where the reference has a yaw rate


def _make_change(i: int) -> Callable[[StepSample], Array]:
    """Make the change of an input's command from one decision to the next."""
    return lambda m: np.abs(m.command[:, i] - m.last_command[:, i]) * m.full_scale[i]


_DEGREES = 180.0 / np.pi
EPISODE = (
    Metric("cost", "-", lambda m: -m.reward, "sum"),
    Metric("rms_slip", "rad", lambda m: m.info["beta"], "rms"),
    Metric("peak_slip", "rad", lambda m: np.abs(m.info["beta"]), "max",
           "peak slip / deg", _DEGREES, 2),
    Metric("rms_slip_error", "rad", lambda m: m.info["beta"] - m.info["beta_ref"], "rms",
           "slip error / deg", _DEGREES, 2),
    Metric("rms_yaw_error", "rad/s", lambda m: m.info["gamma"] - m.info["gamma_ref"], "rms",
           "yaw error / (deg/s)", _DEGREES, 2, turning=True),
    # largest distance from the path of the reference's yaw rate and slip
    Metric("path_error", "m", lambda m: np.abs(m.lateral_deviation), "max",
           "off the path / m", 1.0, 2, turning=True),
    # mechanical work of both motors, without regard to its sign
    Metric("motor_energy", "J", lambda m: m.power * m.dt, "sum", "motors / kJ", 1e-3),
    # energy of sliding sideways, both axles
    Metric("tyre_dissipation", "J", lambda m: m.tyre_dissipation * m.dt, "sum",
           "tyres / kJ", 1e-3, 2),
    # delivered yaw moment as a fraction
    Metric("effort", "-", lambda m: (m.info["yaw_moment"] / m.full_scale[0]) ** 2, "mean",
           "effort", 1, 3),
    Metric("moment_rate", "N m/s",
           lambda m: np.abs(m.info["yaw_moment"] - m.last["yaw_moment"]) / m.dt, "mean",
           "moment rate / (N m/s)", digits=0),
    Metric("largest_step", "N m", _make_change(0), "max", "step / (N m)", digits=0),
    # added steering command as a fraction
    Metric("steer_effort", "-", lambda m: m.command[:, 1] ** 2, "mean"),
    Metric("largest_steer_step", "rad", _make_change(1), "max", "steer step / mrad", 1e3),
    # fraction of the decisions with an input at its limit
    Metric("saturation", "-",
           lambda m: (np.abs(m.command).max(axis=1) >= _FULL).astype(np.float64), "mean",
           "saturated / %", 1e2),
    # a code of `FAILURES`
    Metric("failure", "code", lambda m: m.info["failure"], "last"),
)  # fmt: skip
"""Metrics of an episode."""

_OTHERS = {
    "rad": "median p95 worst rmse static_slip drift course_prediction_error",
    "m": "offset prediction_error",
    "m/s": "speed",
    "s": "cpu_seconds response_time healthy_after",
    "us": "us_per_tick us_per_step us_per_decision us_added",
    "dB": "decibels",
    "Hz": "hertz",
    "rad s2/m": "understeer_gradient",
    "-": "rmse_over_bound score cost_vs_nominal share_won worst_cost failure_rate spin_rate "
    "departure_rate collision_rate success_rate saved_rate not_finite_rate bad_action_rate "
    "gap ratio difference residual rank share spectral_radius count amplitude overshoot "
    "log_likelihood nis nees coverage rmse_over_told rmse_over_gyro",
}
METRICS = {metric.name: metric.unit for metric in EPISODE} | {
    name: unit for unit, names in _OTHERS.items() for name in names.split()
}  # unit of every metric that a row may have


@jit_nrt
def compute_dissipation(params: Matrix, states: Matrix, switches: Matrix) -> Vector:
    """Compute the power (W), shape (N,), of both axles' lateral sliding: -F_y times sliding speed.

    Args:
        params: Packed parameters of the engine, one row for each car.
        states: Packed states of the engine, likewise.
        switches: Packed switches of the engine, likewise.
    """
    out = np.empty(len(params))
    for i in range(len(params)):
        p, z = params[i], states[i]
        motion, drive, change = read(z, Z.motion), read(z, Z.drive), read(p, P.tyre_change)
        kind = make_step_variant(p, switches[i])
        car = apply_tyre_change(read(p, P.car), change, z[Z.clock.tick] >= change.tick)
        _, g_y = compute_gravity(motion, read(p, P.road), kind.small_angle)
        load = compute_tyre_load(drive, car, kind)
        F_yf, F_yr, _, _ = compute_tyre_forces(motion, load, car, g_y, kind)
        sin_d, cos_d = sincos(drive.delta_f)
        front = (motion.v_y + car.l_f * motion.gamma) * cos_d - motion.v_x * sin_d
        out[i] = -F_yf * front - F_yr * (motion.v_y - car.l_r * motion.gamma)
    return out
