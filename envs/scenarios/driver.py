"""The driver, who steers by preview and controls the speed, and the side wind; compiled.

Steering is MacAdam's optimal preview control (IEEE Trans. SMC 11, 1981) with one preview point:
the lateral acceleration that brings the car onto the path within the preview time T,
2 (y_path(t + T) - y - T y') / T^2; at gain 1 the loop has 1.41/T rad/s and damping 0.71. The angle
is the nominal car's for it in the steady state, behind a first-order lag and a rate limit.
"""

from typing import TYPE_CHECKING, NamedTuple

from ..numerics.functions import sincos
from ..numerics.jit import inline, jit
from ..numerics.primitives import Scalar, any_lane, maximum, minimum, select
from ..ticks import TICK
from ..vehicle.actuators import apply_lag, limit_rate
from ..vehicle.dynamics import Motion, RoadParams, compute_curvature
from ..vehicle.tyres import MIN_SPEED
from .road import TrackPath, compute_path_offset
from .steering import MIN_STEER_FACTOR

if TYPE_CHECKING:
    from ..task import ReferenceParams

_MIN_PREVIEW = 1.0  # wheelbases: a driver looks no nearer


class DriverParams(NamedTuple):
    """Parameters of a driver who steers by preview."""

    preview: Scalar  # s, T
    gain: Scalar
    rest: Scalar  # what a tick leaves of a deviation from the wanted angle
    slew: Scalar  # rad a tick, at the wheels


@jit
def compute_target_angle(
    motion: Motion,
    path: TrackPath,
    road: RoadParams,
    target: "ReferenceParams",
    driver: DriverParams,
    stop: Scalar,
) -> Scalar:
    """Compute the steering angle that brings the car onto the path.

    Args:
        motion: `Motion` of the car.
        path: `TrackPath`.
        road: `RoadParams`.
        target: `ReferenceParams` of the nominal car, which the driver knows.
        driver: `DriverParams`.
        stop: Largest angle (rad).

    Returns:
        Angle at the wheels (rad), within +-stop.
    """
    v = motion.v_x
    distance = maximum(driver.preview * v, _MIN_PREVIEW / target.per_l)
    sin_r, cos_r = sincos(motion.psi - motion.theta)
    slope = (v * sin_r + motion.v_y * cos_r) / maximum(v, MIN_SPEED)
    # the double integral of the curvature, exact on a clothoid too
    bend = 0.5 * distance * distance * compute_curvature(road, motion.s + distance * (1.0 / 3.0))
    # how far the path lies to the left of the car's course at the preview distance
    error = compute_path_offset(path, motion.s + distance) + bend - motion.y - distance * slope
    curvature = driver.gain * 2.0 * error / (distance * distance)
    angle = curvature * maximum(1.0 + target.G * v * v, MIN_STEER_FACTOR) / target.per_l
    return minimum(maximum(angle, 0.0 - stop), stop)


@jit
def compute_driver_angle(
    angle: Scalar,
    motion: Motion,
    path: TrackPath,
    road: RoadParams,
    target: "ReferenceParams",
    driver: DriverParams,
    stop: Scalar,
) -> Scalar:
    """Compute the driver's steering angle a tick later.

    Args:
        angle: Present angle at the wheels (rad).
        motion: `Motion` of the car.
        path: `TrackPath`.
        road: `RoadParams`.
        target: `ReferenceParams` of the nominal car, which the driver knows.
        driver: `DriverParams`.
        stop: Largest angle (rad).

    Returns:
        The next angle (rad).
    """
    target_angle = compute_target_angle(motion, path, road, target, driver, stop)
    return limit_rate(angle, apply_lag(target_angle, angle, driver.rest), driver.slew)


class SpeedProfile(NamedTuple):
    """The driver's speed, held or followed by PI control, or an acceleration."""

    speed: Scalar  # m/s, at the start and to hold
    hold: Scalar  # 1 hold the speed that `acceleration` and `surge` make of it; 0 apply them alone
    acceleration: Scalar  # m/s2, from start to end
    start: Scalar  # tick
    end: Scalar
    k_p: Scalar  # 1/s
    k_i: Scalar  # 1/s2
    surge: Scalar = 0.0  # m/s2, amplitude of a sine
    surge_rate: Scalar = 1.0  # rad/s


@inline
def compute_speed_reference(tick: Scalar, profile: SpeedProfile) -> tuple[Scalar, Scalar]:
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
    tick: Scalar, v_x: Scalar, integral: Scalar, profile: SpeedProfile, limit: Scalar
) -> tuple[Scalar, Scalar]:
    """Compute the driver's acceleration command: PI on the speed with feedforward.

    The integral part is held at the limit. A profile that does not hold its speed gives the wanted
    acceleration alone.

    Args:
        tick: Tick since the start of the episode.
        v_x: Speed (m/s).
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


class Wind(NamedTuple):
    """A side wind between two ticks."""

    force: Scalar  # N, to the left
    arm: Scalar  # m, ahead of the centre of gravity
    start: Scalar
    end: Scalar
    height: Scalar = 0.0  # m, above the roll axis


@jit
def compute_wind(tick: Scalar, wind: Wind) -> tuple[Scalar, Scalar, Scalar]:
    """Compute force and moments of the wind from this tick to the next.

    Args:
        tick: Tick since the start of the episode.
        wind: `Wind`.

    Returns:
        Force (N), yaw moment and roll moment (N m).
    """
    force = select((tick >= wind.start) & (tick < wind.end), wind.force, 0.0)
    return force, force * wind.arm, 0.0 - force * wind.height
