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
    """The cost per second of a tick, capped at 100.

    c = (e_beta/0.02)^2 + (e_gamma/0.1)^2 + 0.01 (N_z/N_max)^2 + 0.01 (steer/0.05)^2
    """
    b, s = e_beta * (1.0 / BETA_SCALE), steer_added * (1.0 / STEER_SCALE)
    c = b * b + EFFORT_WEIGHT * (moment_share * moment_share) + EFFORT_WEIGHT * (s * s)
    if reference_kind != ZERO_SLIP:
        g = e_gamma * (1.0 / GAMMA_SCALE)
        c = c + g * g
    return minimum(absolute(c), COST_CAP)


@jit
def compute_failure_cost(duration: Any, tick: Any) -> Any:
    """What an episode of `duration` ticks costs besides where it fails: failing never pays."""
    return COST_CAP * (duration - tick) * TICK
