"""Controllers of yaw rate and sideslip angle: ESC, sliding mode, and following of a model.

The laws compute the nominal car's plant at the measured speed, the mean of the two front wheels'.
Papers' short names, such as dakf-stability, are those of docs/PAPERS.md.
"""

import math
from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import jit
from ...envs.numerics.packed import read, write
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum
from ...envs.task import LAGGED, LIMITED, ZERO_SLIP, ReferenceParams, compute_reference
from ...envs.vehicle.linear import BicyclePlant, compute_bicycle_coefficients, make_bicycle_model
from ...envs.vehicle.parameters import Vehicle
from ..design.sampled_model import SPEEDS, find_cell
from ..env_info import AnyEnv, get_env_facts
from .base import Controller, check_positive, integrate_antiwindup

BANDWIDTH = 16.0  # rad/s, double pole of the yaw-rate loop
MODEL_BANDWIDTH = (5.0, 5.0)  # rad/s, K_beta and K_gamma of dakf-stability V.D
_MIN_SPEED = 2.0  # m/s: below it the vehicle is taken as at this speed
_RELEASE = 0.5  # s, time constant by which the integral decays within the dead band


@jit
def _compute_drift(plant: BicyclePlant, beta: Scalar, gamma: Scalar) -> tuple[Scalar, Scalar]:
    """Compute A [beta, gamma], the rates without inputs."""
    return plant.a11 * beta + plant.a12 * gamma, plant.a21 * beta + plant.a22 * gamma


@jit
def _compute_steady_yaw_rate(plant: BicyclePlant, beta: Scalar, delta: Scalar) -> Scalar:
    """Compute the yaw rate (rad/s) that keeps a sideslip angle at a steering angle (rad)."""
    return -(plant.a11 * beta + plant.b11 * delta) / plant.a12


@jit
def _solve_inputs(plant: BicyclePlant, first: Scalar, second: Scalar) -> tuple[Scalar, Scalar]:
    """Solve B u = [first, second] for steering (rad) and yaw moment (N m): dakf-stability (26)."""
    delta_f = first / plant.b11
    return delta_f, (second - plant.b21 * delta_f) / plant.b22


# Columns of the law's inputs; the gyro stands in for a sideslip angle that is not bounded.
EscInputs = namedtuple("EscInputs", "wheel_left wheel_right steer_command gyro beta_hat")
ESC_IN = EscInputs(*range(5))


def _compute_yaw_gains(vehicle: Vehicle, speed: float, bandwidth: float) -> tuple[float, float]:
    """Compute k_p (N m s/rad) and k_i (N m/rad) of the yaw moment on the yaw rate's error."""
    # both poles at the bandwidth (rad/s): s^2 + (k_p / I - a22) s + k_i / I = (s + bandwidth)^2;
    # where the yaw equation's own damping is more, k_p is zero
    I = vehicle.yaw_inertia  # noqa: E741
    a22 = float(make_bicycle_model(vehicle, speed).A[1, 1])
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
def _esc_law(x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: Any) -> None:
    """Compute the actions from `EscInputs` x; the state is the integral (N m)."""
    target, speeds, gains, band, max_sideslip, stiffness, bounded, full_scale, dt = design
    for n in range(len(x)):
        row = read(x[n], ESC_IN)
        v = maximum(0.5 * (row.wheel_left + row.wheel_right), speeds[0])
        i, share = find_cell(speeds, v)
        k_p = (1.0 - share) * gains[i, 0] + share * gains[i + 1, 0]
        k_i = (1.0 - share) * gains[i, 1] + share * gains[i + 1, 1]
        _, gamma_ref = compute_reference(row.steer_command, v, target, LIMITED)
        error = _apply_dead_zone(gamma_ref - row.gyro, band)
        unlimited = k_p * error + state[n, 0]
        if bounded:  # more yaw rate to the side the car slides to: beta' = ... - gamma
            unlimited += stiffness * _apply_dead_zone(row.beta_hat, max_sideslip)
        limit = max_share[n] * full_scale
        N_z = min(max(unlimited, -limit), limit)
        state[n, 0] = integrate_antiwindup(state[n, 0], k_i * error * dt, unlimited, N_z)
        if absolute(error) == 0.0:
            state[n, 0] -= state[n, 0] * min(dt, _RELEASE) / _RELEASE
        action[n, 0] = N_z / full_scale


class Esc(Controller):
    """Yaw-rate control with a dead band, and a bound on the sideslip angle.

    The yaw rate follows that of the nominal car within what friction holds, |gamma| <= 0.85 mu g /
    v, under every reference of the env. The PI acts outside of the dead band, within which its
    integral decays. Beyond the bound of the sideslip angle a moment drives beta back, where the
    observation has beta_hat. An option out of range is a ValueError. Source: Rajamani, Vehicle
    Dynamics and Control, 8.2.

    Args:
        env: Env of the controller.
        bandwidth: Double pole of the yaw-rate loop (rad/s).
        band: Half width of the yaw rate's dead band (rad/s).
        slip: Bound of the sideslip angle (rad); at twice it the moment is the full one.
        grip: Grip limit, as for `Controller`.
    """

    law = staticmethod(_esc_law)
    memory = 1

    def __init__(
        self, env: AnyEnv, bandwidth: float = BANDWIDTH, band: float = 0.02, slip: float = 0.05,
        grip: float | None = None,
    ) -> None:  # fmt: skip
        bounded = "beta_hat" in get_env_facts(env).names
        self.needs = (*EscInputs._fields[:-1], "beta_hat" if bounded else "gyro")
        super().__init__(env, grip)
        bandwidth, slip = check_positive("bandwidth", bandwidth), check_positive("slip", slip)
        band = check_positive("band", band, allow_zero=True)
        bound = slip, self.full_scale / slip, int(bounded)
        gains = np.array([_compute_yaw_gains(self.nominal, v, bandwidth) for v in SPEEDS])
        scales, table = (self.full_scale, self.control_period * TICK), (np.array(SPEEDS), gains)
        self._design = self._target, *table, band, *bound, *scales


# Columns of the law's inputs; gamma_hat is the gyro where the observation has no estimate.
SlidingModeInputs = namedtuple("SlidingModeInputs", "wheel_left wheel_right steer_command steer "
                               "beta_ref gamma_ref beta_hat gamma_hat")  # fmt: skip
# The references of the last decision, for their derivatives, and whether there was one.
SlidingModeMemory = namedtuple("SlidingModeMemory", "beta_ref gamma_ref known")
SLIDING_IN, SLIDING_LAST = SlidingModeInputs(*range(8)), SlidingModeMemory(*range(3))


@jit
def _compute_surface_slope(plant: BicyclePlant, pole: Scalar) -> Scalar:
    """Compute xi (1/s) of the surface s = 0, on which beta's error decays at `pole` (rad/s)."""
    # on s = 0, beta' = a11 beta + a12 gamma makes the pole of beta's error a11 - a12 xi
    return (plant.a11 + pole) / plant.a12


@jit
def _compute_reference(
    row: SlidingModeInputs, v: Scalar, plant: BicyclePlant, target: ReferenceParams, kind: int
) -> tuple[Scalar, Scalar]:
    """Compute (beta_ref, gamma_ref) of a row; a free yaw rate is that which keeps beta_ref."""
    if kind == LAGGED:  # then the observation has it
        return row.beta_ref, row.gamma_ref
    beta, gamma = compute_reference(row.steer_command, v, target, kind)
    if kind == ZERO_SLIP:
        gamma = _compute_steady_yaw_rate(plant, beta, row.steer)
    return beta, gamma


@jit
def _sliding_mode_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: tuple[Any, ...]
) -> None:
    """Compute the actions from `SlidingModeInputs` x and update the `SlidingModeMemory` state."""
    car, target, kind, pole, rate, layer, full_scale, dt = design
    for n in range(len(x)):
        row, last = read(x[n], SLIDING_IN), read(state[n], SLIDING_LAST)
        v = maximum(0.5 * (row.wheel_left + row.wheel_right), _MIN_SPEED)
        plant = compute_bicycle_coefficients(car, v)
        xi = _compute_surface_slope(plant, pole)
        beta_ref, gamma_ref = _compute_reference(row, v, plant, target, kind)
        beta_ref_rate, gamma_ref_rate = 0.0, 0.0  # the references' derivatives
        if last.known > 0.0:
            beta_ref_rate = (beta_ref - last.beta_ref) / dt
            gamma_ref_rate = (gamma_ref - last.gamma_ref) / dt
        s = row.gamma_hat - gamma_ref + xi * (row.beta_hat - beta_ref)
        beta_rate, gamma_rate = _compute_drift(plant, row.beta_hat, row.gamma_hat)
        s_rate = gamma_rate + plant.b21 * row.steer - gamma_ref_rate  # s' without the yaw moment
        s_rate += xi * (beta_rate + plant.b11 * row.steer - beta_ref_rate)
        reach = rate * layer * min(max(s / layer, -1.0), 1.0)
        N_z = -(s_rate + reach) / plant.b22  # Rajamani 8.3: equivalent control and boundary layer
        write(state[n], SlidingModeMemory(beta_ref, gamma_ref, 1.0), SLIDING_LAST)
        action[n, 0] = min(max(N_z / full_scale, -max_share[n]), max_share[n])


class SlidingMode(Controller):
    """s = gamma - gamma_ref + xi (beta - beta_ref) to zero by the yaw moment.

    The equivalent control of the nominal car at the measured speed keeps s constant. Within the
    boundary layer s decays at `rate`, outside at rate x layer (rad/s2). xi makes beta's error decay
    at `pole`. Where the yaw rate is not judged, gamma_ref is the yaw rate that keeps beta_ref.
    Reads beta_hat, and gamma_hat or else the gyro. Source: Rajamani, Vehicle Dynamics, 8.3.

    Args:
        env: Env of the controller, with beta_hat in its observation.
        pole: Decay rate of beta's error on s = 0 (rad/s).
        rate: Decay rate of s within the boundary layer (rad/s).
        layer: Half width of the boundary layer (rad/s).
        grip: Grip limit, as for `Controller`.
    """

    law = staticmethod(_sliding_mode_law)
    memory = len(SlidingModeMemory._fields)

    def __init__(
        self, env: AnyEnv, pole: float = 15.0, rate: float = 40.0, layer: float = 0.2,
        grip: float | None = None,
    ) -> None:  # fmt: skip
        yaw_rate = "gamma_hat" if "gamma_hat" in get_env_facts(env).names else "gyro"
        self.needs = (*SlidingModeInputs._fields[: SLIDING_IN.gamma_hat], yaw_rate)
        super().__init__(env, grip)
        self.pole, self.rate = check_positive("pole", pole), check_positive("rate", rate)
        surface = self.pole, self.rate, check_positive("layer", layer)
        scales = self.full_scale, self.control_period * TICK
        self._design = self._bicycle, self._target, self._reference_kind, *surface, *scales


# Columns of the law's inputs; what the observation lacks is put in by `ModelFollowing`.
ModelInputs = namedtuple("ModelInputs", "wheel_left wheel_right steer_command beta_ref gamma_ref "
                         "beta_hat gamma_hat d1_hat d2_hat")  # fmt: skip
# Integrals of steering (rad) and yaw moment (N m), the driver's last command (rad), if any.
ModelMemory = namedtuple("ModelMemory", "delta_f_sum N_z_sum driver known")
MODEL_IN, MODEL_LAST = ModelInputs(*range(9)), ModelMemory(*range(4))


@jit
def _model_following_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: tuple[Any, ...]
) -> None:
    """Compute the actions from `ModelInputs` x and update the `ModelMemory` state."""
    # K: K_beta and K_gamma (rad/s), rejection: 1 or 0 for (26), max_share: of full scale
    car, target, kind, K, rejection, full_scale, authority, dt = design
    for n in range(len(x)):
        row, last = read(x[n], MODEL_IN), read(state[n], MODEL_LAST)
        v = maximum(0.5 * (row.wheel_left + row.wheel_right), _MIN_SPEED)
        driver, beta_ref, gamma_ref = row.steer_command, row.beta_ref, row.gamma_ref
        plant = compute_bicycle_coefficients(car, v)
        last_driver = last.driver if last.known > 0.0 else driver
        old = compute_reference(last_driver, v, target, kind)
        new = compute_reference(driver, v, target, kind)
        reference_rates = ((new[0] - old[0]) / dt, (new[1] - old[1]) / dt)  # of the references
        if kind == LAGGED:
            approach = (1.0 - target.rest) / TICK
            reference_rates = (approach * (new[0] - beta_ref), approach * (new[1] - gamma_ref))
        if kind == ZERO_SLIP:  # the yaw rate is free: the one that keeps beta_ref
            gamma_ref = _compute_steady_yaw_rate(plant, beta_ref, driver)
            last_gamma_ref = _compute_steady_yaw_rate(plant, beta_ref, last_driver)
            reference_rates = (reference_rates[0], (gamma_ref - last_gamma_ref) / dt)
        drift_rates = _compute_drift(plant, beta_ref, gamma_ref)
        p_beta = K[0] * (beta_ref - row.beta_hat)
        p_gamma = K[1] * (gamma_ref - row.gamma_hat)
        # (28) by the references' derivatives, P of (31), and (26) at once: B^-1 is linear
        delta_f, N_z = _solve_inputs(
            plant,
            reference_rates[0] - drift_rates[0] + p_beta - rejection * row.d1_hat,
            reference_rates[1] - drift_rates[1] + p_gamma - rejection * row.d2_hat,
        )
        delta_f, N_z = delta_f + last.delta_f_sum, N_z + last.N_z_sum  # (33)
        steer = min(max(delta_f, driver - authority), driver + authority)
        limit = max_share[n] * full_scale
        moment = min(max(N_z, -limit), limit)
        drift_rates = _compute_drift(plant, p_beta, p_gamma)  # I of (31), forward Euler
        steps = _solve_inputs(plant, -drift_rates[0] * dt, -drift_rates[1] * dt)
        delta_f_sum = integrate_antiwindup(last.delta_f_sum, steps[0], delta_f, steer)
        N_z_sum = integrate_antiwindup(last.N_z_sum, steps[1], N_z, moment)
        write(state[n], ModelMemory(delta_f_sum, N_z_sum, driver, 1.0), MODEL_LAST)
        action[n, 0] = moment / full_scale
        action[n, 1] = (steer - driver) / authority


class ModelFollowing(Controller):
    """Steering and yaw moment by dakf-stability (33), for an env whose action has both.

    The yaw rate is gamma_hat where the observation has it, else the gyro's. The references are the
    env's, but "zero-slip" takes the yaw rate that keeps beta_ref. Derivatives follow the steering
    at one speed, as the speed's noise would drown a difference. "lagged" has those of its lag.

    An integral holds while its input is at the limit (yaw moment: full scale; steering: the
    authority around the driver's) and the error would push it further out.

    Args:
        env: Env of the controller; ValueError where no action steers or an entry is missing.
        bandwidth: K_beta and K_gamma (rad/s); ValueError for no pair.
        rejection: Whether to subtract the effect of d1_hat and d2_hat, (26).
        grip: Grip limit, as for `Controller`.
    """

    law = staticmethod(_model_following_law)
    memory = len(ModelMemory._fields)

    def __init__(
        self, env: AnyEnv, bandwidth: Sequence[float] = MODEL_BANDWIDTH, rejection: bool = True,
        grip: float | None = None,
    ) -> None:  # fmt: skip
        substitutes = {} if "gamma_hat" in get_env_facts(env).names else {"gamma_hat": "gyro"}
        if not rejection:  # whatever stands there is multiplied by zero
            substitutes |= {"d1_hat": "beta_ref", "d2_hat": "gamma_ref"}
        self.needs = tuple(substitutes.get(name, name) for name in ModelInputs._fields)
        super().__init__(env, grip)
        if self.width != 2:
            raise ValueError("ModelFollowing needs an env whose action steers (steering=True)")
        K = [float(value) for value in bandwidth]
        if len(K) != 2 or not all(0.0 < value < math.inf for value in K):
            raise ValueError(f"bandwidth is two positive numbers in rad/s, got {bandwidth!r}")
        car = self._bicycle, self._target, self._reference_kind, np.array(K), float(rejection)
        self._design = *car, self.full_scale, self.authority, self.control_period * TICK
