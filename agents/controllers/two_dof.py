"""tie-vision's two-degree-of-freedom controller: feedforward (24) and a PI on the sideslip angle.

Both are designed from the nominal vehicle and scheduled by the measured speed, the mean of the two
front wheel speeds: the feedforward by its formula, the PI on a grid of speeds.

The papers' short names, such as tie-vision, are those of docs/PAPERS.md.
"""

import math
from collections import namedtuple
from typing import Any

import numpy as np

from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum, select
from ...envs.record import Array
from ...envs.ticks import TICK
from ...envs.vehicle.linear import Bicycle, compute_bicycle_coefficients
from ..design.pi import PLACEMENTS, POLE, design_pi, sample_pi
from ..env_info import AnyEnv
from .base import Controller, check_positive, integrate_antiwindup

MIN_SPEED = 2.0  # m/s: gains below it are those of this speed
SPEEDS = np.arange(MIN_SPEED, 61.0, 0.5)  # m/s
CAMERA_PERIOD = 0.033  # s
FEEDFORWARDS = ("reference", "zero-slip")

Inputs = namedtuple("Inputs", "wheel_left wheel_right steer_command beta_hat beta_ref")
"""Columns of the laws' inputs; the feedforward reads the first three alone."""
Memory = namedtuple("Memory", "integral wait share")
"""The PI's integral (N m), decisions until the next update, and the yaw moment held until then
(fraction of full scale)."""

IN = Inputs(*range(5))
LAST = Memory(*range(3))


@jit
def _compute_denominator(car: Bicycle, V: Scalar) -> Scalar:
    """Compute -a12 m V^2 (N m), kept at least 5 % of the sum of its terms' magnitudes.

    At zero the yaw moment has no static effect on the sideslip angle. An understeering car has such
    a speed, m V^2 = 2 (l_r C_r - l_f C_f).
    """
    mV2, excess = car.m * V * V, car.l_f * car.C_f - car.l_r * car.C_r
    denominator, min_size = mV2 + 2.0 * excess, 0.05 * (mV2 + 2.0 * absolute(excess))
    if absolute(denominator) < min_size:
        denominator = select(denominator < 0.0, -min_size, min_size)
    return denominator


@jit
def _compute_static_gain(car: Bicycle, V: Scalar) -> Scalar:
    """Compute N_z / delta_f for a steady beta of zero (N m/rad), tie-vision (24)."""
    m, l_f, l_r, C_f, C_r = car.m, car.l_f, car.l_r, car.C_f, car.C_r
    mV2 = m * V * V
    numerator = 4.0 * l_r * (l_f + l_r) * C_f * C_r - 2.0 * l_f * C_f * mV2
    return numerator / _compute_denominator(car, V)


@jit
def _compute_sideslip_gain(car: Bicycle, V: Scalar) -> Scalar:
    """Compute the yaw moment that holds a sideslip angle (N m/rad), beside that of (24)."""
    a11, _, a21, a22, _, _, b22 = compute_bicycle_coefficients(car, V)
    yaw_rate = a11 * car.m * V * V / _compute_denominator(car, V)  # that keeps it, -a11 / a12
    return -(a21 + a22 * yaw_rate) / b22


@jit
def _interpolate_column(table: Vector, v: Scalar) -> Scalar:
    """Interpolate a column of a table over SPEEDS at v, held beyond its ends."""
    position = min(max((v - MIN_SPEED) / 0.5, 0.0), len(table) - 1.000001)
    i = int(position)
    return table[i] + (position - i) * (table[i + 1] - table[i])


@jit
def _feedforward_law(x: Matrix, action: Matrix, design: tuple[Any, ...]) -> None:
    car, full_scale = design
    for n in range(len(x)):
        v = 0.5 * (x[n, IN.wheel_left] + x[n, IN.wheel_right])
        gain = _compute_static_gain(car, maximum(v, MIN_SPEED))
        action[n, 0] = gain * x[n, IN.steer_command] / full_scale


@jit
def _two_dof_law(
    x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: tuple[Any, ...]
) -> None:
    """Compute the actions from `Inputs` x and update the `Memory` state.

    `max_share` is the largest yaw moment (fraction of full scale). `follows`: 1 for "reference".
    """
    follows, car, k_p, k_i, full_scale, wait, dt = design
    for n in range(len(x)):
        if state[n, LAST.wait] > 0.0:
            state[n, LAST.wait] -= 1.0
            action[n, 0] = state[n, LAST.share]
            continue
        v = 0.5 * (x[n, IN.wheel_left] + x[n, IN.wheel_right])
        error = x[n, IN.beta_ref] - x[n, IN.beta_hat]
        forward = _compute_static_gain(car, maximum(v, MIN_SPEED)) * x[n, IN.steer_command]
        if follows:
            forward += _compute_sideslip_gain(car, maximum(v, MIN_SPEED)) * x[n, IN.beta_ref]
        integral = state[n, LAST.integral]
        unlimited = forward + _interpolate_column(k_p, v) * error + integral
        limit = max_share[n] * full_scale
        N_z = min(max(unlimited, -limit), limit)
        step = _interpolate_column(k_i, v) * error * dt  # forward Euler
        state[n, LAST.integral] = integrate_antiwindup(integral, step, unlimited, N_z)
        state[n, LAST.wait] = wait - 1.0
        state[n, LAST.share] = N_z / full_scale
        action[n, 0] = state[n, LAST.share]


class Feedforward(Controller):
    """The yaw moment of tie-vision (24) for the driver's steering command.

    Args:
        env: Env of the controller.
    """

    needs = Inputs._fields[: IN.beta_hat]

    def __init__(self, env: AnyEnv) -> None:
        super().__init__(env)
        self._design = self._bicycle, self.full_scale

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _feedforward_law(inputs, action, self._design)


class TwoDof(Controller):
    """Feedforward plus a PI on beta_ref - beta_hat, tie-vision section V.

    Args:
        env: Env of the controller, with beta_hat in its observation.
        rate: "control" updates at every decision, "camera" at the first decision after 33 ms.
        gain: Factor on the PI's gains.
        pole: Pole of the closed loop (rad/s), as for `design_pi`.
        placement: Rule of the pole, as for `design_pi`.
        sampled: Whether to place the poles of the sampled loop (`sample_pi`).
        grip: Grip limit, as for `Controller`.
        feedforward: "reference" holds beta_ref in the nominal car's steady turn, "zero-slip" is
            (24).

    Raises:
        ValueError: A rate, placement or feedforward is unknown, or beta_hat is missing.
    """

    needs = Inputs._fields
    memory = len(Memory._fields)

    def __init__(
        self,
        env: AnyEnv,
        rate: str = "control",
        gain: float = 1.0,
        pole: float = POLE,
        placement: str = PLACEMENTS[0],
        sampled: bool = False,
        grip: float | None = None,
        feedforward: str = FEEDFORWARDS[0],
    ) -> None:
        super().__init__(env, grip)
        if feedforward not in FEEDFORWARDS:
            known = ", ".join(FEEDFORWARDS)
            raise ValueError(f"feedforward is one of {known}, got {feedforward!r}")
        if rate not in ("control", "camera"):
            raise ValueError(f"rate is 'control' or 'camera', got {rate!r}")
        period = self.control_period * TICK
        wait = 1 if rate == "control" else max(1, math.ceil(CAMERA_PERIOD / period - 1e-9))
        dt = wait * period
        factor = check_positive("gain", gain, allow_zero=True)
        if sampled:
            pis = [sample_pi(self.nominal, float(v), dt, pole, placement) for v in SPEEDS]
        else:
            pis = [design_pi(self.nominal, float(v), pole, placement) for v in SPEEDS]
        table = factor * np.array([(pi.k_p, pi.k_i) for pi in pis])
        self.k_p, self.k_i = np.ascontiguousarray(table.T)
        car = self._bicycle
        follows = int(feedforward == FEEDFORWARDS[0])
        self._design = follows, car, self.k_p, self.k_i, self.full_scale, wait, dt

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        _two_dof_law(inputs, state, action, self._compute_max_moment(inputs), self._design)
