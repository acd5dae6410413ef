"""The vehicles around ours: what they see of it, and the one that brakes."""

import numpy as np
import pytest

from sideslip.envs import make_vehicle
from sideslip.envs.highway.traffic import PERIOD, Hazard, Traffic, TrafficStart, _BrakingVehicle
from sideslip.envs.vehicle.dynamics import Motion

V = 20.0
CAR = make_vehicle("passenger-car")
AHEAD = Motion(V, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
START = TrafficStart(CAR, AHEAD, V, 0.5)


def traffic(hazard: Hazard | None = None, others: int = 0, road: str = "straight") -> Traffic:
    return Traffic(road, START, hazard, others, 5)


def coasting(around: Traffic, seconds: float) -> None:
    """Drive straight on."""
    for k in range(round(1000.0 * seconds) // PERIOD):
        around.step_road(AHEAD._replace(X=V * 1e-3 * PERIOD * (k + 1)))


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


def test_a_car_that_drives_on_into_the_braking_one_crashes() -> None:
    around = traffic(Hazard(headway=0.5, onset=0.0, braking=1.0))
    coasting(around, 1.0)
    assert not around.crashed
    coasting(around, 4.0)
    assert around.crashed


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
