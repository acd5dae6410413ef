"""Tyres that a filter estimates while it drives: an extended Kalman filter on the bicycle.

The factors of both axles' stiffness, and the reciprocal of friction where tyres have a limit, are
states behind the dense ones. Every few ms each axle's force is expanded at the present state:
its slope by slip stands in `car` and makes the bicycle's matrices, its slopes by the states are
columns beside them, and the rest is a known push.
"""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum, minimum
from .memory import CAR, FilterRecord
from .transition import MIN_SPEED

FACTOR_LIMITS = (0.2, 3.0)
MAX_INVERSE_FRICTION = 4.0  # of the reciprocal of friction
_MIN_SLOPE = 0.02  # of a tyre's slope, where it slides


@jit
def compute_axle_force(stiffness: Any, load: Any, alpha: Any, factor: Any, grip: Any) -> Any:
    """Compute an axle's lateral force and its slopes: Fiala's law with friction 1/grip.

    F = C s alpha (1 - |z| + z^2 / 3), z = C s alpha grip / (3 F_z) within +-1; at grip 0 it is
    linear.

    Args:
        stiffness: Nominal cornering stiffness of the axle, C (N/rad).
        load: Load of the axle, F_z (N).
        alpha: Slip angle (rad).
        factor: Factor on the stiffness, s.
        grip: Reciprocal of friction.

    Returns:
        (F, dF/dalpha, dF/dfactor, dF/dgrip) in N, N/rad, N and N.
    """
    total_stiffness = stiffness * factor
    slip_ratio = total_stiffness * absolute(alpha) / (3.0 * load)
    z = minimum(slip_ratio * grip, 1.0)
    share = 1.0 - z + z * z * (1.0 / 3.0)
    if z >= 1.0:  # it slides: F_z / grip
        force = load / grip if alpha > 0.0 else 0.0 - load / grip
        return force, _MIN_SLOPE * total_stiffness, 0.0, 0.0 - force / grip
    slope = (1.0 - z) * (1.0 - z)
    grip_slope = total_stiffness * alpha * slip_ratio * (z * (2.0 / 3.0) - 1.0)
    return (
        total_stiffness * alpha * share,
        maximum(slope, _MIN_SLOPE) * total_stiffness,
        stiffness * alpha * slope,
        grip_slope,
    )


@jit
def _set_random_walk(f: FilterRecord, moves: bool) -> None:
    """Set the tyres' random walk: while the car moves, up to their variance at the start.

    A new member's walk more.
    """
    for i in range(3 if f.grip > 0 else 2):
        index = f.tyres + i if i < 2 else f.grip
        walks = moves and f.P[index, index] < f.prior[index, index]
        extra = f.fresh if i < 2 else 0.0
        f.Q[index, index] = f.q_tyres[i] + extra if walks else 0.0


@jit
def linearise(f: FilterRecord, steer: Any) -> None:
    """Expand both axles' forces at the present state.

    Args:
        f: Memory of the filter.
        steer: Steering angle of the front wheels (rad).
    """
    x, V = f.x, maximum(f.model_speed, MIN_SPEED)
    for i in range(2):
        x[f.tyres + i] = minimum(maximum(x[f.tyres + i], FACTOR_LIMITS[0]), FACTOR_LIMITS[1])
    grip = 0.0
    if f.grip > 0:
        grip = minimum(maximum(x[f.grip], 0.0), MAX_INVERSE_FRICTION)
        x[f.grip] = grip
    beta, gamma = x[0], x[1]
    push, moves = 0.0, f.speed > MIN_SPEED
    _set_random_walk(f, moves)
    for i in range(2):
        arm = f.car[CAR.front_arm] if i == 0 else 0.0 - f.car[CAR.rear_arm]
        alpha = (steer if i == 0 else 0.0) - beta - arm * gamma / V
        factor = x[f.tyres + i]
        force, slope, per_factor, per_grip = compute_axle_force(
            f.stiffness[i], f.load[i], alpha, factor, grip
        )
        f.car[CAR.front_stiffness + i] = 0.5 * slope
        if not moves:  # nothing of the tyres is seen
            per_factor, per_grip = 0.0, 0.0
        f.per_tyre[i, 0], f.per_tyre[i, 1] = per_factor, per_grip
        f.rest[i] = force - slope * alpha - per_factor * factor - per_grip * grip
        push += absolute(force)
    if f.model_error > 0.0:
        force_error = f.model_error * push
        moment_error = 0.5 * (f.car[CAR.front_arm] + f.car[CAR.rear_arm]) * force_error
        f.Q[f.dense, f.dense] = f.q_known[0] + f.q_share * force_error * force_error
        f.Q[f.dense + 1, f.dense + 1] = f.q_known[1] + f.q_share * moment_error * moment_error
