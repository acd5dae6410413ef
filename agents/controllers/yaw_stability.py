"""ESC as cars have it and sliding mode: yaw rate and sideslip angle are held by the yaw moment."""

import math
from collections import namedtuple
from typing import Any

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum
from ...envs.record import Array
from ...envs.task import (
    LAGGED,
    LIMITED,
    REFERENCES,
    ZERO_SLIP,
    ReferenceParams,
    compute_reference,
    make_reference_params,
)
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import Vehicle
from ..design.pi import (
    BicyclePlant,
    compute_drift,
    compute_plant,
    compute_plant_python,
    compute_steady_yaw_rate,
    make_nominal_car,
)
from ..design.sampled_model import SPEEDS, find_cell
from ..env_info import AnyEnv
from .base import (
    Controller,
    check_positive,
    integrate_antiwindup,
    list_entry_names,
)
from .model_following import MIN_SPEED

BANDWIDTH = 16.0  # rad/s, double pole of the yaw-rate loop
_RELEASE = 0.5  # s, time constant by which the integral decays within the dead band

EscInputs = namedtuple("EscInputs", "wheel_left wheel_right steer_command gyro beta_hat")
"""Columns of the law's inputs; the last one only where the sideslip angle is bounded."""
ESC_IN = EscInputs(*range(5))


def _compute_yaw_gains(
    vehicle: Vehicle, speed: float, bandwidth: float = BANDWIDTH
) -> tuple[float, float]:
    """Compute k_p (N m s/rad) and k_i (N m/rad) of the yaw moment on the yaw rate's error."""
    # both poles at the bandwidth (rad/s): s^2 + (k_p / I - a22) s + k_i / I = (s + bandwidth)^2;
    # where the yaw equation's own damping is more, k_p is zero
    I = vehicle.yaw_inertia  # noqa: E741
    a22 = compute_plant_python(make_nominal_car(vehicle), speed).a22
    return max(I * (2.0 * bandwidth + a22), 0.0), I * bandwidth * bandwidth


@jit
def _apply_dead_zone(value: Scalar, band: Scalar) -> Scalar:
    """Compute the part of a value outside of +-band, with its sign; 0 inside."""
    if value > band:
        return value - band
    if value < -band:
        return value + band
    return 0.0


@jit
def _esc_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: tuple[Any, ...]
) -> None:
    """Compute the actions from `EscInputs` x; the state is the integral (N m)."""
    target, speeds, gains, band, max_sideslip, stiffness, bounded, full_scale, dt = design
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, ESC_IN.wheel_left] + x[n, ESC_IN.wheel_right]), speeds[0])
        i, share = find_cell(speeds, v)
        k_p = (1.0 - share) * gains[i, 0] + share * gains[i + 1, 0]
        k_i = (1.0 - share) * gains[i, 1] + share * gains[i + 1, 1]
        _, gamma_ref = compute_reference(x[n, ESC_IN.steer_command], v, target, LIMITED)
        error = _apply_dead_zone(gamma_ref - x[n, ESC_IN.gyro], band)
        unlimited = k_p * error + state[n, 0]
        if bounded:  # more yaw rate to the side the car slides to: beta' = ... - gamma
            unlimited += stiffness * _apply_dead_zone(x[n, ESC_IN.beta_hat], max_sideslip)
        limit = max_share[n] * full_scale
        N_z = min(max(unlimited, -limit), limit)
        state[n, 0] = integrate_antiwindup(state[n, 0], k_i * error * dt, unlimited, N_z)
        if absolute(error) == 0.0:
            state[n, 0] -= state[n, 0] * dt / _RELEASE
        action[n, 0] = N_z / full_scale


class Esc(Controller):
    """Yaw-rate control with a dead band, and a bound on the sideslip angle.

    The yaw rate follows that of the nominal car within what friction holds, |gamma| <= 0.85 mu g /
    v, under every reference of the env. The PI acts outside of the dead band, within which its
    integral decays. Beyond the bound of the sideslip angle a moment drives beta back, where the
    observation has beta_hat. Source: Rajamani, Vehicle Dynamics and Control, 8.2.

    Args:
        env: Env of the controller.
        bandwidth: Double pole of the yaw-rate loop (rad/s).
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
        self.needs = EscInputs._fields if bounded else EscInputs._fields[:-1]
        super().__init__(env, grip)
        bandwidth, slip = check_positive("bandwidth", bandwidth), check_positive("slip", slip)
        if not 0.0 <= band < math.inf:
            raise ValueError(f"band is zero or more, in rad/s, got {band!r}")
        self._design = (
            make_reference_params(self.nominal),
            np.array(SPEEDS),
            np.array([_compute_yaw_gains(self.nominal, v, bandwidth) for v in SPEEDS]),
            float(band),
            slip,
            self.full_scale / slip
            if stiffness is None
            else check_positive("stiffness", stiffness, allow_zero=True),
            int(bounded),
            self.full_scale,
            self.control_period * TICK,
        )

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _esc_law(inputs, state, action, self._compute_max_moment(inputs), self._design)


SlidingModeInputs = namedtuple(
    "SlidingModeInputs",
    "wheel_left wheel_right steer_command steer beta_ref gamma_ref beta_hat gamma_hat",
)
"""Columns of the law's inputs; gamma_hat is the gyro where the observation has no estimate."""
Memory = namedtuple("Memory", "beta_ref gamma_ref known")
"""The references of the last decision, for their derivatives, and whether there was one."""

SLIDING_IN = SlidingModeInputs(*range(8))
LAST = Memory(*range(3))


@jit
def _compute_surface_slope(plant: BicyclePlant, pole: Scalar) -> Scalar:
    """Compute xi (1/s) of the surface s = 0, on which beta's error decays at `pole` (rad/s)."""
    # on s = 0, beta' = a11 beta + a12 gamma makes the pole of beta's error a11 - a12 xi
    return (plant.a11 + pole) / plant.a12


@jit
def _compute_reference(
    x: Vector, v: Scalar, plant: BicyclePlant, target: ReferenceParams, kind: int
) -> tuple[Scalar, Scalar]:
    """Compute (beta_ref, gamma_ref) of a row; a free yaw rate is that which keeps beta_ref."""
    if kind == LAGGED:  # then the observation has it
        return x[SLIDING_IN.beta_ref], x[SLIDING_IN.gamma_ref]
    beta, gamma = compute_reference(x[SLIDING_IN.steer_command], v, target, kind)
    if kind == ZERO_SLIP:
        gamma = compute_steady_yaw_rate(plant, beta, x[SLIDING_IN.steer])
    return beta, gamma


@jit
def _sliding_mode_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: tuple[Any, ...]
) -> None:
    """Compute the actions from `SlidingModeInputs` x and update the `Memory` state."""
    car, target, kind, pole, rate, layer, full_scale, dt = design
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, SLIDING_IN.wheel_left] + x[n, SLIDING_IN.wheel_right]), MIN_SPEED)
        plant = compute_plant(car, v)
        beta, gamma = x[n, SLIDING_IN.beta_hat], x[n, SLIDING_IN.gamma_hat]
        delta = x[n, SLIDING_IN.steer]
        xi = _compute_surface_slope(plant, pole)
        beta_ref, gamma_ref = _compute_reference(x[n], v, plant, target, kind)
        beta_ref_rate, gamma_ref_rate = 0.0, 0.0  # the references' derivatives
        if state[n, LAST.known] > 0.0:
            beta_ref_rate = (beta_ref - state[n, LAST.beta_ref]) / dt
            gamma_ref_rate = (gamma_ref - state[n, LAST.gamma_ref]) / dt
        s = gamma - gamma_ref + xi * (beta - beta_ref)
        drift_rates = compute_drift(plant, beta, gamma)
        s_rate = drift_rates[1] + plant.b21 * delta - gamma_ref_rate
        # s' without the yaw moment
        s_rate += xi * (drift_rates[0] + plant.b11 * delta - beta_ref_rate)
        reach = rate * layer * min(max(s / layer, -1.0), 1.0)
        N_z = -(s_rate + reach) / plant.b22  # Rajamani 8.3: equivalent control and boundary layer
        state[n, LAST.beta_ref], state[n, LAST.gamma_ref] = beta_ref, gamma_ref
        state[n, LAST.known] = 1.0
        action[n, 0] = min(max(N_z / full_scale, -max_share[n]), max_share[n])


class SlidingMode(Controller):
    """s = gamma - gamma_ref + xi (beta - beta_ref) to zero by the yaw moment.

    The equivalent control of the nominal car at the measured speed keeps s constant. Within the
    boundary layer s decays at `rate`, outside at rate x layer (rad/s2). xi makes beta's error decay
    at `pole`. Where the yaw rate is not judged, gamma_ref is the yaw rate that keeps beta_ref.
    Reads beta_hat, and gamma_hat or else the gyro.
    Source: Rajamani, Vehicle Dynamics and Control, 8.3.

    Args:
        env: Env of the controller, with beta_hat in its observation.
        pole: Decay rate of beta's error on s = 0 (rad/s).
        rate: Decay rate of s within the boundary layer (rad/s).
        layer: Half width of the boundary layer (rad/s).
        grip: Grip limit, as for `Controller`.
    """

    memory = len(Memory._fields)

    def __init__(
        self,
        env: AnyEnv,
        pole: float = 15.0,
        rate: float = 40.0,
        layer: float = 0.2,
        grip: float | None = None,
    ) -> None:
        yaw_rate = "gamma_hat" if "gamma_hat" in list_entry_names(env) else "gyro"
        self.needs = (*SlidingModeInputs._fields[: SLIDING_IN.gamma_hat], yaw_rate)
        super().__init__(env, grip)
        self.pole, self.rate = check_positive("pole", pole), check_positive("rate", rate)
        self._design = (
            make_nominal_car(self.nominal),
            make_reference_params(self.nominal),
            REFERENCES.index(self.reference),
            self.pole,
            self.rate,
            check_positive("layer", layer),
            self.full_scale,
            self.control_period * TICK,
        )

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _sliding_mode_law(inputs, state, action, self._compute_max_moment(inputs), self._design)
