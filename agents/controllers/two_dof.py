"""tie-vision's two-degree-of-freedom controller: feedforward (24) and a PI on the sideslip angle.

Both are designed from the nominal vehicle (docs/PAPERS.md has the papers' short names) and
scheduled by the mean of the two front wheel speeds: the PI on a grid of speeds.
"""

import math
from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import jit
from ...envs.numerics.packed import read, write
from ...envs.numerics.primitives import Matrix, Scalar, Vector, absolute, maximum, select
from ...envs.validation import check_choice
from ...envs.vehicle.linear import Bicycle, compute_bicycle_coefficients, make_bicycle_model
from ...envs.vehicle.parameters import Vehicle
from ..env_info import AnyEnv
from .base import Controller, check_positive, integrate_antiwindup

MIN_SPEED = 2.0  # m/s: gains below it are those of this speed
SPEEDS = np.arange(MIN_SPEED, 61.0, 0.5)  # m/s
CAMERA_PERIOD = 0.033  # s
POLE = 2.0 * math.pi * 2.0  # rad/s: Table II of tie-vision places poles at 2 Hz
PLACEMENTS = ("radius", "real")
FEEDFORWARDS = ("reference", "zero-slip")

# Columns of the laws' inputs; the feedforward reads the first three alone.
Inputs = namedtuple("Inputs", "wheel_left wheel_right steer_command beta_hat beta_ref")
# The PI's integral (N m), decisions until the next update, and the yaw moment (of full scale) held.
Memory = namedtuple("Memory", "integral wait share")
IN, LAST = Inputs(*range(5)), Memory(*range(3))


class PI(NamedTuple):
    """Gains of the yaw moment on the error of the sideslip angle."""

    k_p: float  # proportional gain (N m/rad)
    k_i: float  # integral gain (N m/(rad s))


def design_pi(vehicle: Vehicle, speed: float, pole: float = POLE, placement: str = "radius") -> PI:
    """Design a PI whose zero lies on the plant's slow pole, with closed-loop poles at `pole`.

    With G = k / ((s + p_1)(s + p_2)), p_1 < p_2, and C = k_p (s + p_1) / s the closed loop is
    s^2 + p_2 s + k k_p. Of complex poles (a passenger car's from about 23 km/h on) p_1 and p_2 both
    are the real part, and the zero cancels no pole. Gains are capped at the full yaw moment for
    0.01 rad: k is nearly zero near the speed where the yaw moment does not move beta.

    Args:
        vehicle: Vehicle of the design.
        speed: Speed (m/s).
        pole: Radius or place of the closed-loop poles (rad/s); ValueError unless it is positive.
        placement: "radius": k k_p = pole^2 puts both poles on that circle, a smaller one where
            their damping would be below a half. "real": k k_p = pole (p_2 - pole) puts one of two
            real poles there, or both at p_2 / 2 where pole is beyond p_2. Another: ValueError.
    """
    check_choice("placement", placement, PLACEMENTS)
    check_positive("pole", pole)
    model = make_bicycle_model(vehicle, speed)
    # det(sI - A + b c) - det(sI - A) is the numerator of G = c (sI - A)^-1 b with c = [1, 0] and b
    # of the yaw moment: k = a12 b22
    closed = model.A - model.B[:, 1:] @ [[1.0, 0.0]]
    k = float((np.poly(closed) - np.poly(model.A))[-1])
    p_1, p_2 = np.sort(-np.linalg.eigvals(model.A).real).tolist()
    product = pole * (p_2 - pole) if pole < p_2 else 0.25 * p_2 * p_2
    if placement == "radius":
        product = min(pole, p_2) ** 2
    max_gain = vehicle.yaw_moment_limit / 0.01
    k_p = min(max(product / k, -max_gain), max_gain) if k != 0.0 else 0.0
    return PI(k_p, k_p * max(p_1, 0.0))


@jit
def _compute_denominator(car: Bicycle, V: Scalar) -> Scalar:
    """Compute -a12 m V^2 (N m), kept at least 5 % of the sum of its terms' magnitudes."""
    # zero, at m V^2 = 2 (l_r C_r - l_f C_f), is where the yaw moment does not move a steady beta
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
    plant = compute_bicycle_coefficients(car, V)
    yaw_rate = plant.a11 * car.m * V * V / _compute_denominator(car, V)  # that keeps it, -a11 / a12
    return -(plant.a21 + plant.a22 * yaw_rate) / plant.b22


@jit
def _interpolate_column(table: Vector, v: Scalar) -> Scalar:
    """Interpolate a column of a table over SPEEDS at v, held beyond its ends."""
    position = min(max((v - MIN_SPEED) / 0.5, 0.0), len(table) - 1.000001)
    i = int(position)
    return table[i] + (position - i) * (table[i + 1] - table[i])


@jit
def _feedforward_law(
    x: Matrix, _state: Matrix, action: Matrix, _max_share: Vector, design: Any
) -> None:
    """Compute the actions from `Inputs` x."""
    car, full_scale = design
    for n in range(len(x)):
        v = 0.5 * (x[n, IN.wheel_left] + x[n, IN.wheel_right])
        gain = _compute_static_gain(car, maximum(v, MIN_SPEED))
        action[n, 0] = gain * x[n, IN.steer_command] / full_scale


@jit
def _two_dof_law(x: Matrix, state: Matrix, action: Matrix, max_share: Vector, design: Any) -> None:
    """Compute the actions from `Inputs` x and update the `Memory` state."""
    follows, car, k_p, k_i, full_scale, wait, dt = design
    for n in range(len(x)):
        row, last = read(x[n], IN), read(state[n], LAST)
        if last.wait > 0.0:
            state[n, LAST.wait] -= 1.0
            action[n, 0] = last.share
            continue
        v = 0.5 * (row.wheel_left + row.wheel_right)
        error = row.beta_ref - row.beta_hat
        forward = _compute_static_gain(car, maximum(v, MIN_SPEED)) * row.steer_command
        if follows:
            forward += _compute_sideslip_gain(car, maximum(v, MIN_SPEED)) * row.beta_ref
        unlimited = forward + _interpolate_column(k_p, v) * error + last.integral
        limit = max_share[n] * full_scale
        N_z = min(max(unlimited, -limit), limit)
        step = _interpolate_column(k_i, v) * error * dt  # forward Euler
        integral = integrate_antiwindup(last.integral, step, unlimited, N_z)
        action[n, 0] = N_z / full_scale
        write(state[n], Memory(integral, wait - 1.0, action[n, 0]), LAST)


class Feedforward(Controller):
    """The yaw moment of tie-vision (24) for the driver's steering command.

    Args:
        env: Env of the controller.
    """

    law = staticmethod(_feedforward_law)
    needs = Inputs._fields[: IN.beta_hat]

    def __init__(self, env: AnyEnv) -> None:
        super().__init__(env)
        self._design = self._bicycle, self.full_scale


class TwoDof(Controller):
    """Feedforward plus a PI on beta_ref - beta_hat, tie-vision section V.

    Raises ValueError for an unknown rate or feedforward.

    Args:
        env: Env of the controller, with beta_hat in its observation; ValueError without it.
        rate: "control" updates at every decision, "camera" at the first decision after 33 ms.
        gain: Factor on the PI's gains.
        pole: Pole of the closed loop (rad/s), as for `design_pi`.
        grip: Grip limit, as for `Controller`.
        feedforward: "reference" holds beta_ref in the nominal car's steady turn, "zero-slip": (24).
    """

    law = staticmethod(_two_dof_law)
    needs = Inputs._fields
    memory = len(Memory._fields)

    def __init__(
        self, env: AnyEnv, rate: str = "control", gain: float = 1.0, pole: float = POLE,
        grip: float | None = None, feedforward: str = FEEDFORWARDS[0],
    ) -> None:  # fmt: skip
        super().__init__(env, grip)
        check_choice("feedforward", feedforward, FEEDFORWARDS)
        check_choice("rate", rate, ("control", "camera"))
        period = self.control_period * TICK
        wait = 1 if rate == "control" else max(1, math.ceil(CAMERA_PERIOD / period - 1e-9))
        factor = check_positive("gain", gain, allow_zero=True)
        pis = [design_pi(self.nominal, float(v), pole) for v in SPEEDS]
        self.k_p, self.k_i = np.ascontiguousarray((factor * np.array(pis)).T)
        follows, gains = int(feedforward == FEEDFORWARDS[0]), (self.k_p, self.k_i)
        self._design = follows, self._bicycle, *gains, self.full_scale, wait, wait * period
