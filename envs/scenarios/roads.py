"""Roads: straight ones with their bends, and those that follow a nominal car's path."""

from typing import Any, NamedTuple

from ..backend.decorators import inlined
from ..backend.primitives import maximum
from ..ticks import TICK
from ..vehicle.linear import Bicycle, bicycle_coefficients

ROADS = ("straight", "nominal-path")
STRAIGHT, NOMINAL_PATH = range(len(ROADS))
_SLOWEST = 1.0  # m/s, of the nominal car


class Lead(NamedTuple):
    """The nominal car that lays the road."""

    beta: Any  # rad
    gamma: Any  # rad/s


@inlined
def laid_by(lead: Lead, steer: Any, speed: Any, car: Bicycle) -> tuple[Any, Lead]:
    """(by how much the road turns in rad/s during a tick, the Lead at its end): explicit Euler.

    The direction of the nominal car's path is psi + beta, so it turns by gamma + beta'. steer: rad,
    held over the tick. It is a function of time, and so of the seed alone: the road unrolls beside
    the true car as the nominal car lays it, whatever the true car does.
    """
    V = maximum(speed, _SLOWEST)
    a11, a12, a21, a22, b11, b21, _ = bicycle_coefficients(
        car.m, car.I, car.l_f, car.l_r, car.C_f, car.C_r, V
    )
    turn = a11 * lead.beta + a12 * lead.gamma + b11 * steer
    swing = a21 * lead.beta + a22 * lead.gamma + b21 * steer
    after = Lead(lead.beta + TICK * turn, lead.gamma + TICK * swing)
    return lead.gamma + turn, after
