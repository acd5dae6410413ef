"""The PI on the sideslip angle of tie-vision section V.

The papers' short names, such as tie-vision, are those of docs/PAPERS.md.
"""

import math
from dataclasses import dataclass

import numpy as np

from ...envs.vehicle.linear import make_bicycle_model
from ...envs.vehicle.parameters import Vehicle

POLE = 2.0 * math.pi * 2.0  # rad/s: Table II of tie-vision places poles at 2 Hz
PLACEMENTS = ("radius", "real")


@dataclass(frozen=True)
class PI:
    """Gains of the yaw moment on the error of the sideslip angle."""

    k_p: float  # proportional gain (N m/rad)
    k_i: float  # integral gain (N m/(rad s))


def design_pi(vehicle: Vehicle, speed: float, pole: float = POLE, placement: str = "radius") -> PI:
    """Design a PI whose zero lies on the plant's slow pole, with closed-loop poles at `pole`.

    With G = k / ((s + p_1)(s + p_2)), p_1 < p_2, and C = k_p (s + p_1) / s the closed loop is
    s^2 + p_2 s + k k_p. That is for real poles; of complex ones (a passenger car's from about
    23 km/h on) p_1 and p_2 both are the real part, and the zero cancels no pole. Gains are capped
    at the full yaw moment for 0.01 rad: k is nearly zero near the speed where the yaw moment does
    not move beta.

    Args:
        vehicle: Vehicle of the design.
        speed: Speed (m/s).
        pole: Radius or place of the closed-loop poles (rad/s).
        placement: "radius": k k_p = pole^2 puts both poles on that circle. Their damping is at
            least a half, which a slow plant reaches at a smaller radius; they are real where p_2 >
            2 pole. "real": k k_p = pole (p_2 - pole) puts one of two real poles there, or both at
            p_2 / 2 where pole is beyond p_2.

    Returns:
        Gains k_p (N m/rad) and k_i (N m/(rad s)).

    Raises:
        ValueError: The placement is unknown, or the pole is not positive.
    """
    _check(pole, placement)
    model = make_bicycle_model(vehicle, speed)
    # det(sI - A + b c) - det(sI - A) is the numerator of G = c (sI - A)^-1 b with c = [1, 0] and b
    # of the yaw moment: k = a12 b22
    closed = model.A - model.B[:, 1:] @ [[1.0, 0.0]]
    k = float((np.poly(closed) - np.poly(model.A))[-1])
    slow_first = sorted(-float(p.real) for p in np.linalg.eigvals(model.A))
    p_1, p_2 = max(slow_first[0], 0.0), slow_first[1]
    if placement == "radius":
        product = min(pole, p_2) ** 2
    else:
        product = pole * (p_2 - pole) if pole < p_2 else 0.25 * p_2 * p_2
    k_p = _limit_gain(vehicle, product / k) if k != 0.0 else 0.0
    return PI(k_p, k_p * p_1)


def _check(pole: float, placement: str) -> None:
    if placement not in PLACEMENTS:
        raise ValueError(f"placement is one of {', '.join(PLACEMENTS)}, got {placement!r}")
    if not 0.0 < pole < math.inf:
        raise ValueError(f"pole is a positive number in rad/s, got {pole!r}")


def _limit_gain(vehicle: Vehicle, k_p: float) -> float:
    max_gain = vehicle.yaw_moment_limit / 0.01
    return min(max(float(k_p), -max_gain), max_gain)


def sample_pi(
    vehicle: Vehicle, speed: float, period: float, pole: float = POLE, placement: str = "radius"
) -> PI:
    """Design the PI of `design_pi` for a sampled loop with the moment held between.

    The PI is k_p + k_i T / (z - 1), its zero lies on the plant's slow pole a_1, and the poles of
    (z - a_2)(z - 1) + k_p (b_1 z + b_0) are placed: with ln z = s T, "radius" makes the product of
    the two s pole^2, "real" puts one s at -pole. It tends to `design_pi` for a short period. As
    there, the real parts of complex poles are taken: a_1 = a_2, and the zero cancels no pole.

    Args:
        vehicle: Vehicle of the design.
        speed: Speed (m/s).
        period: Sampling period T (s).
        pole: Radius or place of the closed-loop poles (rad/s).
        placement: "radius" or "real".

    Returns:
        Gains k_p (N m/rad) and k_i (N m/(rad s)).
    """
    _check(pole, placement)
    model = make_bicycle_model(vehicle, speed)
    p_1, p_2 = np.sort(-np.linalg.eigvals(model.A).real).tolist()
    a_1, a_2 = math.exp(-max(p_1, 0.0) * period), math.exp(-p_2 * period)
    A_d, B_d = model.discretise(period)  # tie-vision's G and H, (9)
    b_1 = B_d[0, 1]
    b_0 = A_d[0, 1] * B_d[1, 1] - A_d[1, 1] * B_d[0, 1]
    if b_1 + b_0 == 0.0:
        return PI(0.0, 0.0)
    if placement == "real":
        z = math.exp(-(pole if pole < p_2 else 0.5 * p_2) * period)
        k_p = -(z - a_2) * (z - 1.0) / (b_1 * z + b_0)
    else:
        radius = min(pole, p_2)
        continuous = radius**2 / float(model.A[0, 1] * model.B[1, 1])

        def compute_excess(factor: float) -> float:
            k_p = factor * continuous
            poles = np.roots([1.0, k_p * b_1 - 1.0 - a_2, a_2 + k_p * b_0]).astype(complex)
            return float(np.prod(np.log(poles)).real - (radius * period) ** 2)

        from scipy.optimize import brentq  # slow to load

        # a grid in steps of 0.05; the smallest root counts: beyond it a pole may leave z > 0
        factors = np.linspace(0.0, 4.0, 81)
        upper = next((f for f in factors[1:] if compute_excess(f) > 0.0), None)
        factor = 4.0 if upper is None else brentq(compute_excess, upper - 0.05, upper)
        k_p = continuous * factor
    k_p = _limit_gain(vehicle, float(k_p))
    return PI(k_p, k_p * (1.0 - a_1) / period)
