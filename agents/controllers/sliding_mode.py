"""Sliding mode: the yaw moment keeps errors of yaw rate and sideslip angle on one line."""

import math
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import maximum
from ...envs.task.reference import REFERENCES, ZERO_SLIP, reference, target_of
from ...envs.ticks import TICK
from ..env_facts import AnyEnv, given
from .base import Array, Controller
from .model_following import SLOWEST, _car, _drift, _plant


@jit
def surface(plant: Any, pole: Any) -> Any:
    """xi of s = gamma - gamma_ref + xi (beta - beta_ref): on s = 0 beta's error decays at `pole`.

    There beta' = a11 beta + a12 gamma makes its error's pole a11 - a12 xi. With a12 near -1, xi is
    negative where the error shall decay faster than the car's own.
    """
    return (plant[0] + pole) / plant[1]


@jit
def _goal(driver: Any, delta: Any, v: Any, plant: Any, target: Any, kind: int) -> Any:
    """(beta_ref, gamma_ref); where the yaw rate is free, that which keeps beta_ref."""
    beta, gamma = reference(driver, v, target, kind)
    if kind == ZERO_SLIP:
        gamma = -(plant[0] * beta + plant[4] * delta) / plant[1]
    return beta, gamma


@jit
def _sliding_mode_law(
    x: Any,
    state: Any,
    car: Any,
    target: Any,
    kind: int,
    pole: float,
    rate: float,
    layer: float,
    full_scale: float,
    dt: float,
    action: Any,
) -> None:
    """x: wheels, steer_command, steer, beta, gamma.

    state: beta_ref and gamma_ref of the last decision, and whether there was one.
    """
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, 0] + x[n, 1]), SLOWEST)
        plant = _plant(car, v)
        beta, gamma, delta = x[n, 4], x[n, 5], x[n, 3]
        xi = surface(plant, pole)
        beta_ref, gamma_ref = _goal(x[n, 2], delta, v, plant, target, kind)
        moves_beta, moves_gamma = 0.0, 0.0  # the references' derivatives
        if state[n, 2] > 0.0:
            moves_beta, moves_gamma = (beta_ref - state[n, 0]) / dt, (gamma_ref - state[n, 1]) / dt
        s = gamma - gamma_ref + xi * (beta - beta_ref)
        drift = _drift(plant, beta, gamma)
        free = drift[1] + plant[5] * delta - moves_gamma
        free += xi * (drift[0] + plant[4] * delta - moves_beta)  # s' without the yaw moment
        reach = rate * layer * min(max(s / layer, -1.0), 1.0)
        N_z = -(free + reach) / plant[6]  # Rajamani 8.3: equivalent control and boundary layer
        state[n, 0], state[n, 1], state[n, 2] = beta_ref, gamma_ref, 1.0
        action[n, 0] = min(max(N_z / full_scale, -1.0), 1.0)


class SlidingMode(Controller):
    """s = gamma - gamma_ref + xi (beta - beta_ref) to zero by the yaw moment.

    Rajamani, Vehicle Dynamics and Control, 8.3: the equivalent control of the nominal car at the
    measured speed keeps s constant, and within a boundary layer of `layer` rad/s s decays at `rate`
    rad/s (outside at rate x layer rad/s2). xi is `surface` for the `pole` in rad/s. Where the yaw
    rate is not judged, gamma_ref is the yaw rate that keeps beta_ref. Reads beta_hat, and
    gamma_hat or else the gyro.

    Memory: the references of the last decision, for their derivatives, and whether there was one.
    Raises ValueError for an option that is not positive, or an observation without beta_hat.
    """

    memory = 3

    def __init__(
        self, env: AnyEnv, pole: float = 15.0, rate: float = 40.0, layer: float = 0.2
    ) -> None:
        names = {entry.name for entry in given(env).layout}
        self.needs = (
            *("wheel_left", "wheel_right", "steer_command", "steer", "beta_hat"),
            "gamma_hat" if "gamma_hat" in names else "gyro",
        )
        super().__init__(env)
        for name, value in (("pole", pole), ("rate", rate), ("layer", layer)):
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} is a positive number, got {value!r}")
        self.pole, self.rate, self.layer = float(pole), float(rate), float(layer)
        self._vehicle = np.array(_car(self.nominal))
        self._target, self._kind = target_of(self.nominal), REFERENCES.index(self.reference)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _sliding_mode_law(
            inputs,
            state,
            self._vehicle,
            self._target,
            self._kind,
            self.pole,
            self.rate,
            self.layer,
            self.full_scale,
            self.control_period * TICK,
            action,
        )
