"""dakf-stability's controller: a model of the response is followed by steering and yaw moment.

Section V: reference model (23), feedforward (28), feedback (31), disturbance rejection (26), as
algebra on the nominal A and B at the measured speed, the mean of the two front wheels'.
"""

import math
from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...envs.numerics.jit import as_python, jit
from ...envs.numerics.primitives import Matrix, Vector, maximum
from ...envs.record import Array
from ...envs.task import LAGGED, REFERENCES, ZERO_SLIP, compute_reference, make_reference_params
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import Vehicle
from ..design.pi import (
    compute_drift,
    compute_plant,
    compute_plant_python,
    compute_steady_yaw_rate,
    make_nominal_car,
    solve_inputs,
)
from ..env_info import AnyEnv
from .base import Controller, integrate_antiwindup, list_entry_names

MIN_SPEED = 2.0  # m/s: below it the vehicle is taken as at this speed
BANDWIDTH = (5.0, 5.0)  # rad/s, K_beta and K_gamma of dakf-stability V.D

Inputs = namedtuple(
    "Inputs",
    "wheel_left wheel_right steer_command beta_ref gamma_ref beta_hat gamma_hat d1_hat d2_hat",
)
"""Columns of the law's inputs; what the observation lacks is put in by `ModelFollowing`."""
Memory = namedtuple("Memory", "delta_f_sum N_z_sum driver known")
"""The integrals of steering (rad) and yaw moment (N m), the driver's last steering command (rad),
and whether there was one."""

IN = Inputs(*range(9))
LAST = Memory(*range(4))


def compute_feedback_gains(
    vehicle: Vehicle, speed: float, bandwidth: Sequence[float] = BANDWIDTH
) -> tuple[Array, Array]:
    """Compute P and I of C_fb = P + I / s, from errors of beta and gamma to delta_f and N_z.

    (31) solved for C_fb gives P_n^-1 diag(K / s) = B^-1 diag(K) - B^-1 A diag(K) / s, a proper
    PI. The closed loop is diag(K / (s + K)) and the poles of A, which the PI's zeros cancel: it is
    internally stable where the nominal car is, below its critical speed. The printed (32) is this
    for equal K only.

    Args:
        vehicle: Vehicle of the design.
        speed: Speed (m/s).
        bandwidth: K_beta and K_gamma (rad/s).

    Returns:
        P and I, each of shape (2, 2).
    """
    plant = compute_plant_python(make_nominal_car(vehicle), float(speed))
    columns = np.diag(np.asarray(bandwidth, np.float64))
    P = [_inputs(plant, *column) for column in columns]
    I = [_inputs(plant, *(-x for x in _drift(plant, *column))) for column in columns]  # noqa: E741
    return np.array(P).T, np.array(I).T


_drift, _inputs = as_python(compute_drift), as_python(solve_inputs)


@jit
def _model_following_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: tuple[Any, ...]
) -> None:
    """Compute the actions from `Inputs` x and update the `Memory` state.

    max_share: largest yaw moment as a fraction of full scale (N,). design: nominal car, reference
    parameters, index of the reference, K_beta and K_gamma (rad/s), 1 or 0 for (26), full scale
    (N m), authority (rad), control period (s).
    """
    car, target, kind, K, rejection, full_scale, authority, dt = design
    for n in range(len(x)):
        v = maximum(0.5 * (x[n, IN.wheel_left] + x[n, IN.wheel_right]), MIN_SPEED)
        driver, beta_ref, gamma_ref = x[n, IN.steer_command], x[n, IN.beta_ref], x[n, IN.gamma_ref]
        plant = compute_plant(car, v)
        last_driver = state[n, LAST.driver] if state[n, LAST.known] > 0.0 else driver
        old = compute_reference(last_driver, v, target, kind)
        new = compute_reference(driver, v, target, kind)
        reference_rates = ((new[0] - old[0]) / dt, (new[1] - old[1]) / dt)  # of the references
        if kind == LAGGED:
            approach = (1.0 - target.rest) / TICK
            reference_rates = (approach * (new[0] - beta_ref), approach * (new[1] - gamma_ref))
        if kind == ZERO_SLIP:  # the yaw rate is free: the one that keeps beta_ref
            gamma_ref = compute_steady_yaw_rate(plant, beta_ref, driver)
            last_gamma_ref = compute_steady_yaw_rate(plant, beta_ref, last_driver)
            reference_rates = (reference_rates[0], (gamma_ref - last_gamma_ref) / dt)
        drift_rates = compute_drift(plant, beta_ref, gamma_ref)
        p_beta = K[0] * (beta_ref - x[n, IN.beta_hat])
        p_gamma = K[1] * (gamma_ref - x[n, IN.gamma_hat])
        # (28) by the references' derivatives, P of (31), and (26) at once: B^-1 is linear
        delta_f, N_z = solve_inputs(
            plant,
            reference_rates[0] - drift_rates[0] + p_beta - rejection * x[n, IN.d1_hat],
            reference_rates[1] - drift_rates[1] + p_gamma - rejection * x[n, IN.d2_hat],
        )
        delta_f, N_z = delta_f + state[n, LAST.delta_f_sum], N_z + state[n, LAST.N_z_sum]  # (33)
        steer = min(max(delta_f, driver - authority), driver + authority)
        limit = max_share[n] * full_scale
        moment = min(max(N_z, -limit), limit)
        drift_rates = compute_drift(plant, p_beta, p_gamma)
        # I of (31), forward Euler
        steps = solve_inputs(plant, -drift_rates[0] * dt, -drift_rates[1] * dt)
        state[n, LAST.delta_f_sum] = integrate_antiwindup(
            state[n, LAST.delta_f_sum], steps[0], delta_f, steer
        )
        state[n, LAST.N_z_sum] = integrate_antiwindup(state[n, LAST.N_z_sum], steps[1], N_z, moment)
        state[n, LAST.driver], state[n, LAST.known] = driver, 1.0
        action[n, 0] = moment / full_scale
        action[n, 1] = (steer - driver) / authority


class ModelFollowing(Controller):
    """Steering and yaw moment by dakf-stability (33), for an env whose action has both.

    The yaw rate is gamma_hat where the observation has it, else the gyro's. The references are the
    env's, but "zero-slip" takes the yaw rate that keeps beta_ref. Derivatives follow the steering
    at one speed, as the speed's noise would drown a difference. "lagged" has those of its lag.

    Anti-windup is conditional integration of each input: an integral holds while its input is at
    the limit (yaw moment: full scale; steering: the authority around the driver's) and the error
    would push it further out.

    Args:
        env: Env of the controller, whose action steers.
        bandwidth: K_beta and K_gamma (rad/s).
        rejection: Whether to subtract the effect of d1_hat and d2_hat, (26).
        grip: Grip limit, as for `Controller`.

    Raises:
        ValueError: The action does not steer, an entry is missing, or the bandwidth is no pair.
    """

    memory = len(Memory._fields)

    def __init__(
        self,
        env: AnyEnv,
        bandwidth: Sequence[float] = BANDWIDTH,
        rejection: bool = True,
        grip: float | None = None,
    ) -> None:
        substitutes = {} if "gamma_hat" in list_entry_names(env) else {"gamma_hat": "gyro"}
        if not rejection:  # whatever stands there is multiplied by zero
            substitutes |= {"d1_hat": "beta_ref", "d2_hat": "gamma_ref"}
        self.needs = tuple(substitutes.get(name, name) for name in Inputs._fields)
        super().__init__(env, grip)
        if self.width != 2:
            raise ValueError("ModelFollowing needs an env whose action steers (steering=True)")
        K = [float(value) for value in bandwidth]
        if len(K) != 2 or not all(0.0 < value < math.inf for value in K):
            raise ValueError(f"bandwidth is two positive numbers in rad/s, got {bandwidth!r}")
        self._design = (
            make_nominal_car(self.nominal),
            make_reference_params(self.nominal),
            REFERENCES.index(self.reference),
            np.array(K),
            float(rejection),
            self.full_scale,
            self.authority,
            self.control_period * TICK,
        )

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _model_following_law(inputs, state, action, self._compute_max_moment(inputs), self._design)
