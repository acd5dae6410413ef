"""ESC as cars have it: the yaw rate is held near what driver and friction ask for, slip bounded."""

import math
from collections import namedtuple
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum
from ...envs.record import Array
from ...envs.task.reference import LIMITED, compute_reference, make_reference_params
from ...envs.ticks import TICK
from ...envs.vehicle.vehicle import Vehicle
from ..design.gain_schedule import SPEEDS, find_cell
from ..design.nominal_car import compute_plant_python, make_nominal_car
from ..env_facts import AnyEnv
from .base import (
    Controller,
    check_not_negative,
    check_positive,
    integrate_antiwindup,
    list_entry_names,
)

BANDWIDTH = 16.0  # rad/s
RELEASE = 0.5  # s, in which the integral is let go within the dead band


Inputs = namedtuple("Inputs", "wheel_left wheel_right steer_command gyro beta_hat")
"""Columns of the law's inputs; the last one only where the slip is bounded."""


IN = Inputs(*range(5))


def compute_yaw_gains(
    vehicle: Vehicle, speed: float, bandwidth: float = BANDWIDTH
) -> tuple[float, float]:
    """Compute k_p (N m s/rad) and k_i (N m/rad) of the yaw moment on the yaw rate's error.

    Both poles of the yaw equation with its own damping are at the bandwidth:
    s^2 + (k_p / I - a22) s + k_i / I = (s + bandwidth)^2.
    Where the damping alone is more, k_p is zero.

    Args:
        vehicle: Vehicle of the design.
        speed: Speed (m/s).
        bandwidth: Double pole of the closed loop (rad/s).

    Returns:
        Gains k_p and k_i.
    """
    I = vehicle.yaw_inertia  # noqa: E741
    a22 = compute_plant_python(make_nominal_car(vehicle), speed).a22
    return max(I * (2.0 * bandwidth + a22), 0.0), I * bandwidth * bandwidth


@jit
def apply_dead_zone(value: Any, band: Any) -> Any:
    """Compute the part of a value outside of a dead zone, with its sign.

    Args:
        value: Value of any unit.
        band: Half width of the zone, in the same unit.

    Returns:
        Excess over the zone, 0 inside.
    """
    if value > band:
        return value - band
    if value < -band:
        return value + band
    return 0.0


@jit
def _esc_law(
    x: Any,
    state: Any,
    action: Any,
    max_moment: Any,
    target: Any,
    speeds: Any,
    gains: Any,
    band: float,
    slip: float,
    stiffness: float,
    bounded: int,
    full_scale: float,
    dt: float,
) -> None:
    """x: `Inputs`. state: the integral in N m."""
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, IN.wheel_left] + x[n, IN.wheel_right]), speeds[0])
        i, share = find_cell(speeds, v)
        k_p = (1.0 - share) * gains[i, 0] + share * gains[i + 1, 0]
        k_i = (1.0 - share) * gains[i, 1] + share * gains[i + 1, 1]
        _, gamma_ref = compute_reference(x[n, IN.steer_command], v, target, LIMITED)
        error = apply_dead_zone(gamma_ref - x[n, IN.gyro], band)
        unlimited = k_p * error + state[n, 0]
        if bounded:  # more yaw rate to the side the car slides to: beta' = ... - gamma
            unlimited += stiffness * apply_dead_zone(x[n, IN.beta_hat], slip)
        limit = max_moment[n] * full_scale
        N_z = min(max(unlimited, -limit), limit)
        state[n, 0] = integrate_antiwindup(state[n, 0], k_i * error * dt, unlimited, N_z)
        if absolute(error) == 0.0:
            state[n, 0] -= state[n, 0] * dt / RELEASE
        action[n, 0] = N_z / full_scale


class Esc(Controller):
    """Yaw-rate control with a dead band, and a bound on the sideslip angle.

    The yaw rate follows that of the nominal car within what friction holds, |gamma| <= 0.85 mu g /
    v, under every reference of the env. The PI acts outside of the dead band, within which its
    integral decays. Beyond the bound of the slip a moment drives beta back, where the observation
    has beta_hat. Source: Rajamani, Vehicle Dynamics and Control, 8.2.

    Args:
        env: Env of the controller.
        bandwidth: Double pole of the yaw-rate loop (rad/s), as for `compute_yaw_gains`.
        band: Half width of the yaw rate's dead band (rad/s).
        slip: Bound of the sideslip angle (rad).
        stiffness: Yaw moment per angle beyond the bound (N m/rad); None: full moment at twice it.
        grip: Grip limit, as for `Controller`.

    Raises:
        ValueError: An option is out of range.
    """

    memory = 1

    def __init__(
        self,
        env: AnyEnv,
        bandwidth: float = BANDWIDTH,
        band: float = 0.02,
        slip: float = 0.05,
        stiffness: float | None = None,
        grip: float | None = None,
    ) -> None:
        bounded = "beta_hat" in list_entry_names(env)
        self.needs = Inputs._fields if bounded else Inputs._fields[:-1]
        super().__init__(env, grip)
        bandwidth, slip = check_positive("bandwidth", bandwidth), check_positive("slip", slip)
        if not 0.0 <= band < math.inf:
            raise ValueError(f"band is zero or more, in rad/s, got {band!r}")
        self._design = (
            make_reference_params(self.nominal),
            np.array(SPEEDS),
            np.array([compute_yaw_gains(self.nominal, v, bandwidth) for v in SPEEDS]),
            float(band),
            slip,
            self.full_scale / slip
            if stiffness is None
            else check_not_negative("stiffness", stiffness),
            int(bounded),
            self.full_scale,
            self.control_period * TICK,
        )

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _esc_law(inputs, state, action, self._compute_max_moment(inputs), *self._design)
