"""The lanes that our car follows, and a point's place on them."""

import math

import numpy as np
import pytest

from sideslip.envs.highway.traffic import ROADS, LanePosition, locate_on_lane

from highway_env.road.lane import PolyLane, SineLane, StraightLane  # isort: skip


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("side", [1, -1])
def test_a_route_is_one_smooth_line_from_the_origin(road: str, side: int) -> None:
    course = ROADS[road](side)
    first = course.route[0]
    assert np.abs(first.position(0.0, 0.0)).max() == 0.0 and first.heading_at(0.0) == 0.0
    for before, after in zip(course.route, course.route[1:], strict=False):
        joint = before.position(before.length, 0.0) - after.position(0.0, 0.0)
        turn = before.heading_at(before.length) - after.heading_at(0.0)
        assert np.abs(joint).max() < 1e-9 and abs(math.remainder(turn, 2.0 * math.pi)) < 1e-12


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("side", [1, -1])
def test_the_free_lane_is_on_the_side_that_was_asked_for(road: str, side: int) -> None:
    course = ROADS[road](side)
    lanes = course.network.graph["a"]["b"]
    assert lanes[int(side > 0)] is course.route[0]
    assert -lanes[int(side < 0)].position(0.0, 0.0)[1] == side * 4.0  # our y points to the left


LANES = {
    "straight": StraightLane([3.0, -2.0], [90.0, 40.0]),
    "left": ROADS["curved"](1).route[1],
    "right": ROADS["curved"](1).route[2],
    "sine": SineLane([0.0, 0.0], [500.0, 0.0], 5.0, 2.0 * math.pi / 100.0, 0.3),
    "spline": PolyLane(
        [(0.0, 0.0), (30.0, 2.0), (60.0, -3.0), (90.0, 0.0)],
        [(0.0, 2.0), (30.0, 4.0), (60.0, -1.0), (90.0, 2.0)],
        [(0.0, -2.0), (30.0, 0.0), (60.0, -5.0), (90.0, -2.0)],
    ),
}


@pytest.mark.parametrize("name", ["straight", "left", "right", "sine"])
def test_a_place_is_the_foot_of_the_perpendicular(name: str) -> None:
    """From a point on the lane's normal, by the lane's own line and slope in fine differences."""
    lane, along, y, step = LANES[name], 37.0, 1.3, 1e-4
    centre, before, after = (lane.position(along + d, 0.0) for d in (0.0, -step, step))
    tangent = (after - before) / np.hypot(*(after - before))
    left = np.array([tangent[1], -tangent[0]])
    X, Y = centre + y * left
    found = locate_on_lane(lane, X, -Y, 0.0)
    theta = -math.atan2(tangent[1], tangent[0])
    assert found.y == pytest.approx(y, abs=1e-6)
    assert found.theta == pytest.approx(theta, abs=1e-6)
    assert found.longitudinal == pytest.approx(along, abs=1e-5)
    last, first = after - centre, centre - before
    turn = (first[1] * last[0] - first[0] * last[1]) / np.hypot(*last) ** 3
    assert found.curvature == pytest.approx(turn, abs=2e-5)


def test_the_curvature_of_a_sine_is_the_formulas() -> None:
    lane, x = LANES["sine"], 20.0
    A, w, phase = 5.0, 2.0 * math.pi / 100.0, 0.3
    slope, second = A * w * math.cos(w * x + phase), -A * w**2 * math.sin(w * x + phase)
    found = locate_on_lane(lane, x, -A * math.sin(w * x + phase), 0.0)
    assert found.curvature == pytest.approx(-second / (1.0 + slope**2) ** 1.5, rel=1e-4)


def test_a_place_on_a_spline_is_near_it() -> None:
    lane = LANES["spline"]
    place = locate_on_lane(lane, 45.0, -lane.position(45.0, 0.0)[1], 0.0)
    assert abs(place.y) < 0.5 and abs(place.theta) < 0.5


def test_directions_are_those_nearest_to_the_car() -> None:
    lane = StraightLane([0.0, 0.0], [100.0, 0.0])
    assert locate_on_lane(lane, 1.0, 2.0, 0.1) == LanePosition(1.0, 2.0, 0.0, 0.0)
    assert locate_on_lane(lane, 1.0, 2.0, 6.3).theta == 2.0 * math.pi
