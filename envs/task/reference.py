"""References from the driver's command and the nominal vehicle, and the cost of a tick."""

from typing import Any, NamedTuple

from ..backend.decorators import jit
from ..backend.primitives import maximum, minimum
from ..vehicle.vehicle import GRAVITY, Vehicle

ZERO_SLIP, MODEL, LIMITED = range(3)
REFERENCES = ("zero-slip", "model", "limited")


class Target(NamedTuple):
    """Coefficients of the steady-state responses of the nominal vehicle."""

    b_0: Any  # l_r / l
    b_1: Any  # M l_f / (2 l C_r l_r)
    G: Any  # stability factor, dakf-stability (24)
    per_l: Any  # 1 / l
    mu_g: Any  # m/s2


def target_of(nominal: Vehicle) -> Target:
    """The coefficients for a nominal vehicle."""
    l, M = nominal.wheelbase, nominal.mass  # noqa: E741
    C_f, C_r = nominal.front_stiffness, nominal.rear_stiffness
    l_f, l_r = nominal.front_arm, nominal.rear_arm
    return Target(
        l_r / l,
        M * l_f / (2.0 * l * C_r * l_r),
        M / (2.0 * l * l) * (C_r * l_r - C_f * l_f) / (C_f * C_r),  # dakf-stability (24)
        1.0 / l,
        nominal.friction * GRAVITY,
    )


@jit
def reference(steer: Any, v: Any, target: Any, kind: int) -> Any:
    """(beta_ref, gamma_ref) for a steering command at a measured speed.

    zero-slip: (0, 0), the yaw rate is not judged. model: the nominal steady state, with
    1 + G v^2 kept above 0.2. limited: the model within what friction can hold,
    |gamma| <= 0.85 mu g / v and |beta| <= 0.02 mu g (Rajamani, Vehicle Dynamics and Control).
    """
    if kind == ZERO_SLIP:
        return 0.0 * steer, 0.0 * steer
    gain = steer / maximum(1.0 + target.G * v * v, 0.2)
    beta = (1.0 - target.b_1 * v * v) * target.b_0 * gain  # dakf-stability (23)
    gamma = v * target.per_l * gain  # dakf-stability (23)
    if kind == LIMITED:
        most_beta = 0.02 * target.mu_g
        most_gamma = 0.85 * target.mu_g / maximum(v, 1.0)
        beta = minimum(maximum(beta, 0.0 - most_beta), most_beta)
        gamma = minimum(maximum(gamma, 0.0 - most_gamma), most_gamma)
    return beta, gamma
