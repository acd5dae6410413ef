"""tie-vision's two-degree-of-freedom controller: feedforward (24) and a PI on the sideslip angle.

Both are designed from the nominal vehicle and scheduled by the measured speed, the mean of the two
front wheel speeds: the feedforward by its formula, the PI on a grid of speeds.
"""

import math
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs.backend import absolute, jit, maximum, select
from ..envs.linear import bicycle
from ..envs.record import TICK
from ..envs.vehicle import COMS, Vehicle
from .controller import Array, Controller

SLOWEST = 2.0  # m/s: gains below it are those of this speed
SPEEDS = np.arange(SLOWEST, 61.0, 0.5)  # m/s
POLE = 2.0 * math.pi * 2.0  # rad/s: Table II of tie-vision places poles at 2 Hz
PLACEMENTS = ("radius", "real")
CAMERA_PERIOD = 0.033  # s


@jit
def _static_gain(car: Any, V: Any) -> Any:
    m, l_f, l_r, C_f, C_r = car[0], car[1], car[2], car[3], car[4]
    mV2 = m * V * V
    numerator = 4.0 * l_r * (l_f + l_r) * C_f * C_r - 2.0 * l_f * C_f * mV2
    denominator = mV2 + 2.0 * (l_f * C_f - l_r * C_r)
    least = 0.05 * (mV2 + 2.0 * absolute(l_f * C_f - l_r * C_r))
    if absolute(denominator) < least:
        denominator = select(denominator < 0.0, -least, least)
    return numerator / denominator  # tie-vision (24)


def _car(vehicle: Vehicle) -> Array:
    """m, l_f, l_r, C_f, C_r as `_static_gain` takes them."""
    return np.array(
        [
            vehicle.mass,
            vehicle.front_arm,
            vehicle.rear_arm,
            vehicle.front_stiffness,
            vehicle.rear_stiffness,
        ]
    )


def feedforward_gain(vehicle: Vehicle, speed: float) -> float:
    """C_FF in N m/rad: the yaw moment per steering angle that brings static slip to zero.

    Where the yaw moment has no static effect on beta (m V^2 = 2 (l_r C_r - l_f C_f), which exists
    for understeering cars only) the gain is limited to what 5 % of the terms would give.
    """
    return float(_static_gain(_car(vehicle), float(speed)))


@dataclass(frozen=True)
class PI:
    """Gains of the yaw moment on the slip error: k_p in N m/rad, k_i in N m/(rad s)."""

    k_p: float
    k_i: float


def design_pi(vehicle: Vehicle, speed: float, pole: float = POLE, placement: str = "radius") -> PI:
    """A PI whose zero lies on the plant's slow pole, with closed-loop poles at `pole` rad/s.

    With G = k / ((s + p_1)(s + p_2)), p_1 < p_2, and C = k_p (s + p_1) / s the closed loop is
    s^2 + p_2 s + k k_p. placement "radius": k k_p = pole^2 puts both poles on the circle of that
    radius. They are kept at a damping of a half at least, which a slow plant reaches at a smaller
    radius, and are real where p_2 > 2 pole. placement "real": k k_p = pole (p_2 - pole) puts one
    of two real poles there (both at p_2 / 2 where pole is beyond p_2). Gains are capped at the full
    yaw moment for 0.01 rad (near the speed where the yaw moment does not move beta, k is nearly
    zero).

    Raises ValueError for another placement, ModuleNotFoundError without python-control (the extra
    `design`).
    """
    if placement not in PLACEMENTS:
        raise ValueError(f"placement is one of {', '.join(PLACEMENTS)}, got {placement!r}")
    import control

    model = bicycle(vehicle, speed)
    plant = control.StateSpace(model.A, model.B[:, 1:], [[1.0, 0.0]], 0.0)
    transfer = control.tf(plant)
    k = float(transfer.num[0][0][-1] / transfer.den[0][0][0])
    slow_first = sorted(-float(p.real) for p in plant.poles())
    p_1, p_2 = max(slow_first[0], 0.0), slow_first[1]
    if placement == "radius":
        product = min(pole, p_2) ** 2
    else:
        product = pole * (p_2 - pole) if pole < p_2 else 0.25 * p_2 * p_2
    most = vehicle.yaw_moment_limit / 0.01
    k_p = np.clip(product / k, -most, most) if k != 0.0 else 0.0
    return PI(float(k_p), float(k_p) * p_1)


COMS_PI = PI(-19000.506, -115535.531)
"""What `design_pi` gives for the COMS at 25 km/h: used where python-control is not installed."""


def _pi_table(vehicle: Vehicle, gain: float) -> Array:
    """(len(SPEEDS), 2) of k_p and k_i; one row's gains everywhere without python-control."""
    try:
        gains = [design_pi(vehicle, float(speed)) for speed in SPEEDS]
    except ModuleNotFoundError:
        if vehicle.name != COMS.name:
            raise ModuleNotFoundError(
                "designing two-dof for another car than the COMS needs python-control: "
                "pip install 'sideslip[design]'"
            ) from None
        gains = [COMS_PI] * len(SPEEDS)
    return gain * np.array([(each.k_p, each.k_i) for each in gains])


@jit
def _scheduled(table: Any, v: Any) -> Any:
    """A column of a table over SPEEDS, interpolated at v and held beyond its ends."""
    at = min(max((v - SLOWEST) / 0.5, 0.0), len(table) - 1.000001)
    i = int(at)
    return table[i] + (at - i) * (table[i + 1] - table[i])


@jit
def _feedforward_law(x: Any, car: Any, full_scale: float, action: Any) -> None:
    for n in range(len(x)):
        v = 0.5 * (x[n, 0] + x[n, 1])
        action[n, 0] = _static_gain(car, maximum(v, SLOWEST)) * x[n, 2] / full_scale


@jit
def _two_dof_law(
    x: Any,
    state: Any,
    car: Any,
    k_p: Any,
    k_i: Any,
    full_scale: float,
    wait: int,
    dt: float,
    action: Any,
) -> None:
    """state: integral in N m, decisions until the next update, the action now held."""
    for n in range(len(x)):
        if state[n, 1] > 0.0:
            state[n, 1] -= 1.0
            action[n, 0] = state[n, 2]
            continue
        v = 0.5 * (x[n, 0] + x[n, 1])
        error = x[n, 4] - x[n, 3]
        forward = _static_gain(car, maximum(v, SLOWEST)) * x[n, 2]
        wanted = forward + _scheduled(k_p, v) * error + state[n, 0]
        held = min(max(wanted, -full_scale), full_scale)
        step = _scheduled(k_i, v) * error * dt  # forward Euler
        if wanted == held or (wanted > held) != (step > 0.0):  # else it would wind up further
            state[n, 0] += step
        state[n, 1] = wait - 1.0
        state[n, 2] = held / full_scale
        action[n, 0] = state[n, 2]


class Feedforward(Controller):
    """The yaw moment of tie-vision (24) for the driver's steering command."""

    needs = ("wheel_left", "wheel_right", "steer_command")

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.car = _car(self.nominal)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _feedforward_law(inputs, self.car, self.full_scale, action)


class TwoDof(Controller):
    """Feedforward (24) plus a PI on beta_ref - beta_hat, tie-vision section V.

    rate: "control" updates at every decision of the env, "camera" every 33 ms (held between;
    for a control period that is no divisor of it, the next decision). gain: a factor on the PI.
    Memory: the integral, the decisions until the next update, the held action.

    Raises ValueError for an unknown rate or an env whose observation lacks beta_hat.
    """

    needs = ("wheel_left", "wheel_right", "steer_command", "beta_hat", "beta_ref")
    memory = 3

    def __init__(self, env: gym.Env[Any, Any], rate: str = "control", gain: float = 1.0) -> None:
        super().__init__(env)
        if rate not in ("control", "camera"):
            raise ValueError(f"rate is 'control' or 'camera', got {rate!r}")
        period = self.control_period * TICK
        self.wait = 1 if rate == "control" else max(1, math.ceil(CAMERA_PERIOD / period - 1e-9))
        self.dt = self.wait * period
        self.car = _car(self.nominal)
        self.k_p, self.k_i = np.ascontiguousarray(_pi_table(self.nominal, gain).T)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _two_dof_law(
            inputs,
            state,
            self.car,
            self.k_p,
            self.k_i,
            self.full_scale,
            self.wait,
            self.dt,
            action,
        )
