"""tie-vision's two-degree-of-freedom controller: feedforward (24) and a PI on the sideslip angle.

Both are designed from the nominal vehicle and scheduled by the measured speed, the mean of the two
front wheel speeds: the feedforward by its formula, the PI on a grid of speeds.
"""

import math
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum, select
from ...envs.ticks import TICK
from ...envs.vehicle.vehicle import COMS, Vehicle
from ..design.pi import COMS_PI, PLACEMENTS, POLE, design_pi, sample_pi
from ..env_facts import AnyEnv
from .base import Array, Controller

SLOWEST = 2.0  # m/s: gains below it are those of this speed
SPEEDS = np.arange(SLOWEST, 61.0, 0.5)  # m/s
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


def _pi_table(
    vehicle: Vehicle, gain: float, pole: float, placement: str, period: float | None
) -> Array:
    """(len(SPEEDS), 2) of k_p and k_i; one row's gains everywhere without python-control."""
    try:
        if period is None:
            gains = [design_pi(vehicle, float(v), pole, placement) for v in SPEEDS]
        else:
            gains = [sample_pi(vehicle, float(v), period, pole, placement) for v in SPEEDS]
    except ModuleNotFoundError:
        if vehicle.name != COMS.name or pole != POLE or placement != PLACEMENTS[0]:
            raise ModuleNotFoundError(
                "designing two-dof for another car or pole than the shipped one needs "
                "python-control: "
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

    def __init__(self, env: AnyEnv) -> None:
        super().__init__(env)
        self.car = _car(self.nominal)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _feedforward_law(inputs, self.car, self.full_scale, action)


class TwoDof(Controller):
    """Feedforward (24) plus a PI on beta_ref - beta_hat, tie-vision section V.

    rate: "control" updates at every decision of the env, "camera" every 33 ms (held between;
    for a control period that is no divisor of it, the next decision). gain: a factor on the PI.
    pole (rad/s), placement: of `design_pi`. sampled: place the poles of the loop as sampled at
    that rate (`sample_pi`) instead of the continuous one's. Memory: the integral, the decisions
    until the next update, the held action.

    Raises ValueError for an unknown rate or placement or an env whose observation lacks beta_hat.
    """

    needs = ("wheel_left", "wheel_right", "steer_command", "beta_hat", "beta_ref")
    memory = 3

    def __init__(
        self,
        env: AnyEnv,
        rate: str = "control",
        gain: float = 1.0,
        pole: float = POLE,
        placement: str = PLACEMENTS[0],
        sampled: bool = False,
    ) -> None:
        super().__init__(env)
        if rate not in ("control", "camera"):
            raise ValueError(f"rate is 'control' or 'camera', got {rate!r}")
        period = self.control_period * TICK
        self.wait = 1 if rate == "control" else max(1, math.ceil(CAMERA_PERIOD / period - 1e-9))
        self.dt = self.wait * period
        self.car = _car(self.nominal)
        table = _pi_table(self.nominal, gain, pole, placement, self.dt if sampled else None)
        self.k_p, self.k_i = np.ascontiguousarray(table.T)

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
