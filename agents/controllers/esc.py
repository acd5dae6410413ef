"""ESC as cars have it: the yaw rate is held near what driver and friction ask for, slip bounded."""

import math
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum
from ...envs.task.reference import LIMITED, reference, target_of
from ...envs.ticks import TICK
from ...envs.vehicle.linear import bicycle_coefficients
from ...envs.vehicle.vehicle import Vehicle
from ..design.gain_schedule import SPEEDS, cell
from ..env_facts import AnyEnv, given
from .base import Array, Controller

BANDWIDTH = 16.0  # rad/s
RELEASE = 0.5  # s, in which the integral is let go within the dead band


def yaw_gains(vehicle: Vehicle, speed: float, bandwidth: float = BANDWIDTH) -> tuple[float, float]:
    """(k_p, k_i) of the yaw moment on the yaw rate's error, N m s/rad and N m/rad.

    Both poles of the yaw equation with its own damping at the bandwidth: s^2 + (k_p / I - a22) s +
    k_i / I = (s + bandwidth)^2; where the damping alone is more, k_p is zero.
    """
    car = vehicle
    coefficients = bicycle_coefficients(
        car.mass,
        car.yaw_inertia,
        car.front_arm,
        car.rear_arm,
        car.front_stiffness,
        car.rear_stiffness,
        speed,
    )
    I = car.yaw_inertia  # noqa: E741
    return max(I * (2.0 * bandwidth + coefficients[3]), 0.0), I * bandwidth * bandwidth


@jit
def beyond(value: Any, band: Any) -> Any:
    """What of a value lies outside of +-band, with its sign."""
    if value > band:
        return value - band
    if value < -band:
        return value + band
    return 0.0


@jit
def _esc_law(
    x: Any,
    state: Any,
    target: Any,
    speeds: Any,
    gains: Any,
    band: float,
    slip: float,
    stiffness: float,
    slipping: int,
    full_scale: float,
    dt: float,
    action: Any,
) -> None:
    """x: wheels, steer_command, gyro, beta_hat if slipping. state: integral in N m."""
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, 0] + x[n, 1]), speeds[0])
        i, share = cell(speeds, v)
        k_p = (1.0 - share) * gains[i, 0] + share * gains[i + 1, 0]
        k_i = (1.0 - share) * gains[i, 1] + share * gains[i + 1, 1]
        _, gamma_ref = reference(x[n, 2], v, target, LIMITED)
        error = beyond(gamma_ref - x[n, 3], band)
        wanted = k_p * error + state[n, 0]
        if slipping:  # more yaw rate to the side the car slides to: beta' = ... - gamma
            wanted += stiffness * beyond(x[n, 4], slip)
        held = min(max(wanted, -full_scale), full_scale)
        step = k_i * error * dt
        if wanted == held or (wanted > held) != (step > 0.0):  # else it would wind up further
            state[n, 0] += step
        if absolute(error) == 0.0:
            state[n, 0] -= state[n, 0] * dt / RELEASE
        action[n, 0] = held / full_scale


class Esc(Controller):
    """Yaw-rate control with a dead band, and a bound on the sideslip angle.

    The yaw rate follows that of the nominal car within what friction holds,
    |gamma| <= 0.85 mu g / v (Rajamani, Vehicle Dynamics and Control, 8.2), whatever the env's own
    reference is, by a PI that starts outside +-`band` (rad/s) and lets its integral go within.
    Beyond +-`slip` (rad) a moment of `stiffness` (N m/rad; default: the full moment at twice the
    bound) drives beta back, where the observation has beta_hat; without, it does without.

    bandwidth: rad/s, of `yaw_gains`. Memory: the integral. Raises ValueError for an option out of
    range.
    """

    needs: tuple[str, ...] = ("wheel_left", "wheel_right", "steer_command", "gyro")
    memory = 1

    def __init__(
        self,
        env: AnyEnv,
        bandwidth: float = BANDWIDTH,
        band: float = 0.02,
        slip: float = 0.05,
        stiffness: float | None = None,
    ) -> None:
        self._slipping = any(entry.name == "beta_hat" for entry in given(env).layout)
        if self._slipping:
            self.needs = (*self.needs, "beta_hat")
        super().__init__(env)
        for name, value in (("bandwidth", bandwidth), ("slip", slip)):
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} is a positive number, got {value!r}")
        if not 0.0 <= band < math.inf:
            raise ValueError(f"band is zero or more, in rad/s, got {band!r}")
        self.band, self.slip = float(band), float(slip)
        self.stiffness = self.full_scale / self.slip if stiffness is None else float(stiffness)
        self._speeds = np.array(SPEEDS)
        self._gains = np.array([yaw_gains(self.nominal, v, bandwidth) for v in SPEEDS])
        self._target = target_of(self.nominal)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _esc_law(
            inputs,
            state,
            self._target,
            self._speeds,
            self._gains,
            self.band,
            self.slip,
            self.stiffness,
            int(self._slipping),
            self.full_scale,
            self.control_period * TICK,
            action,
        )
