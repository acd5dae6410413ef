"""The driver's longitudinal work: a speed held or followed, or an acceleration."""

from typing import Any, NamedTuple

from ..backend.decorators import inlined
from ..backend.elementary import sincos
from ..backend.primitives import anywhere, maximum, minimum, select
from ..ticks import TICK


class Pace(NamedTuple):
    """The driver's longitudinal work: a speed held or followed by PI, or an acceleration."""

    speed: Any  # m/s, at the start and to hold
    hold: Any  # 1 hold the speed that `acceleration` and `surge` make of it; 0 apply them alone
    acceleration: Any  # m/s2, from start to end
    start: Any  # tick
    end: Any
    k_p: Any  # 1/s
    k_i: Any  # 1/s2
    surge: Any = 0.0  # m/s2, amplitude of a sine
    surge_rate: Any = 1.0  # rad/s


@inlined
def wanted_motion(tick: Any, pace: Any) -> Any:
    """(speed in m/s, acceleration in m/s2) that the driver wants at a tick."""
    ahead = select((tick >= pace.start) & (tick < pace.end), pace.acceleration, 0.0)
    since = (minimum(maximum(tick, pace.start), pace.end) - pace.start) * TICK
    speed = pace.speed + pace.acceleration * since
    if anywhere(pace.surge != 0.0):
        s, c = sincos(pace.surge_rate * (tick * TICK))
        ahead = ahead + pace.surge * s
        speed = speed + pace.surge / pace.surge_rate * (1.0 - c)
    return speed, ahead


@inlined
def acceleration_command(tick: Any, v_x: Any, integral: Any, pace: Any, limit: Any) -> Any:
    """(a_x command in m/s2, next integral): PI on the speed with the integral held at the limit.

    The wanted speed starts at `pace.speed` and is the integral of the wanted acceleration, which
    is fed forward.
    """
    speed, ahead = wanted_motion(tick, pace)
    error = speed - v_x
    wanted = pace.k_p * error + integral + pace.hold * ahead
    held = minimum(maximum(wanted, 0.0 - limit), limit)
    grown = integral + pace.k_i * error * TICK
    integral = select(wanted == held, grown, integral)
    return pace.hold * held + (1.0 - pace.hold) * ahead, integral
