"""The driver's longitudinal work: a speed held or followed, or an acceleration."""

from typing import Any, NamedTuple

from ..backend.decorators import inline
from ..backend.elementary import sincos
from ..backend.primitives import any_lane, maximum, minimum, select
from ..ticks import TICK


class SpeedProfile(NamedTuple):
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


@inline
def compute_speed_reference(tick: Any, profile: Any) -> Any:
    """Compute the speed and the acceleration that the driver wants at a tick.

    Args:
        tick: Tick since the start of the episode.
        profile: `SpeedProfile`.

    Returns:
        Speed (m/s) and acceleration (m/s2).
    """
    acceleration = select((tick >= profile.start) & (tick < profile.end), profile.acceleration, 0.0)
    elapsed = (minimum(maximum(tick, profile.start), profile.end) - profile.start) * TICK
    speed = profile.speed + profile.acceleration * elapsed
    if any_lane(profile.surge != 0.0):
        s, c = sincos(profile.surge_rate * (tick * TICK))
        acceleration = acceleration + profile.surge * s
        speed = speed + profile.surge / profile.surge_rate * (1.0 - c)
    return speed, acceleration


@inline
def compute_acceleration_command(
    tick: Any, v_x: Any, integral: Any, profile: Any, limit: Any
) -> Any:
    """Compute the driver's acceleration command: PI on the speed, its integral held at the limit.

    The wanted speed starts at `profile.speed` and is the integral of the wanted acceleration, which
    is fed forward.

    Args:
        tick: Tick since the start of the episode.
        v_x: Measured speed (m/s).
        integral: Integral part of the command (m/s2).
        profile: `SpeedProfile`.
        limit: Largest acceleration of the motors (m/s2).

    Returns:
        The command and the next integral (m/s2).
    """
    speed, feedforward = compute_speed_reference(tick, profile)
    error = speed - v_x
    command = profile.k_p * error + integral + profile.hold * feedforward
    limited = minimum(maximum(command, 0.0 - limit), limit)
    next_integral = integral + profile.k_i * error * TICK
    integral = select(command == limited, next_integral, integral)
    return profile.hold * limited + (1.0 - profile.hold) * feedforward, integral
