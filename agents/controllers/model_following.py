"""dakf-stability's controller: a model of the response is followed by steering and yaw moment.

Section V: reference model (23), feedforward (28), feedback (31), disturbance rejection (26). All of
it is algebra on the nominal A and B at the measured speed (the mean of the two front wheels'), so
that nothing is tabulated and no design tool is needed.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import maximum
from ...envs.task.reference import REFERENCES, reference, target_of
from ...envs.ticks import TICK
from ...envs.vehicle.linear import bicycle_coefficients
from ...envs.vehicle.vehicle import Vehicle
from ..env_facts import AnyEnv, given
from .base import Array, Controller

SLOWEST = 2.0  # m/s: below it the vehicle is taken as at this speed
BANDWIDTH = (5.0, 5.0)  # rad/s, K_beta and K_gamma of dakf-stability V.D


def _car(vehicle: Vehicle) -> tuple[float, ...]:
    """The vehicle as `bicycle_coefficients` takes it."""
    return (
        vehicle.mass,
        vehicle.yaw_inertia,
        vehicle.front_arm,
        vehicle.rear_arm,
        vehicle.front_stiffness,
        vehicle.rear_stiffness,
    )


@jit
def _plant(car: Any, v: Any) -> Any:
    return bicycle_coefficients(car[0], car[1], car[2], car[3], car[4], car[5], v)


@jit
def _drift(plant: Any, beta: Any, gamma: Any) -> Any:
    """A [beta, gamma]."""
    a11, a12, a21, a22, _, _, _ = plant
    return a11 * beta + a12 * gamma, a21 * beta + a22 * gamma


@jit
def _inputs_for(plant: Any, first: Any, second: Any) -> Any:
    """B^-1 [first, second]: the steering angle and yaw moment that have this effect, (26)."""
    _, _, _, _, b11, b21, b22 = plant
    delta_f = first / b11
    return delta_f, (second - b21 * delta_f) / b22


def feedback_gains(
    vehicle: Vehicle, speed: float, bandwidth: Sequence[float] = BANDWIDTH
) -> tuple[Array, Array]:
    """(P, I), each (2, 2), of C_fb = P + I / s from errors of beta, gamma to delta_f, N_z.

    (31) solved for C_fb gives P_n^-1 diag(K / s) = B^-1 diag(K) - B^-1 A diag(K) / s, a proper
    PI. The closed loop is diag(K / (s + K)) and the poles of A, which the PI's zeros cancel: it is
    internally stable where the nominal car is, below its critical speed. The printed (32) is this
    for equal K only.
    """
    plant = _plant(_car(vehicle), float(speed))
    columns = np.diag(np.asarray(bandwidth, np.float64))
    P = [_inputs_for(plant, *column) for column in columns]
    I = [_inputs_for(plant, *(-x for x in _drift(plant, *column))) for column in columns]  # noqa: E741
    return np.array(P).T, np.array(I).T


@jit
def _integrated(memory: Any, step: Any, wanted: Any, held: Any) -> Any:
    """The integral after a step, which is dropped where it would push further past the limit."""
    if wanted == held or (wanted > held) != (step > 0.0):
        return memory + step
    return memory


@jit
def _model_following_law(
    x: Any,
    state: Any,
    car: Any,
    target: Any,
    kind: int,
    K: Any,
    rejection: float,
    full_scale: float,
    authority: float,
    dt: float,
    action: Any,
) -> None:
    """x: wheels, steer_command, beta_ref, gamma_ref, beta, gamma, d1, d2.

    state: integrals in rad and N m, the last steering command, whether there was one.
    """
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, 0] + x[n, 1]), SLOWEST)
        driver, beta_ref, gamma_ref = x[n, 2], x[n, 3], x[n, 4]
        plant = _plant(car, v)
        before = state[n, 2] if state[n, 3] > 0.0 else driver
        old, new = reference(before, v, target, kind), reference(driver, v, target, kind)
        drift = _drift(plant, beta_ref, gamma_ref)
        p_beta, p_gamma = K[0] * (beta_ref - x[n, 5]), K[1] * (gamma_ref - x[n, 6])
        # (28) by the references' derivatives, P of (31), and (26) at once: B^-1 is linear
        delta_f, N_z = _inputs_for(
            plant,
            (new[0] - old[0]) / dt - drift[0] + p_beta - rejection * x[n, 7],
            (new[1] - old[1]) / dt - drift[1] + p_gamma - rejection * x[n, 8],
        )
        delta_f, N_z = delta_f + state[n, 0], N_z + state[n, 1]  # (33)
        delta_held = min(max(delta_f, driver - authority), driver + authority)
        N_held = min(max(N_z, -full_scale), full_scale)
        drift = _drift(plant, p_beta, p_gamma)
        steps = _inputs_for(plant, -drift[0] * dt, -drift[1] * dt)  # I of (31), forward Euler
        state[n, 0] = _integrated(state[n, 0], steps[0], delta_f, delta_held)
        state[n, 1] = _integrated(state[n, 1], steps[1], N_z, N_held)
        state[n, 2], state[n, 3] = driver, 1.0
        action[n, 0] = N_held / full_scale
        action[n, 1] = (delta_held - driver) / authority


class ModelFollowing(Controller):
    """Steering and yaw moment by dakf-stability (33), for an env whose action has both.

    bandwidth: K_beta and K_gamma in rad/s. rejection: subtract the effect of d1_hat and d2_hat,
    (26). The yaw rate is gamma_hat where the observation has it, else the gyro's. The references
    are the env's; their derivatives are those of the driver's steering at the measured speed, whose
    noise would drown a difference of references.

    Memory: the two integrals, the last steering command, and whether there was one. Anti-windup is
    conditional integration, each input for itself: an integral holds while its input is at the
    limit (yaw moment: full scale; steering: the authority around the driver's) and the error would
    push it further out.

    Raises ValueError for an env whose action does not steer, a bandwidth that is not two positive
    numbers, or an observation without a needed entry.
    """

    needs: tuple[str, ...] = (
        "wheel_left",
        "wheel_right",
        "steer_command",
        "beta_ref",
        "gamma_ref",
        "beta_hat",
        "gamma_hat",
        "d1_hat",
        "d2_hat",
    )
    memory = 4

    def __init__(
        self,
        env: AnyEnv,
        bandwidth: Sequence[float] = BANDWIDTH,
        rejection: bool = True,
    ) -> None:
        names = {entry.name for entry in given(env).layout}
        instead = {} if "gamma_hat" in names else {"gamma_hat": "gyro"}
        if not rejection:  # whatever stands there is multiplied by zero
            instead |= {"d1_hat": "beta_ref", "d2_hat": "gamma_ref"}
        self.needs = tuple(instead.get(name, name) for name in self.needs)
        super().__init__(env)
        if self.width != 2:
            raise ValueError("ModelFollowing needs an env whose action steers (steering=True)")
        K = [float(each) for each in bandwidth]
        if len(K) != 2 or not all(0.0 < each < math.inf for each in K):
            raise ValueError(f"bandwidth is two positive numbers in rad/s, got {bandwidth!r}")
        self.bandwidth = np.array(K)
        self.rejection = bool(rejection)
        self.dt = self.control_period * TICK
        self._car = np.array(_car(self.nominal))
        self._target = target_of(self.nominal)
        self._kind = REFERENCES.index(self.reference)

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _model_following_law(
            inputs,
            state,
            self._car,
            self._target,
            self._kind,
            self.bandwidth,
            float(self.rejection),
            self.full_scale,
            self.authority,
            self.dt,
            action,
        )
