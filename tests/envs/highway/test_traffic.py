"""The traffic around our car, and its place on highway-env's lanes."""

import math

import numpy as np
import pytest

from sideslip.envs import make_vehicle
from sideslip.envs.highway.traffic import (
    PERIOD,
    ROADS,
    Hazard,
    LanePosition,
    Traffic,
    TrafficStart,
    _BrakingVehicle,
    locate_on_lane,
)
from sideslip.envs.vehicle.dynamics import Motion

from highway_env.road.lane import SineLane, StraightLane  # isort: skip


V = 20.0
CAR = make_vehicle("passenger-car")
AHEAD = Motion(V, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
START = TrafficStart(CAR, AHEAD, V, 0.5)


def traffic(hazard: Hazard | None = None, others: int = 0, road: str = "straight") -> Traffic:
    return Traffic(road, START, hazard, others, 5)


def test_our_car_is_where_its_body_is() -> None:
    """y to the left is highway-env's minus y, the box is centred between the bumpers."""
    ours = traffic().ego
    ours.set_motion(AHEAD._replace(X=10.0, Y=2.0, psi=0.3, v_y=1.0))
    centre = 0.5 * (CAR.front_arm - CAR.rear_arm)
    place = [10.0 + centre * np.cos(0.3), -2.0 - centre * np.sin(0.3)]
    assert ours.position == pytest.approx(place)
    assert ours.heading == -0.3
    course = -np.arctan2(ours.velocity[1], ours.velocity[0])
    assert course == pytest.approx(0.3 + np.arctan2(1.0, V))


def test_the_one_ahead_brakes_as_it_was_drawn_and_never_backs_up() -> None:
    hazard = Hazard(headway=1.0, onset=0.5, braking=0.8)
    around = traffic(hazard)
    lead = around.road.vehicles[1]
    assert isinstance(lead, _BrakingVehicle)
    gap = lead.position[0] - around.ego.position[0] - 0.5 * (lead.LENGTH + around.ego.LENGTH)
    assert gap == pytest.approx(V)
    speeds = []
    for k in range(140):
        around.step_road(AHEAD._replace(X=V * 1e-3 * PERIOD * (k + 1), Y=6.0))
        speeds.append(lead.speed)
    assert -np.diff(speeds[20:40]) == pytest.approx(0.8 * 0.5 * 9.81 * 0.05)
    assert speeds[-1] == 0.0 and min(speeds) == 0.0


@pytest.mark.parametrize("road", ["straight", "curved"])
def test_others_begin_on_lanes_where_the_road_bends_too(road: str) -> None:
    """Those far ahead began straight on, up to 9 m beside their lane."""
    around = traffic(others=20, road=road)
    ego = int(around.course.side > 0)
    expected = [1 - ego, ego, ego, 1 - ego]
    for i, vehicle in enumerate(around.road.vehicles[1:]):
        along, right = vehicle.lane.local_coordinates(vehicle.position)
        assert abs(right) < 1e-9 and vehicle.lane_index[2] == expected[i % 4]
        assert vehicle.heading == pytest.approx(vehicle.lane.heading_at(along))


def test_those_behind_see_our_car_and_brake_or_pass() -> None:
    around = traffic(others=4)
    ours, *others = around.road.vehicles
    behind = [v for v in others if v.position[0] < 0.0 and abs(v.position[1]) < 1.0]
    slowest = V
    for _ in range(300):
        around.step_road(AHEAD._replace(v_x=0.0))
        slowest = min([slowest, *(v.speed for v in behind)])
    assert len(behind) == 1 and slowest < 0.6 * V
    assert not any(v.crashed for v in (ours, *others))


def test_an_impact_that_highway_env_foresees_is_a_crash_to_both() -> None:
    """Closer than the next step goes, whatever our car does then: they never overlap."""
    around = traffic(Hazard(headway=1.0, onset=0.0, braking=1.0))
    lead = around.road.vehicles[1]
    lead.speed = 0.0
    reach = 0.5 * (lead.LENGTH + around.ego.LENGTH) + around.ego._centre
    near = AHEAD._replace(X=lead.position[0] - reach - 0.5 * V * 1e-3 * PERIOD)
    around.step_road(near)
    assert not around.crashed and not lead.crashed
    around.step_road(near._replace(Y=9.0))
    assert around.crashed and lead.crashed


@pytest.mark.parametrize("away", [2.8, 3.0])
def test_a_car_has_departed_whose_width_is_beyond_the_edge(away: float) -> None:
    """The edge line is 2 m to the side where no lane is free, the car 1.8 m wide."""
    around = traffic()
    side = -float(around.course.side)
    around.step_road(AHEAD._replace(Y=side * away))
    assert around.departed == (away > 2.0 + 0.5 * CAR.width)
    around.step_road(AHEAD._replace(Y=-side * away))  # in the free lane
    assert not around.departed


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
}


@pytest.mark.parametrize("name", LANES)
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


def test_directions_are_those_nearest_to_the_car() -> None:
    lane = StraightLane([0.0, 0.0], [100.0, 0.0])
    assert locate_on_lane(lane, 1.0, 2.0, 0.1) == LanePosition(1.0, 2.0, 0.0, 0.0)
    assert locate_on_lane(lane, 1.0, 2.0, 6.3).theta == 2.0 * math.pi
