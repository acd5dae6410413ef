"""ISO 3888: which cones a rectangle touches."""

import numpy as np
import pytest

from sideslip.benchmarks.procedures import iso, suite
from sideslip.benchmarks.procedures.drive import Fields, Series, TestCar
from sideslip.envs import PASSENGER_CAR
from sideslip.envs.record import Array
from sideslip.envs.scenarios.road import Section

CAR = TestCar(PASSENGER_CAR, 80.0 / 3.6, 16.0, 4.2, 0.8)
WIDTH = PASSENGER_CAR.width


def series(X: Array, Y: Array, psi: Array) -> Series:
    t = np.linspace(0.0, 0.01 * (len(X) - 1), len(X))
    zero = 0.0 * t
    return Series(t, zero, zero + 20.0, zero, zero, psi, X, Y, zero)


def straight(y: float = 0.0, psi: float = 0.0, end: float = 60.0) -> Array:
    X = np.arange(-10.0, end, 0.05)
    return iso._compute_corners(series(X, np.full_like(X, y), np.full_like(X, psi)), CAR)


def test_corners_are_those_of_the_body() -> None:
    front = PASSENGER_CAR.front_arm + 0.8
    at = iso._compute_corners(
        series(np.array([5.0]), np.array([1.0]), np.array([0.5 * np.pi])), CAR
    )
    expected = [
        [5.0 - 0.5 * WIDTH, 1.0 + front],
        [5.0 + 0.5 * WIDTH, 1.0 + front],
        [5.0 + 0.5 * WIDTH, 1.0 + front - 4.2],
        [5.0 - 0.5 * WIDTH, 1.0 + front - 4.2],
    ]
    np.testing.assert_allclose(at[0], expected, atol=1e-12)


def test_straight_through_the_middle_leaves_half_of_the_room_on_each_side() -> None:
    lane = Section(0.0, 15.0, WIDTH + 0.5, 0.0)
    assert iso._compute_margin(straight(), lane) == pytest.approx(0.25)
    assert iso._compute_margin(straight(0.3), lane) == pytest.approx(-0.05)
    assert iso._compute_margin(straight(3.5), lane._replace(offset=3.5)) == pytest.approx(0.25)


def test_a_turned_body_needs_more_room() -> None:
    """While it is in the lane, its half extent across is at most (w cos + l sin) / 2."""
    lane = Section(0.0, 40.0, WIDTH + 2.0, 0.0)
    angle, middle = 0.2, PASSENGER_CAR.front_arm + 0.8 - 2.1
    body = straight(-middle * np.sin(angle), angle)
    extent = 0.5 * (WIDTH * np.cos(angle) + 4.2 * np.sin(angle))
    assert iso._compute_margin(body, lane) == pytest.approx(0.5 * lane.width - extent, abs=1e-9)


def test_a_side_touches_a_cone_that_no_corner_passes() -> None:
    """A body across a lane shorter than itself: its corners never are in it."""
    body = np.array([[[10.0, 1.0], [10.0, -1.0], [0.0, -2.0], [0.0, 0.0]]])
    lane = Section(4.0, 2.0, 4.0, 0.0)
    assert iso._compute_margin(body, lane) == pytest.approx(2.0 - 1.6)  # the lower side at x = 4
    assert iso._compute_margin(body, lane._replace(width=3.0)) < 0.0


def test_a_lane_that_was_not_driven_through_has_no_margin() -> None:
    assert np.isnan(iso._compute_margin(straight(end=10.0), Section(0.0, 15.0, 3.0, 0.0)))
    stopped = series(np.arange(0.0, 10.0), np.zeros(10), np.zeros(10))
    run = iso._evaluate_run(stopped, CAR, "iso-3888-1", 20.0)
    assert run.min_margin == -np.inf
    assert not run.passed


def test_a_path_down_the_lanes_centres_passes_and_straight_on_does_not() -> None:
    speed = 20.0
    lanes = iso._make_lanes(CAR, "iso-3888-1", speed)
    X = np.arange(0.0, lanes[-1].start + lanes[-1].length + 10.0, 0.1)
    knots = [[lane.start - 6.0, lane.start + lane.length + 4.0] for lane in lanes]
    Y = np.interp(X, np.ravel(knots), np.repeat([lane.offset for lane in lanes], 2))
    followed = iso._evaluate_run(series(X, Y, 0.0 * X), CAR, "iso-3888-1", speed)
    assert followed.passed
    straight_on = iso._evaluate_run(series(X, 0.0 * X, 0.0 * X), CAR, "iso-3888-1", speed)
    assert [margin >= 0.0 for margin in straight_on.margins] == [True, False, True]


@pytest.mark.parametrize("track", iso.TRACKS)
def test_the_highest_speed_is_that_of_a_clean_run_of_any_driver(track: str) -> None:
    driven = []

    def drive(fields: Fields) -> Series:
        driven.append((fields["speed"], fields["driver_gain"]))
        lanes = iso._make_lanes(CAR, track, fields["speed"])
        X = np.arange(0.0, lanes[-1].start + lanes[-1].length + 10.0, 0.1)
        knots = [[lane.start - 5.0, lane.start + lane.length + 4.0] for lane in lanes]
        Y = np.interp(X, np.ravel(knots), np.repeat([lane.offset for lane in lanes], 2))
        skilled = fields["speed"] < 11.5 or (fields["speed"] < 12.5 and fields["driver_gain"] > 0.9)
        return series(X, Y if skilled else 0.0 * Y, 0.0 * X)

    runs = [iso.run_track(drive, CAR, track, speed) for speed in (11.0, 12.0, 13.0)]
    assert [speed for speed, _ in driven] == [11.0] + 3 * [12.0] + len(iso.DRIVERS) * [13.0]
    assert [run.passed for run in runs] == [True, True, False]
    assert suite._find_highest_speed(runs) == 12.0
    assert suite._find_highest_speed(runs[-1:]) == 0.0
