"""Roads along a nominal car's path, and test tracks between cones with the driver's path on them.

ISO 3888-1 (double lane change) and ISO 3888-2 (obstacle avoidance) fix the lengths; the lanes'
widths grow with the vehicle's. A slower car drives the lengths scaled by its speed. ISO 3888-1's
offset of 3.5 m is taken between the lanes' right edges; the last's is in line with the first's.
"""

from itertools import pairwise
from typing import NamedTuple

from ..numerics.functions import PI, TICK, sincos, smoothstep
from ..numerics.jit import inline, jit
from ..numerics.primitives import Scalar, any_lane, floor, maximum, select
from ..vehicle.linear import Bicycle, compute_bicycle_coefficients

ROADS = ("straight", "nominal-path")
NOMINAL_PATH = ROADS.index("nominal-path")
_MIN_SPEED = 1.0  # m/s, of the nominal car


class NominalMotion(NamedTuple):
    """State of the nominal car whose path is the road."""

    beta: Scalar  # rad
    gamma: Scalar  # rad/s


@inline
def step_nominal_car(
    nominal_motion: NominalMotion, steer: Scalar, speed: Scalar, car: Bicycle
) -> tuple[Scalar, NominalMotion]:
    """Step the nominal car, whose path is the road, over a tick by explicit Euler.

    Its path has the direction psi + beta and turns by gamma + beta'. The road is a function of time
    and the seed alone: the true car has no effect on it.

    Args:
        nominal_motion: `NominalMotion` at the start of the tick.
        steer: Steering angle held over the tick (rad).
        speed: Speed (m/s), taken as at least 1.
        car: `Bicycle` of the nominal vehicle.

    Returns:
        Turning rate of the road during the tick (rad/s), and the `NominalMotion` at its end.
    """
    V = maximum(speed, _MIN_SPEED)
    a11, a12, a21, a22, b11, b21, _ = compute_bicycle_coefficients(car, V)
    dbeta = a11 * nominal_motion.beta + a12 * nominal_motion.gamma + b11 * steer
    dgamma = a21 * nominal_motion.beta + a22 * nominal_motion.gamma + b21 * steer
    beta, gamma = nominal_motion.beta + TICK * dbeta, nominal_motion.gamma + TICK * dgamma
    return nominal_motion.gamma + dbeta, NominalMotion(beta, gamma)


_TRANSITION_OVERLAP = 0.15  # of a gap's length: the path's transition reaches so far into the lanes


class Section(NamedTuple):
    """A lane between cones."""

    start: float  # m, along the road
    length: float  # m
    width: float  # m, between the cones
    offset: float  # m, its centre line to the left of the road's


class TrackPath(NamedTuple):
    """A lateral offset from the road's centre line: two smooth transitions."""

    shift_1: Scalar  # m, to the left
    start_1: Scalar  # m, along the road
    length_1: Scalar  # m
    shift_2: Scalar
    start_2: Scalar
    length_2: Scalar
    # a weave to the left before it, from the start of an episode on
    weave: Scalar = 0.0  # m
    weave_start: Scalar = 0.0  # m, along the road
    weave_end: Scalar = 0.0
    weave_rate: Scalar = 0.0  # rad/m


def _make_iso_3888_1(width: float) -> tuple[Section, ...]:
    """Make the lanes of a double lane change for a vehicle's width (m)."""
    first, side, last = 1.1 * width + 0.25, 1.2 * width + 0.25, 1.3 * width + 0.25
    return (
        Section(0.0, 15.0, first, 0.0),
        Section(45.0, 25.0, side, 3.5 + 0.5 * (side - first)),
        Section(95.0, 30.0, last, 0.5 * (last - first)),  # sections 5 and 6
    )


def _make_iso_3888_2(width: float) -> tuple[Section, ...]:
    """Make the lanes of an obstacle avoidance for a vehicle's width (m)."""
    first, side, last = 1.1 * width + 0.25, width + 1.0, max(1.3 * width + 0.25, 3.0)
    return (
        Section(0.0, 12.0, first, 0.0),
        Section(25.5, 11.0, side, 1.0 + 0.5 * (first + side)),  # 1 m from edge to edge
        Section(49.0, 12.0, last, 0.5 * (last - first)),
    )


_TRACKS = {"iso-3888-1": _make_iso_3888_1, "iso-3888-2": _make_iso_3888_2}
PATHS = ("road", *_TRACKS)


def make_sections(
    track: str, width: float, start: float = 0.0, scale: float = 1.0, side: float = 1.0
) -> tuple[Section, ...]:
    """Make the lanes of a track in the order of driving, none of "road"; ValueError for others."""
    if track not in PATHS:
        raise ValueError(f"unknown track {track!r}; known: {', '.join(PATHS)}")
    return tuple(
        Section(start + scale * lane.start, scale * lane.length, lane.width, side * lane.offset)
        for lane in (_TRACKS[track](width) if track in _TRACKS else ())
    )


def make_path(track: str, width: float) -> TrackPath:
    """Make the path through a track that begins at 0, in the standard's lengths.

    It keeps to a lane's centre but for `_TRANSITION_OVERLAP` at the ends, where the sides of the
    car stay between the cones.
    """
    shifts = []
    for before, after in pairwise(make_sections(track, width)):
        lane_end = before.start + before.length
        gap = after.start - lane_end
        shifts += [after.offset - before.offset, lane_end - _TRANSITION_OVERLAP * gap]
        shifts.append((1.0 + 2.0 * _TRANSITION_OVERLAP) * gap)
    return TrackPath(*(shifts or (0.0, 0.0, 1.0, 0.0, 0.0, 1.0)))


@jit
def transform_path(path: TrackPath, start: Scalar, scale: Scalar, side: Scalar) -> TrackPath:
    """Shift, scale and mirror the path of a track that begins at 0."""
    return TrackPath(
        side * path.shift_1, start + scale * path.start_1, scale * path.length_1,
        side * path.shift_2, start + scale * path.start_2, scale * path.length_2,
        path.weave, path.weave_start, path.weave_end, path.weave_rate,
    )  # fmt: skip


_WEAVE, _WEAVE_TIME = 1.0, 5.0  # m from side to side, s: gentle, 0.8 m/s2


@jit
def add_weave(path: TrackPath, start: Scalar, speed: Scalar, duration: Scalar) -> TrackPath:
    """Add a gentle weave before the track, in whole waves."""
    distance = maximum(speed, _MIN_SPEED) * duration
    rate = 2.0 * PI * maximum(floor(duration / _WEAVE_TIME + 0.5), 1.0) / distance
    weave = (_WEAVE, start, start + distance, rate)
    return TrackPath(*(path[:6] + weave))


@jit
def compute_path_offset(path: TrackPath, s: Scalar) -> Scalar:
    """Compute the path's offset (m) to the left of the road's centre, whose slope is continuous."""
    first = path.shift_1 * smoothstep((s - path.start_1) / path.length_1)
    offset = first + path.shift_2 * smoothstep((s - path.start_2) / path.length_2)
    if any_lane(path.weave != 0.0):
        is_within = (s > path.weave_start) & (s < path.weave_end)
        cosine = sincos(path.weave_rate * (s - path.weave_start))[1]
        offset = offset + select(is_within, path.weave * 0.5 * (1.0 - cosine), 0.0)
    return offset
