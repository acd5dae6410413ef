"""Sliding mode: the yaw moment keeps errors of yaw rate and sideslip angle on one line."""

from collections import namedtuple
from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import maximum
from ...envs.record import Array
from ...envs.task.reference import (
    LAGGED,
    REFERENCES,
    ZERO_SLIP,
    compute_reference,
    make_reference_params,
)
from ...envs.ticks import TICK
from ..design.nominal_car import (
    compute_drift,
    compute_plant,
    compute_steady_yaw_rate,
    make_nominal_car,
)
from ..env_facts import AnyEnv
from .base import Controller, check_positive, list_entry_names
from .model_following import MIN_SPEED

Inputs = namedtuple(
    "Inputs", "wheel_left wheel_right steer_command steer beta_ref gamma_ref beta_hat gamma_hat"
)
"""Columns of the law's inputs; gamma_hat is the gyro where the observation has no estimate."""
Memory = namedtuple("Memory", "beta_ref gamma_ref known")
"""The references of the last decision, for their derivatives, and whether there was one."""


IN = Inputs(*range(8))
LAST = Memory(*range(3))


@jit
def compute_surface_slope(plant: Any, pole: Any) -> Any:
    """Compute xi of s = gamma - gamma_ref + xi (beta - beta_ref), for an error's pole on s = 0.

    There beta' = a11 beta + a12 gamma makes the pole of beta's error a11 - a12 xi. With a12 near
    -1, xi is negative where the error shall decay faster than the car's own.

    Args:
        plant: `BicyclePlant` at the speed.
        pole: Decay rate of beta's error (rad/s).

    Returns:
        Slope xi (1/s).
    """
    return (plant.a11 + pole) / plant.a12


@jit
def _compute_reference(x: Any, v: Any, plant: Any, target: Any, kind: int) -> Any:
    """Compute (beta_ref, gamma_ref) of a row.

    A lagged reference is the observation's. Where the yaw rate is free, it is the one that keeps
    beta_ref.
    """
    if kind == LAGGED:
        return x[IN.beta_ref], x[IN.gamma_ref]
    beta, gamma = compute_reference(x[IN.steer_command], v, target, kind)
    if kind == ZERO_SLIP:
        gamma = compute_steady_yaw_rate(plant, beta, x[IN.steer])
    return beta, gamma


@jit
def _sliding_mode_law(
    x: Any,
    state: Any,
    action: Any,
    max_moment: Any,
    car: Any,
    target: Any,
    kind: int,
    pole: float,
    rate: float,
    layer: float,
    full_scale: float,
    dt: float,
) -> None:
    """x: `Inputs`. state: `Memory`."""
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, IN.wheel_left] + x[n, IN.wheel_right]), MIN_SPEED)
        plant = compute_plant(car, v)
        beta, gamma, delta = x[n, IN.beta_hat], x[n, IN.gamma_hat], x[n, IN.steer]
        xi = compute_surface_slope(plant, pole)
        beta_ref, gamma_ref = _compute_reference(x[n], v, plant, target, kind)
        beta_ref_rate, gamma_ref_rate = 0.0, 0.0  # the references' derivatives
        if state[n, LAST.known] > 0.0:
            beta_ref_rate = (beta_ref - state[n, LAST.beta_ref]) / dt
            gamma_ref_rate = (gamma_ref - state[n, LAST.gamma_ref]) / dt
        s = gamma - gamma_ref + xi * (beta - beta_ref)
        drift_rates = compute_drift(plant, beta, gamma)
        s_rate = drift_rates[1] + plant.b21 * delta - gamma_ref_rate
        s_rate += xi * (
            drift_rates[0] + plant.b11 * delta - beta_ref_rate
        )  # s' without the yaw moment
        reach = rate * layer * min(max(s / layer, -1.0), 1.0)
        N_z = -(s_rate + reach) / plant.b22  # Rajamani 8.3: equivalent control and boundary layer
        state[n, LAST.beta_ref], state[n, LAST.gamma_ref] = beta_ref, gamma_ref
        state[n, LAST.known] = 1.0
        action[n, 0] = min(max(N_z / full_scale, -max_moment[n]), max_moment[n])


class SlidingMode(Controller):
    """s = gamma - gamma_ref + xi (beta - beta_ref) to zero by the yaw moment.

    The equivalent control of the nominal car at the measured speed keeps s constant. Within the
    boundary layer s decays at `rate`, outside at rate x layer (rad/s2). xi is
    `compute_surface_slope`. Where the yaw rate is not judged, gamma_ref is the yaw rate that keeps
    beta_ref. Reads beta_hat, and gamma_hat or else the gyro.
    Source: Rajamani, Vehicle Dynamics and Control, 8.3.

    Args:
        env: Env of the controller, with beta_hat in its observation.
        pole: Decay rate of beta's error on s = 0 (rad/s).
        rate: Decay rate of s within the boundary layer (rad/s).
        layer: Half width of the boundary layer (rad/s).
        grip: Grip limit, as for `Controller`.

    Raises:
        ValueError: An option is not positive, or the observation lacks beta_hat.
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
        self.needs = (*Inputs._fields[: IN.gamma_hat], yaw_rate)
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
        _sliding_mode_law(inputs, state, action, self._compute_max_moment(inputs), *self._design)
