"""References from the driver's command and the nominal vehicle."""

import math
from typing import Any, NamedTuple

from ..backend.decorators import jit
from ..backend.primitives import maximum, minimum
from ..ticks import TICK
from ..vehicle.actuators import apply_lag
from ..vehicle.vehicle import GRAVITY, Vehicle

REFERENCES = ("zero-slip", "model", "limited", "lagged")
ZERO_SLIP, MODEL, LIMITED, LAGGED = range(len(REFERENCES))

# The lagged reference's car has a characteristic speed of 35 m/s at most. The passenger car has
# 36.5: at 80 km/h it is asked to turn 2 % less than it does by itself. A car that is neutral or
# oversteers is asked to understeer. Its lag is about that of both presets, two over the trace of
# their lateral dynamics: 0.08 s for the COMS at 22 km/h, 0.12 s for the passenger car at 70 km/h.
CHARACTERISTIC_SPEED = 35.0  # m/s
REFERENCE_LAG = 0.1  # s


class ReferenceParams(NamedTuple):
    """Coefficients of the steady-state responses of the nominal vehicle."""

    b_0: Any  # l_r / l
    b_1: Any  # M l_f / (2 l C_r l_r)
    G: Any  # stability factor, dakf-stability (24)
    per_l: Any  # 1 / l
    mu_g: Any  # m/s2
    G_lagged: Any  # stability factor of the lagged reference
    rest: Any  # what a tick leaves of its deviation from the steady state


def make_reference_params(nominal: Vehicle) -> ReferenceParams:
    """Compute the coefficients of the references for a nominal vehicle.

    Args:
        nominal: The nominal vehicle.

    Returns:
        The coefficients.
    """
    l, M = nominal.wheelbase, nominal.mass  # noqa: E741
    C_f, C_r = nominal.front_stiffness, nominal.rear_stiffness
    l_f, l_r = nominal.front_arm, nominal.rear_arm
    G = M / (2.0 * l * l) * (C_r * l_r - C_f * l_f) / (C_f * C_r)  # dakf-stability (24)
    return ReferenceParams(
        l_r / l,
        M * l_f / (2.0 * l * C_r * l_r),
        G,
        1.0 / l,
        nominal.friction * GRAVITY,
        max(G, CHARACTERISTIC_SPEED**-2),
        math.exp(-TICK / REFERENCE_LAG),
    )


@jit
def compute_reference(steer: Any, v: Any, target: Any, reference_kind: int) -> Any:
    """Compute the steady-state reference for a steering command at a measured speed.

    zero-slip: (0, 0), the yaw rate is not judged. model: the nominal steady state, with
    1 + G v^2 kept above 0.2. limited: the model within what friction can hold,
    |gamma| <= 0.85 mu g / v and |beta| <= 0.02 mu g (Rajamani, Vehicle Dynamics and Control).
    lagged: the steady state of `filter_reference`, limited in the same way, with the stability
    factor of a car that understeers.

    Args:
        steer: The driver's steering command (rad).
        v: Measured speed (m/s).
        target: `ReferenceParams`.
        reference_kind: Place of the reference in `REFERENCES`.

    Returns:
        beta_ref (rad) and gamma_ref (rad/s).
    """
    if reference_kind == ZERO_SLIP:
        return 0.0 * steer, 0.0 * steer
    G = target.G_lagged if reference_kind == LAGGED else target.G
    gain = steer / maximum(1.0 + G * v * v, 0.2)
    beta = (1.0 - target.b_1 * v * v) * target.b_0 * gain  # dakf-stability (23)
    gamma = v * target.per_l * gain  # dakf-stability (23)
    if reference_kind in (LIMITED, LAGGED):
        max_beta = 0.02 * target.mu_g
        max_gamma = 0.85 * target.mu_g / maximum(v, 1.0)
        beta = minimum(maximum(beta, 0.0 - max_beta), max_beta)
        gamma = minimum(maximum(gamma, 0.0 - max_gamma), max_gamma)
    return beta, gamma


@jit
def filter_reference(before: Any, steady: Any, target: Any, reference_kind: int) -> Any:
    """Filter the reference over a tick: the lagged one approaches the steady state, others jump.

    Args:
        before: (beta_ref, gamma_ref) of the tick before (rad, rad/s).
        steady: Result of `compute_reference` (rad, rad/s).
        target: `ReferenceParams`.
        reference_kind: Place of the reference in `REFERENCES`.

    Returns:
        beta_ref (rad) and gamma_ref (rad/s).
    """
    if reference_kind == LAGGED:
        return apply_lag(steady[0], before[0], target.rest), apply_lag(
            steady[1], before[1], target.rest
        )
    return steady
