"""The GPS: course, speed and position of the antenna, HDOP and satellites."""

from typing import NamedTuple

from ..numerics.functions import CHANNELS, PI, sincos, wrap
from ..numerics.jit import jit
from ..numerics.primitives import Scalar, Vector, floor, maximum, minimum, select, sqrt
from ..vehicle.dynamics import Motion, compute_sideslip_angle
from ..vehicle.tyres import MIN_SPEED
from .inertial import Noise
from .link import Blocks, Link, PacketValue, SlowKind

GPS_KIND = SlowKind(
    "gps",
    (
        PacketValue("course", "rad", PI),
        PacketValue("speed", "m/s", 100.0),
        PacketValue("X", "m", 1e5),
        PacketValue("Y", "m", 1e5),
        PacketValue("hdop", "-", 100.0),
        PacketValue("satellites", "-", 50.0),
    ),
    Blocks(noise=CHANNELS.gps, link=CHANNELS.gps_link, drift=CHANNELS.sky),
)
COURSE_SPEED = 1.0  # m/s; below it a course has quality 0
HDOP_LAWS = {"constant": 0.0, "half": 0.5, "table": 1.0}
"""Weights w by law: the GPS's standard deviations are (1 + w (HDOP - 1)) times those of `Noise`."""
OUTAGE_JUMP = 3.0  # spreads by which log HDOP rises where an outage ends


class SatelliteGeometry(NamedTuple):
    """Satellite geometry: log HDOP is an Ornstein-Uhlenbeck process."""

    median: Scalar  # log of the median HDOP
    spread: Scalar  # standard deviation of log HDOP
    decay: Scalar  # fraction of a deviation that remains after one period of the GPS
    noise_gain: Scalar  # sqrt(1 - decay^2)
    weight: Scalar  # of HDOP in the noise, HDOP_LAWS


@jit
def compute_hdop_deviation(
    before: Scalar, sky: SatelliteGeometry, link: Link, tick: Scalar, n: Vector
) -> Scalar:
    """Compute the deviation of log HDOP from its median at a capture.

    Args:
        before: Deviation at the capture before.
        sky: Law of the HDOP.
        link: Outage and period of the GPS (ticks).
        tick: Tick of the capture.
        n: Standard normal numbers, of which the first is used.

    Returns:
        The deviation.
    """
    is_after_outage = (link.outage_end > link.outage_start) & (tick >= link.outage_end)
    is_after_outage = is_after_outage & (tick - link.period < link.outage_end)
    jump = select(is_after_outage, OUTAGE_JUMP * sky.spread, 0.0)
    return sky.decay * before + sky.noise_gain * sky.spread * n[0] + jump


@jit
def _count_satellites(hdop: Scalar) -> Scalar:
    """Count the satellites that a receiver sees: 12 at HDOP 1, 4 at HDOP 5, fewer above."""
    return floor(2.0 + minimum(10.0 / hdop, 28.0))


@jit
def sample_gps(
    motion: Motion,
    forward: Scalar,
    left: Scalar,
    hdop: Scalar,
    weight: Scalar,
    noise: Noise,
    n: Vector,
    small_angle: int,
) -> tuple[Scalar, ...]:
    """Sample the GPS at its antenna, with noise.

    course = psi + beta, dakf-stability (3), with the antenna's beta.

    Args:
        motion: `Motion` of the car.
        forward: Place of the antenna ahead of the centre of gravity (m).
        left: Place of the antenna left of it (m).
        hdop: Horizontal dilution of precision.
        weight: Fraction of the noise that follows HDOP, of `HDOP_LAWS`.
        noise: Standard deviations and biases of the sensors.
        n: Four standard normal numbers.
        small_angle: 1 for the small-angle plant, else 0.

    Returns:
        Course (rad), speed (m/s), X (m), Y (m), HDOP, satellites and quality.
    """
    v_x, v_y = motion.v_x - motion.gamma * left, motion.v_y + motion.gamma * forward
    s, c = sincos(motion.psi)
    noise_scale = 1.0 + weight * (hdop - 1.0)
    v = sqrt(v_x * v_x + v_y * v_y)
    angle = motion.psi + compute_sideslip_angle(v_x, v_y, small_angle)
    course = wrap(angle + noise.course * noise_scale / maximum(v, MIN_SPEED) * n[0])
    return (
        course,
        v + noise.gps_speed * noise_scale * n[1],
        motion.X + (forward * c - left * s) + noise.gps_position * noise_scale * n[2],
        motion.Y + (forward * s + left * c) + noise.gps_position * noise_scale * n[3],
        hdop,
        _count_satellites(hdop),
        select(v < COURSE_SPEED, 0.0, 1.0),
    )
