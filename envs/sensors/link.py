"""Sensors: what they measure, their noise, and when a captured sample arrives."""

from typing import Any, NamedTuple

import numpy as np

from .backend import floor, jit, maximum, minimum, select, sqrt, whole
from .dynamics import curvature_at, sideslip_angle
from .elementary import sincos, wrap
from .noise import CHANNELS, uniforms
from .record import TICK, SlowSensor
from .tyres import SLOW

NEVER = -1.0
IN_FLIGHT = 8  # packets of one sensor under way at once, duplicates included
COURSE_SPEED = 1.0  # m/s; below it a course has quality 0
HDOP_LAWS = {"constant": 0.0, "half": 0.5, "table": 1.0}
"""How much of the GPS's noise follows HDOP: its standard deviations are (1 + w (HDOP - 1)) times
those of `Noise`, which are those at HDOP 1."""
OUTAGE_JUMP = 3.0  # of the spread of log HDOP, upwards where an outage ends


class Noise(NamedTuple):
    """Standard deviations and biases; the defaults are those of the project's simulations."""

    gyro: Any = 0.005  # rad/s
    gyro_bias: Any = 0.0
    accel: Any = 0.1  # m/s2, both axes
    accel_y_bias: Any = 0.0
    roll_rate: Any = 0.005  # rad/s
    wheel: Any = 0.02  # m/s
    camera_psi: Any = 3.5e-3  # rad
    camera_y: Any = 0.02  # m
    course: Any = 0.14 * np.pi / 180.0 * (60.0 / 3.6)  # rad m/s: 0.14 deg at 60 km/h, as 1 / V
    gps_speed: Any = 0.05  # m/s
    gps_position: Any = 0.5  # m


class Sky(NamedTuple):
    """What the GPS sees of the satellites: log HDOP is an Ornstein-Uhlenbeck process."""

    median: Any  # log of the median HDOP
    spread: Any  # standard deviation of log HDOP
    keep: Any  # what is left of a deviation after one period of the GPS
    fresh: Any  # sqrt(1 - keep^2)
    weight: Any  # of HDOP in the noise, HDOP_LAWS


class Link(NamedTuple):
    """A slow sensor's clock and link in ticks; period 0: the sensor is absent."""

    period: Any
    phase: Any  # -1: drawn at reset
    patterns: Any  # how many of the four delays repeat
    delay_0: Any
    delay_1: Any
    delay_2: Any
    delay_3: Any
    jitter: Any
    loss: Any
    duplicate: Any
    outage_start: Any
    outage_end: Any


def ticks(seconds: float) -> float:
    """Whole ticks of a time in seconds."""
    return float(round(seconds / TICK))


def link_of(sensor: SlowSensor | None, outage: tuple[float, float] | None = None) -> Link:
    """A Link from the public description; None: an absent sensor.

    Raises ValueError where more packets could be under way at once than there is room for.
    """
    if sensor is None:
        return Link._make([0.0] * len(Link._fields))
    delays = [ticks(delay) for delay in sensor.delays]
    start, end = outage if outage is not None else (0.0, 0.0)
    d_0, d_1, d_2, d_3 = delays + [0.0] * (4 - len(delays))
    link = Link(
        ticks(sensor.period),
        -1.0 if sensor.phase is None else ticks(sensor.phase),
        float(len(delays)),
        d_0,
        d_1,
        d_2,
        d_3,
        ticks(sensor.jitter),
        sensor.loss,
        sensor.duplicate,
        ticks(start),
        ticks(end),
    )
    most = most_under_way(link)
    if most > IN_FLIGHT:
        raise ValueError(
            f"a period of {sensor.period} s with delays up to {sensor.longest_delay:g} s puts "
            f"{most} packets under way at once; there is room for {IN_FLIGHT}"
        )
    return link


def most_under_way(link: Link) -> int:
    """How many packets of a sensor that is there are under way at once, duplicates included."""
    longest = max(link.delay_0, link.delay_1, link.delay_2, link.delay_3) + link.jitter
    most = int(longest // link.period) + 1
    return 2 * (most + 1) if link.duplicate > 0.0 else most


@jit
def arrivals(link: Any, frame: Any, tick: Any, key_low: int, key_high: int, block: int) -> Any:
    """(first, second) arrival tick of the frame captured at `tick`; NEVER where there is none.

    Loss, outage, duplication, latency and jitter are this one function.
    """
    late, lost, twice, again = uniforms(key_low, key_high, whole(tick), block)
    which = frame - link.patterns * floor(frame / link.patterns)
    delay = select(which == 1.0, link.delay_1, link.delay_0)
    delay = select(which == 2.0, link.delay_2, delay)
    delay = select(which == 3.0, link.delay_3, delay)
    first = tick + delay + floor(late * (link.jitter + 1.0))
    out = (tick >= link.outage_start) & (tick < link.outage_end)
    gone = out | (lost < link.loss)
    second = first + 1.0 + floor(again * link.period)
    first = select(gone, NEVER, first)
    return first, select(gone | (twice >= link.duplicate), NEVER, second)


@jit
def camera_sample(motion: Any, road: Any, l_pre: Any, noise: Any, n: Any) -> Any:
    """(psi, y_l): heading relative to the road, and offset at the preview point.

    y_l = y_cg + l_pre psi - kappa l_pre^2 / 2, tie-vision (4) with curvature.
    """
    psi = motion.psi - motion.theta
    bend = 0.5 * curvature_at(road, motion.s) * l_pre * l_pre
    y_l = motion.y + l_pre * psi - bend
    return wrap(psi + noise.camera_psi * n[0]), y_l + noise.camera_y * n[1]


@jit
def sky_deviation(before: Any, sky: Any, link: Any, tick: Any, n: Any) -> Any:
    """The deviation of log HDOP at a capture, from that at the one before."""
    back = (link.outage_end > link.outage_start) & (tick >= link.outage_end)
    back = back & (tick - link.period < link.outage_end)
    jump = select(back, OUTAGE_JUMP * sky.spread, 0.0)
    return sky.keep * before + sky.fresh * sky.spread * n[0] + jump


@jit
def satellites_at(hdop: Any) -> Any:
    """How many satellites a receiver sees at an HDOP: 12 at 1, 4 up to 5, fewer above."""
    return floor(2.0 + minimum(10.0 / hdop, 28.0))


@jit
def gps_sample(
    motion: Any, ahead: Any, left: Any, hdop: Any, weight: Any, noise: Any, n: Any, small_angle: int
) -> Any:
    """(course, speed, X, Y, hdop, satellites, quality) of an antenna at (ahead, left).

    course = psi + beta, dakf-stability (3), where beta, as all else, is the antenna's.
    """
    v_x, v_y = motion.v_x - motion.gamma * left, motion.v_y + motion.gamma * ahead
    s, c = sincos(motion.psi)
    size = 1.0 + weight * (hdop - 1.0)
    v = sqrt(v_x * v_x + v_y * v_y)
    angle = motion.psi + sideslip_angle(v_x, v_y, small_angle)
    course = wrap(angle + noise.course * size / maximum(v, SLOW) * n[0])
    return (
        course,
        v + noise.gps_speed * size * n[1],
        motion.X + (ahead * c - left * s) + noise.gps_position * size * n[2],
        motion.Y + (ahead * s + left * c) + noise.gps_position * size * n[3],
        hdop,
        satellites_at(hdop),
        select(v < COURSE_SPEED, 0.0, 1.0),
    )


@jit
def clock_phase(link: Any, key_low: int, key_high: int, which: int) -> Any:
    """The tick of the first capture: as given, or drawn where the phase is -1."""
    u = uniforms(key_low, key_high, 0, CHANNELS.initial, 1 + which)
    return select(link.phase < 0.0, floor(u[0] * link.period), link.phase)
