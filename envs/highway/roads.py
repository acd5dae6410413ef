"""Road networks of highway-env with the lanes that our car follows, and a place on these lanes.

Our car begins at the origin, along x, at the centre of its own lane; the free lane beside it is to
its left (side 1) or to its right (-1). Every road begins straight.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..backend.extras import require_extra
from ..rendering import canvas

with require_extra("highway", "roads and traffic need highway-env"):
    from highway_env.road.lane import CircularLane, LineType, SineLane, StraightLane
    from highway_env.road.road import RoadNetwork

assert canvas  # which keeps pygame from greeting
WIDTH = StraightLane.DEFAULT_WIDTH  # m
ENTRY, BEHIND, BEYOND = 60.0, -300.0, 3000.0  # m: straight to begin with, where roads begin and end
RADIUS, ANGLE = 400.0, math.radians(60.0)  # of either bend
_LINE, _DASHES, _NONE = LineType.CONTINUOUS_LINE, LineType.STRIPED, LineType.NONE
_FAST = 60.0  # m/s, no limit
_STEP = 0.05  # m, of differences along a lane


class RoadLayout(NamedTuple):
    """A network and the lanes that our car follows in it.

    Attributes:
        network: highway-env's network.
        route: Our lanes, one after the other.
        own_lane: Index of our lane among those of each road.
        free_lane: Index of the lane beside it.
        ramp: Index of the lane from which others merge; None without a ramp.
    """

    network: Any
    route: tuple[Any, ...]
    own_lane: int
    free_lane: int
    ramp: tuple[str, str, int] | None = None  # where others merge from


class LanePosition(NamedTuple):
    """Position of a point on a lane, in our axes."""

    longitudinal: float  # the lane's own coordinate, which need not be an arc length
    y: float  # m, left of the lane's centre line
    theta: float  # rad, the lane's direction
    curvature: float  # 1/m, left positive


def make_straight(side: int) -> RoadLayout:
    """Make two lanes straight ahead.

    Args:
        side: Side of the free lane, 1 left or -1 right.

    Returns:
        The layout.
    """
    network = RoadNetwork()
    _add_straight(network, "start", "a", side, BEHIND, 0.0)
    route = _add_straight(network, "a", "b", side, 0.0, BEYOND)
    return RoadLayout(network, tuple(route), *_get_lane_indices(side))


def make_curved(side: int) -> RoadLayout:
    """Make two lanes through a bend to the left and one to the right, with circular arcs.

    Args:
        side: Side of the free lane, 1 left or -1 right.

    Returns:
        The layout.
    """
    network, route = RoadNetwork(), []
    _add_straight(network, "start", "a", side, BEHIND, 0.0)
    route += _add_straight(network, "a", "b", side, 0.0, ENTRY)
    position, heading = np.array([ENTRY, 0.0]), 0.0
    for first, last, turn in (("b", "c", 1.0), ("c", "d", -1.0)):
        centre = position + turn * RADIUS * np.array([math.sin(heading), -math.cos(heading)])
        phase = heading + turn * 0.5 * math.pi
        for offset, lines in _list_lanes(side):
            radius = RADIUS + turn * offset
            ends = phase, phase - turn * ANGLE
            lane = CircularLane(centre, radius, *ends, turn < 0.0, WIDTH, lines, speed_limit=_FAST)
            network.add_lane(first, last, lane)
            route += [lane] * (offset == 0.0)
        position, heading = route[-1].position(route[-1].length, 0.0), heading - turn * ANGLE
    route += _add_straight(network, "d", "e", side, position[0], position[0] + BEYOND, position[1])
    return RoadLayout(network, tuple(route), *_get_lane_indices(side))


def make_merging(side: int) -> RoadLayout:
    """Make two lanes straight ahead that others join from a ramp on the right, as on `merge-v0`.

    Args:
        side: Side of the free lane, 1 left or -1 right.

    Returns:
        The layout.
    """
    network, route = RoadNetwork(), []
    _add_straight(network, "start", "a", side, BEHIND, 0.0)
    for first, last, start, end in (("a", "b", 0.0, 200.0), ("b", "c", 200.0, 350.0)):
        route += _add_straight(network, first, last, side, start, end)
    route += _add_straight(network, "c", "d", side, 350.0, BEYOND)
    edge, sway, lines = max(offset for offset, _ in _list_lanes(side)) + WIDTH, 3.25, (_LINE, _LINE)
    far, lane_options = (
        edge + 2.0 * sway,
        {"line_types": lines, "forbidden": True, "speed_limit": _FAST},
    )
    ramp = StraightLane([BEHIND, far], [120.0, far], **lane_options)
    ends = [120.0, far - sway], [200.0, far - sway]
    bend = SineLane(*ends, sway, math.pi / 80.0, 0.5 * math.pi, **lane_options)
    last = StraightLane(
        [200.0, edge], [350.0, edge], **lane_options | {"line_types": (_NONE, _LINE)}
    )
    for first, end_node, lane in (("j", "k", ramp), ("k", "b", bend), ("b", "c", last)):
        network.add_lane(first, end_node, lane)
    return RoadLayout(network, tuple(route), *_get_lane_indices(side), ("j", "k", 0))


ROADS: dict[str, Callable[[int], RoadLayout]] = {
    "straight": make_straight,
    "curved": make_curved,
    "merging": make_merging,
}
"""What lays each road, for the side of the free lane."""


def _list_lanes(side: int) -> list[tuple[float, tuple[int, int]]]:
    """(offset in m to the right of ours, its lines) of both lanes, from left to right."""
    left = -WIDTH if side > 0 else 0.0
    return [(left, (_LINE, _DASHES)), (left + WIDTH, (_NONE, _LINE))]


def _get_lane_indices(side: int) -> tuple[int, int]:
    return (1, 0) if side > 0 else (0, 1)


def _add_straight(
    network: Any, first: str, last: str, side: int, start: float, end: float, y: float = 0.0
) -> list[Any]:
    """Lay both lanes of a straight stretch from x = start to end, ours at y; returns ours."""
    for offset, lines in _list_lanes(side):
        ends = [start, y + offset], [end, y + offset]
        network.add_lane(first, last, StraightLane(*ends, WIDTH, lines, speed_limit=_FAST))
    return [network.graph[first][last][_get_lane_indices(side)[0]]]


def locate_on_lane(lane: Any, X: float, Y: float, psi: float) -> LanePosition:
    """Locate a point of our axes on a lane of highway-env's.

    `local_coordinates` is exact on straight and circular lanes. On others, whose coordinate is no
    arc length or whose lateral is not at right angles, Newton's method finds the foot.

    Args:
        lane: Lane of highway-env.
        X: Place on the ground in our axes (m).
        Y: Place on the ground in our axes (m).
        psi: Heading in our axes (rad), to whose turn the lane's direction is unwrapped.

    Returns:
        The position.
    """
    point = np.array([X, -Y])
    longitudinal, right = lane.local_coordinates(point)
    if isinstance(lane, CircularLane):
        bend = -lane.direction / lane.radius
    elif type(lane) is StraightLane:
        bend = 0.0
    else:
        for _ in range(4):
            direction = np.array(
                [math.cos(lane.heading_at(longitudinal)), math.sin(lane.heading_at(longitudinal))]
            )
            offset = point - lane.position(longitudinal, 0.0)
            longitudinal += float(direction @ offset) / _compute_scale(lane, longitudinal)
            right = float(direction[0] * offset[1] - direction[1] * offset[0])
        heading_change = lane.heading_at(longitudinal + _STEP) - lane.heading_at(
            longitudinal - _STEP
        )
        bend = -heading_change / (2.0 * _STEP * _compute_scale(lane, longitudinal))
    lane_direction = -lane.heading_at(longitudinal)
    theta = lane_direction + 2.0 * math.pi * round((psi - lane_direction) / (2.0 * math.pi))
    return LanePosition(float(longitudinal), -float(right), float(theta), float(bend))


def _compute_scale(lane: Any, longitudinal: float) -> float:
    """Compute the metres of a unit of a lane's own coordinate."""
    chord = lane.position(longitudinal + _STEP, 0.0) - lane.position(longitudinal - _STEP, 0.0)
    return float(np.hypot(*chord)) / (2.0 * _STEP)
