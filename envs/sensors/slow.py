"""The slow sensors: their table, a sample of any of them, camera, GPS, and the sensors of each id.

The camera measures its heading relative to the road, and the lateral offset at the preview point.
The measured times and errors of the lane finder, in `camera/detector.json`, make it one. A new
sensor is a file beside `link`, a row of `SLOW` and a branch of `sample_sensor`.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ..numerics.functions import CHANNELS, PI, TICK, compute_sine, draw_normals, exp, sincos, wrap
from ..numerics.jit import inline, jit
from ..numerics.primitives import (
    Scalar,
    Vector,
    absolute,
    floor,
    maximum,
    minimum,
    select,
    sqrt,
    to_float,
    to_int,
)
from ..validation import check_mapping, describe_unknown
from ..vehicle.dynamics import (
    CarParams,
    Motion,
    RoadParams,
    compute_curvature,
    compute_sideslip_angle,
)
from ..vehicle.tyres import MIN_SPEED
from .inertial import CAMERA_HEIGHT, Noise, SensorErrors
from .link import Blocks, Link, PacketValue, SlowKind, SlowSensor

CAMERA_KIND = SlowKind(
    "camera",
    (PacketValue("psi", "rad", PI), PacketValue("y_l", "m", 200.0)),
    Blocks(noise=CHANNELS.camera, link=CHANNELS.camera_link, drift=CHANNELS.camera),  # no drift
    needs_quality=True,
)
GPS_KIND = SlowKind(
    "gps",
    (
        PacketValue("course", "rad", PI), PacketValue("speed", "m/s", 100.0),
        PacketValue("X", "m", 1e5), PacketValue("Y", "m", 1e5),
        PacketValue("hdop", "-", 100.0), PacketValue("satellites", "-", 50.0),
    ),
    Blocks(noise=CHANNELS.gps, link=CHANNELS.gps_link, drift=CHANNELS.sky),
)  # fmt: skip
COURSE_SPEED = 1.0  # m/s; below it a course has quality 0
HDOP_LAWS = {"constant": 0.0, "half": 0.5, "table": 1.0}
"""Weights w by law: the GPS's standard deviations are (1 + w (HDOP - 1)) times those of `Noise`."""
OUTAGE_JUMP = 3.0  # spreads by which log HDOP rises where an outage ends


class FieldOfView(NamedTuple):
    """Field of view of the camera, beyond which no lane is in the picture."""

    heading: Scalar  # rad, relative to the road, either side
    offset: Scalar  # m, of the centre of gravity from the lane's centre, either side


class SatelliteGeometry(NamedTuple):
    """Satellite geometry: log HDOP is an Ornstein-Uhlenbeck process."""

    median: Scalar  # log of the median HDOP
    spread: Scalar  # standard deviation of log HDOP
    decay: Scalar  # fraction of a deviation that remains after one period of the GPS
    noise_gain: Scalar  # sqrt(1 - decay^2)
    weight: Scalar  # of HDOP in the noise, HDOP_LAWS


SLOW = (CAMERA_KIND, GPS_KIND)
CAMERA, GPS = range(len(SLOW))
SLOW_NAMES = tuple(kind.name for kind in SLOW)
WIDTHS = tuple(len(kind.values) for kind in SLOW)  # values of each one's packets
NEEDS_QUALITY = tuple(kind.needs_quality for kind in SLOW)
VALUES = max(WIDTHS)  # of any packet, filled up with zeros


def _make_blocks(place: int) -> Blocks:
    """Make the channels of a sensor that names none itself, clear of `CHANNELS`."""
    return Blocks(*range(1000 + 10 * place, 1003 + 10 * place))


BLOCKS = tuple(kind.blocks or _make_blocks(place) for place, kind in enumerate(SLOW))


class MeasurementContext(NamedTuple):
    """The truth at a tick, and the noise and random numbers to measure it with."""

    motion: Motion
    road: RoadParams
    car: CarParams
    noise: Noise
    sky: SatelliteGeometry
    field_of_view: FieldOfView
    errors: SensorErrors
    small_angle: int
    key_low: Scalar
    key_high: Scalar
    tick: Scalar


class Sample(NamedTuple):
    """One measurement of a slow sensor."""

    values: Vector  # VALUES numbers
    quality: Scalar
    drift: Scalar  # a number that the sensor carries from sample to sample


@jit
def compute_lane_quality(motion: Motion, field_of_view: FieldOfView) -> Scalar:
    """Compute the quality of a camera sample: 1, or 0 where the lane is out of view.

    Args:
        motion: `Motion` of the car.
        field_of_view: `FieldOfView`.
    """
    is_turned = absolute(wrap(motion.psi - motion.theta)) > field_of_view.heading
    return select(is_turned | (absolute(motion.y) > field_of_view.offset), 0.0, 1.0)


@inline
def compute_preview_offset(y: Scalar, psi: Scalar, kappa: Scalar, l_pre: Scalar) -> Scalar:
    """Compute the offset y_l (m) of the preview point from the lane's centre line, left positive.

    Args:
        y: Offset of the centre of gravity (m), left positive.
        psi: Heading relative to the lane (rad).
        kappa: Curvature of the lane (1/m).
        l_pre: Preview distance (m).
    """
    return y + l_pre * psi - 0.5 * kappa * l_pre * l_pre  # tie-vision (4) with curvature


@jit
def _sample_camera(context: MeasurementContext, n: Vector) -> tuple[Vector, Scalar]:
    """Sample heading and lateral offset relative to the road, with noise: values and quality."""
    motion, noise, errors, l_pre = context.motion, context.noise, context.errors, context.car.l_pre
    # A misaligned camera sees what is X ahead on the flat at X', 1 / X' = 1 / X - pitch / height,
    # times its height's error; lateral distances grow with X' / X, and a lane beside it seems to
    # turn. Offset and curvature are those seen at the preview point.
    tilt, growth = errors.camera_pitch * (1.0 / CAMERA_HEIGHT), 1.0 + errors.camera_height
    psi = motion.psi - motion.theta + errors.camera_yaw + tilt * motion.y
    kappa = compute_curvature(context.road, motion.s) / (growth + tilt * l_pre)
    y_l = compute_preview_offset(growth * motion.y, psi, kappa, l_pre) + noise.camera_y * n[1]
    values = (wrap(psi + noise.camera_psi * n[0]), y_l, 0.0, 0.0, 0.0, 0.0)
    return values, compute_lane_quality(motion, context.field_of_view)


@jit
def _count_satellites(hdop: Scalar) -> Scalar:
    """Count the satellites that a receiver sees: 12 at HDOP 1, 4 at HDOP 5, fewer above."""
    return floor(2.0 + minimum(10.0 / hdop, 28.0))


@jit
def _sample_gps(context: MeasurementContext, hdop: Scalar, n: Vector) -> tuple[Vector, Scalar]:
    """Sample the GPS at its antenna, with noise: its values and the quality."""
    motion, noise, car = context.motion, context.noise, context.car
    forward, left = car.forward, car.left
    v_x, v_y = motion.v_x - motion.gamma * left, motion.v_y + motion.gamma * forward
    s, c = sincos(motion.psi)
    noise_scale = 1.0 + context.sky.weight * (hdop - 1.0)
    v = sqrt(v_x * v_x + v_y * v_y)
    # course = psi + beta, dakf-stability (3), with the antenna's beta
    angle = motion.psi + compute_sideslip_angle(v_x, v_y, context.small_angle)
    errors, tick = context.errors, to_float(to_int(context.tick))
    wave = compute_sine(errors.course_rate * tick + errors.course_phase)  # varies slowly
    angle = angle + errors.course_error / maximum(v, MIN_SPEED) * wave
    values = (
        wrap(angle + noise.course * noise_scale / maximum(v, MIN_SPEED) * n[0]),
        v + noise.gps_speed * noise_scale * n[1],
        motion.X + (forward * c - left * s) + noise.gps_position * noise_scale * n[2],
        motion.Y + (forward * s + left * c) + noise.gps_position * noise_scale * n[3],
        hdop,
        _count_satellites(hdop),
    )
    return values, select(v < COURSE_SPEED, 0.0, 1.0)


@jit
def sample_sensor(sensor: int, context: MeasurementContext, link: Link, drift: Scalar) -> Sample:
    """Sample a slow sensor.

    Args:
        sensor: Place of the sensor in `SLOW`.
        context: Truth, noise and random numbers of the tick.
        link: `Link` of the sensor.
        drift: Drift of the sample before.
    """
    blocks, tick = BLOCKS[sensor], to_int(context.tick)
    n = draw_normals(context.key_low, context.key_high, tick, blocks.noise)
    if sensor == CAMERA:
        values, quality = _sample_camera(context, n)
        return Sample(values, quality, drift)
    sky = context.sky
    innovation = draw_normals(context.key_low, context.key_high, tick, blocks.drift)[0]
    is_after_outage = (link.outage_end > link.outage_start) & (context.tick >= link.outage_end)
    is_after_outage = is_after_outage & (context.tick - link.period < link.outage_end)
    jump = select(is_after_outage, OUTAGE_JUMP * sky.spread, 0.0)
    drift = sky.decay * drift + sky.noise_gain * sky.spread * innovation + jump  # of log HDOP
    values, quality = _sample_gps(context, exp(sky.median + drift), n)
    return Sample(values, quality, drift)


@jit
def draw_first_drift(
    sensor: int, sky: SatelliteGeometry, key_low: Scalar, key_high: Scalar
) -> Scalar:
    """Draw a slow sensor's drift at the start: the deviation of log HDOP for the GPS, else 0.

    Args:
        sensor: Place of the sensor in `SLOW`.
        sky: `SatelliteGeometry`.
        key_low: Lower 32 bits of the episode's key.
        key_high: Upper 32 bits of the episode's key.
    """
    if sensor == GPS:
        return sky.spread * draw_normals(key_low, key_high, 0, BLOCKS[sensor].drift)[1]
    return 0.0


CAMERA_33_30 = SlowSensor(period=0.033, delays=(0.030,))
_CAMERA_UNEVEN = SlowSensor(period=0.033, delays=(0.010,), jitter=0.020)
GPS_5_HZ = SlowSensor(period=0.2)

SENSOR_SETS: dict[str, dict[str, SlowSensor]] = {
    "vision": {"camera": CAMERA_33_30},
    "vision-uneven": {"camera": _CAMERA_UNEVEN},
    "gps": {"gps": GPS_5_HZ},
    "fusion": {"camera": CAMERA_33_30, "gps": GPS_5_HZ},
}


def apply_changes(
    sensors: dict[str, SlowSensor], changes: Mapping[str, Mapping[str, Any] | None]
) -> dict[str, SlowSensor]:
    """Replace some fields of slow sensors; ValueError for an absent one, TypeError for a field.

    Args:
        sensors: Slow sensors by name.
        changes: By sensor, new values by the names of `SlowSensor`'s fields; None for no change.
    """
    changed = dict(sensors)
    for name, fields in changes.items():
        if fields is None:
            continue
        if name not in sensors:
            raise ValueError(f"this id has no {name}; it has: {', '.join(sensors)}")
        known = [field.name for field in dataclasses.fields(sensors[name])]
        if unknown := [key for key in check_mapping(name, fields) if key not in known]:
            raise TypeError(describe_unknown(f"number of the {name}", unknown, known))
        changed[name] = dataclasses.replace(sensors[name], **fields)
    return changed


_FILE = Path(__file__).parent / "camera" / "detector.json"
VISIONS = ("analytic", "image")
DELAYS = ("fitted", "measured", "link")
MAX_DELAY = 0.1  # s: a measured delay counts as no more


@dataclass(frozen=True)
class Detector:
    """Time of the lane finder, shift + exp(normal), and standard deviations of its results."""

    shift: float  # s
    log_mean: float
    log_sd: float
    range: tuple[float, float]  # s, limits of what is drawn
    noise: dict[str, float]  # by the names of `Noise`

    def compute_delay(self, share: float) -> float:
        """Compute the delay (s), within `range`, at a quantile of its distribution.

        Args:
            share: Quantile, in (0, 1).
        """
        from statistics import NormalDist  # 2 ms, which `import sideslip` does not need

        drawn = self.shift + math.exp(NormalDist(self.log_mean, self.log_sd).inv_cdf(share))
        return min(max(drawn, self.range[0]), self.range[1])


def count_delay_ticks(seconds: float) -> int:
    """Count the whole ticks, at least one, after which a result arrives.

    Args:
        seconds: Time that it takes (s).
    """
    return max(math.ceil(seconds / TICK - 1e-9), 1)


@functools.cache
def load_detector() -> Detector:
    """Load the detector on file."""
    values: dict[str, Any] = json.loads(_FILE.read_text())
    times, errors = values["seconds"], values["errors"]
    noise = {"camera_psi": errors["psi_rad"], "camera_y": errors["y_l_m"]}
    return Detector(**times | {"range": tuple(times["range"])}, noise=noise)
