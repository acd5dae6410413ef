"""The cost rate, its scales, and what the rest of a failed episode costs."""

from typing import Any

from ..backend.decorators import jit
from ..backend.primitives import absolute, minimum
from ..ticks import TICK
from .reference import ZERO_SLIP

BETA_SCALE, GAMMA_SCALE, STEER_SCALE = 0.02, 0.1, 0.05
EFFORT_WEIGHT, COST_CAP = 0.01, 100.0


@jit
def compute_cost_rate(
    e_beta: Any, e_gamma: Any, moment_share: Any, steer_added: Any, reference_kind: int
) -> Any:
    """Compute the cost rate of a tick, capped at 100 per second.

    c = (e_beta/0.02)^2 + (e_gamma/0.1)^2 + 0.01 (N_z/N_max)^2 + 0.01 (steer/0.05)^2

    Args:
        e_beta: Error of the sideslip angle (rad).
        e_gamma: Error of the yaw rate (rad/s), not judged with "zero-slip".
        moment_share: Yaw moment as a fraction of its full scale.
        steer_added: Added steering angle (rad).
        reference_kind: Place of the reference in `REFERENCES`.

    Returns:
        Cost rate (1/s).
    """
    b, s = e_beta * (1.0 / BETA_SCALE), steer_added * (1.0 / STEER_SCALE)
    c = b * b + EFFORT_WEIGHT * (moment_share * moment_share) + EFFORT_WEIGHT * (s * s)
    if reference_kind != ZERO_SLIP:
        g = e_gamma * (1.0 / GAMMA_SCALE)
        c = c + g * g
    return minimum(absolute(c), COST_CAP)


@jit
def compute_failure_cost(duration: Any, tick: Any) -> Any:
    """Compute the cost of the rest of a failed episode, so that failing never pays.

    Args:
        duration: Length of the episode (ticks).
        tick: Tick at which it failed.

    Returns:
        The cost.
    """
    return COST_CAP * (duration - tick) * TICK
