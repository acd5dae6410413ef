"""Roads: straight ones with their bends, and those that follow a nominal car's path."""

from typing import Any, NamedTuple

from ..backend.decorators import inline
from ..backend.primitives import maximum
from ..ticks import TICK
from ..vehicle.linear import Bicycle, compute_bicycle_coefficients

ROADS = ("straight", "nominal-path")
STRAIGHT, NOMINAL_PATH = range(len(ROADS))
_MIN_SPEED = 1.0  # m/s, of the nominal car


class NominalMotion(NamedTuple):
    """State of the nominal car whose path is the road."""

    beta: Any  # rad
    gamma: Any  # rad/s


@inline
def step_nominal_car(
    nominal_motion: NominalMotion, steer: Any, speed: Any, car: Bicycle
) -> tuple[Any, NominalMotion]:
    """Step the nominal car, whose path is the road, over a tick by explicit Euler.

    The direction of its path is psi + beta, so it turns by gamma + beta'. The road is a function of
    time, and so of the seed alone: what the true car does has no effect on it.

    Args:
        nominal_motion: `NominalMotion` at the start of the tick.
        steer: Steering angle held over the tick (rad).
        speed: Speed (m/s), taken as at least 1.
        car: `Bicycle` of the nominal vehicle.

    Returns:
        Turning rate of the road during the tick (rad/s), and the `NominalMotion` at its end.
    """
    V = maximum(speed, _MIN_SPEED)
    a11, a12, a21, a22, b11, b21, _ = compute_bicycle_coefficients(
        car.m, car.I, car.l_f, car.l_r, car.C_f, car.C_r, V
    )
    dbeta = a11 * nominal_motion.beta + a12 * nominal_motion.gamma + b11 * steer
    dgamma = a21 * nominal_motion.beta + a22 * nominal_motion.gamma + b21 * steer
    next_motion = NominalMotion(
        nominal_motion.beta + TICK * dbeta, nominal_motion.gamma + TICK * dgamma
    )
    return nominal_motion.gamma + dbeta, next_motion
