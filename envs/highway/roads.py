"""Road networks of highway-env with the lanes that our car follows, and a place on these lanes.

Our car begins at the origin, along x, at the centre of its own lane; the free lane beside it is to
its left (side 1) or to its right (-1). Every road begins straight.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..backend.extras import extra
from ..rendering import canvas

with extra("highway", "roads and traffic need highway-env"):
    from highway_env.road.lane import CircularLane, LineType, SineLane, StraightLane
    from highway_env.road.road import RoadNetwork

assert canvas  # which keeps pygame from greeting
WIDTH = StraightLane.DEFAULT_WIDTH  # m
ENTRY, BEHIND, BEYOND = 60.0, -300.0, 3000.0  # m: straight to begin with, where roads begin and end
RADIUS, ANGLE = 400.0, math.radians(60.0)  # of either bend
_LINE, _DASHES, _NONE = LineType.CONTINUOUS_LINE, LineType.STRIPED, LineType.NONE
_FAST = 60.0  # m/s, no limit
_STEP = 0.05  # m, of differences along a lane


class Course(NamedTuple):
    """A network and the lanes that our car follows in it, one after the other.

    own, free: the index of our lane and of the one beside it, among those of each road.
    """

    network: Any
    route: tuple[Any, ...]
    own: int
    free: int
    ramp: tuple[str, str, int] | None = None  # where others merge from


class Place(NamedTuple):
    """Where a point lies on a lane, in our axes."""

    along: float  # the lane's own coordinate, which need not be an arc length
    y: float  # m, left of the lane's centre line
    theta: float  # rad, the lane's direction
    curvature: float  # 1/m, left positive


def straight(side: int) -> Course:
    """Two lanes straight ahead."""
    network = RoadNetwork()
    _straight(network, "start", "a", side, BEHIND, 0.0)
    route = _straight(network, "a", "b", side, 0.0, BEYOND)
    return Course(network, tuple(route), *_indices(side))


def curved(side: int) -> Course:
    """Two lanes through a bend to the left and one to the right, with circular arcs."""
    network, route = RoadNetwork(), []
    _straight(network, "start", "a", side, BEHIND, 0.0)
    route += _straight(network, "a", "b", side, 0.0, ENTRY)
    place, heading = np.array([ENTRY, 0.0]), 0.0
    for first, last, turn in (("b", "c", 1.0), ("c", "d", -1.0)):
        centre = place + turn * RADIUS * np.array([math.sin(heading), -math.cos(heading)])
        phase = heading + turn * 0.5 * math.pi
        for offset, lines in _lanes(side):
            radius = RADIUS + turn * offset
            ends = phase, phase - turn * ANGLE
            lane = CircularLane(centre, radius, *ends, turn < 0.0, WIDTH, lines, speed_limit=_FAST)
            network.add_lane(first, last, lane)
            route += [lane] * (offset == 0.0)
        place, heading = route[-1].position(route[-1].length, 0.0), heading - turn * ANGLE
    route += _straight(network, "d", "e", side, place[0], place[0] + BEYOND, place[1])
    return Course(network, tuple(route), *_indices(side))


def merging(side: int) -> Course:
    """Two lanes straight ahead that others join from a ramp on the right, as on `merge-v0`."""
    network, route = RoadNetwork(), []
    _straight(network, "start", "a", side, BEHIND, 0.0)
    for first, last, start, end in (("a", "b", 0.0, 200.0), ("b", "c", 200.0, 350.0)):
        route += _straight(network, first, last, side, start, end)
    route += _straight(network, "c", "d", side, 350.0, BEYOND)
    edge, sway, lines = max(offset for offset, _ in _lanes(side)) + WIDTH, 3.25, (_LINE, _LINE)
    far, rest = edge + 2.0 * sway, {"line_types": lines, "forbidden": True, "speed_limit": _FAST}
    ramp = StraightLane([BEHIND, far], [120.0, far], **rest)
    ends = [120.0, far - sway], [200.0, far - sway]
    bend = SineLane(*ends, sway, math.pi / 80.0, 0.5 * math.pi, **rest)
    last = StraightLane([200.0, edge], [350.0, edge], **rest | {"line_types": (_NONE, _LINE)})
    for first, to, lane in (("j", "k", ramp), ("k", "b", bend), ("b", "c", last)):
        network.add_lane(first, to, lane)
    return Course(network, tuple(route), *_indices(side), ("j", "k", 0))


ROADS: dict[str, Callable[[int], Course]] = {
    "straight": straight,
    "curved": curved,
    "merging": merging,
}
"""What lays each road, for the side of the free lane."""


def _lanes(side: int) -> list[tuple[float, tuple[int, int]]]:
    """(offset in m to the right of ours, its lines) of both lanes, from left to right."""
    left = -WIDTH if side > 0 else 0.0
    return [(left, (_LINE, _DASHES)), (left + WIDTH, (_NONE, _LINE))]


def _indices(side: int) -> tuple[int, int]:
    return (1, 0) if side > 0 else (0, 1)


def _straight(
    network: Any, first: str, last: str, side: int, start: float, end: float, y: float = 0.0
) -> list[Any]:
    """Lay both lanes of a straight stretch from x = start to end, ours at y; returns ours."""
    for offset, lines in _lanes(side):
        ends = [start, y + offset], [end, y + offset]
        network.add_lane(first, last, StraightLane(*ends, WIDTH, lines, speed_limit=_FAST))
    return [network.graph[first][last][_indices(side)[0]]]


def place_on(lane: Any, X: float, Y: float, psi: float) -> Place:
    """The foot of a point of our axes on a lane of highway-env's; psi: rad, our heading there.

    `local_coordinates` is exact on straight and circular lanes. On others, whose coordinate is no
    arc length or whose lateral is not at right angles, Newton's method finds the foot.
    """
    point = np.array([X, -Y])
    along, right = lane.local_coordinates(point)
    if isinstance(lane, CircularLane):
        bend = -lane.direction / lane.radius
    elif type(lane) is StraightLane:
        bend = 0.0
    else:
        for _ in range(4):
            ahead = np.array([math.cos(lane.heading_at(along)), math.sin(lane.heading_at(along))])
            away = point - lane.position(along, 0.0)
            along += float(ahead @ away) / _metres(lane, along)
            right = float(ahead[0] * away[1] - ahead[1] * away[0])
        turned = lane.heading_at(along + _STEP) - lane.heading_at(along - _STEP)
        bend = -turned / (2.0 * _STEP * _metres(lane, along))
    raw = -lane.heading_at(along)
    theta = raw + 2.0 * math.pi * round((psi - raw) / (2.0 * math.pi))
    return Place(float(along), -float(right), float(theta), float(bend))


def _metres(lane: Any, along: float) -> float:
    """How many metres a unit of a lane's own coordinate is."""
    chord = lane.position(along + _STEP, 0.0) - lane.position(along - _STEP, 0.0)
    return float(np.hypot(*chord)) / (2.0 * _STEP)
