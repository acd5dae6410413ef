"""ISO 3888, 4138, 7401: cones that a rectangle touches, the linear car's gradient and responses."""

import math

import numpy as np
import pytest
from scipy.signal import chirp, lsim

from sideslip.benchmarks.procedures import iso, suite
from sideslip.benchmarks.procedures.drive import Fields, Series, TestCar
from sideslip.envs import COMS, PASSENGER_CAR, Vehicle
from sideslip.envs.record import Array
from sideslip.envs.scenarios.road import Section
from sideslip.envs.vehicle.linear import make_bicycle_model

CAR = TestCar(PASSENGER_CAR, 80.0 / 3.6, 16.0, 4.2, 0.8)
WIDTH = PASSENGER_CAR.width


def series(X: Array, Y: Array, psi: Array) -> Series:
    t = np.linspace(0.0, 0.01 * (len(X) - 1), len(X))
    zero = 0.0 * t
    return Series(t, zero, zero + 20.0, zero, zero, psi, X, Y)


def straight(y: float = 0.0, psi: float = 0.0, end: float = 60.0) -> Array:
    X = np.arange(-10.0, end, 0.05)
    return iso._compute_corners(series(X, np.full_like(X, y), np.full_like(X, psi)), CAR)


def follow_lanes(track: str, speed: float) -> tuple[Array, Array]:
    """X and Y (m) of a path down the middle of every lane of a track."""
    lanes = iso._make_lanes(CAR, track, speed)
    X = np.arange(0.0, lanes[-1].start + lanes[-1].length + 10.0, 0.1)
    knots = [[lane.start - 5.0, lane.start + lane.length + 4.0] for lane in lanes]
    return X, np.interp(X, np.ravel(knots), np.repeat([lane.offset for lane in lanes], 2))


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
    X, Y = follow_lanes("iso-3888-1", speed)
    followed = iso._evaluate_run(series(X, Y, 0.0 * X), CAR, "iso-3888-1", speed)
    assert followed.passed
    straight_on = iso._evaluate_run(series(X, 0.0 * X, 0.0 * X), CAR, "iso-3888-1", speed)
    assert [margin >= 0.0 for margin in straight_on.margins] == [True, False, True]


@pytest.mark.parametrize("track", iso.TRACKS)
def test_the_highest_speed_is_that_of_a_clean_run_of_any_driver(track: str) -> None:
    driven = []

    def drive(fields: Fields) -> Series:
        driven.append((fields["speed"], fields["driver_gain"]))
        X, Y = follow_lanes(track, fields["speed"])
        skilled = fields["speed"] < 11.5 or (fields["speed"] < 12.5 and fields["driver_gain"] > 0.9)
        return series(X, Y if skilled else 0.0 * Y, 0.0 * X)

    runs = [iso.run_track(drive, CAR, track, speed) for speed in (11.0, 12.0, 13.0)]
    assert [speed for speed, _ in driven] == [11.0] + 3 * [12.0] + len(iso.DRIVERS) * [13.0]
    assert [run.passed for run in runs] == [True, True, False]
    assert suite._find_highest_speed(runs) == 12.0
    assert suite._find_highest_speed(runs[-1:]) == 0.0


V = 20.0
CARS = pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR], ids=lambda car: car.name)


def linear(vehicle: Vehicle, speed: float, t: np.ndarray, steer: np.ndarray) -> Series:
    """The linear car under a steering angle, exact between samples that a line joins."""
    model = make_bicycle_model(vehicle, speed)
    x = lsim((model.A, model.B[:, :1], np.eye(2), np.zeros((2, 1))), steer, t)[1]
    zero, beta, gamma = np.zeros_like(t), x[:, 0], x[:, 1]
    return Series(t, steer, zero + speed, speed * beta, gamma, zero, zero, zero)


def test_numbers_of_a_second_order_step_are_the_textbooks() -> None:
    omega, zeta, gain = 5.0, 0.3, 2.5
    t = np.arange(0.0, 20.0, 1e-4)
    steer = np.where(t >= 1.0, 0.1, 0.0)
    system = ([gain * omega**2], [1.0, 2.0 * zeta * omega, omega**2])
    output = lsim(system, steer, t)[1]
    found = iso._compute_step_response(t, steer, output)
    damped = omega * math.sqrt(1.0 - zeta**2)
    assert found.gain == pytest.approx(gain, rel=1e-6)
    assert found.peak_time == pytest.approx(math.pi / damped, abs=2e-4)
    assert found.overshoot == pytest.approx(math.exp(-math.pi * zeta * omega / damped), rel=1e-4)
    again = iso._compute_step_response(t, -steer, -output)
    assert vars(again) == pytest.approx(vars(found))


def test_a_first_order_step_has_no_overshoot_and_its_90_percent_at_2_3_time_constants() -> None:
    t = np.arange(0.0, 10.0, 1e-4)
    steer = np.where(t >= 1.0, 0.1, 0.0)
    output = np.where(t >= 1.0, 1.0 - np.exp(-(t - 1.0) / 0.3), 0.0)
    found = iso._compute_step_response(t, steer, output)
    assert found.response_time == pytest.approx(0.3 * math.log(10.0), abs=2e-4)
    assert found.overshoot == pytest.approx(0.0, abs=1e-6)


def test_times_count_from_half_the_steering() -> None:
    t = np.arange(0.0, 10.0, 1e-3)
    late = iso._compute_step_response(t, np.clip(t - 1.0, 0.0, 1.0), np.clip(t - 3.0, 0.0, 1.0))
    assert late.response_time == pytest.approx(3.9 - 1.5, abs=1e-6)


def test_without_a_step_there_is_no_response() -> None:
    t = np.arange(0.0, 3.0, 0.01)
    with pytest.raises(ValueError, match="needs a steering angle at its end"):
        iso._compute_step_response(t, 0.0 * t, t)


@CARS
def test_the_frequency_response_of_the_linear_car_is_the_matrices(vehicle: Vehicle) -> None:
    speed = 10.0 if vehicle is COMS else V
    t = np.arange(0.0, 104.0, 0.01)
    steer = np.where(t < 100.0, 0.02 * chirp(t, 0.05, 100.0, 2.5, phi=-90.0), 0.0)
    driven = linear(vehicle, speed, t, steer)
    for name in iso.OUTPUTS:
        found = iso._estimate_frequency_response(driven.t, driven.steer, getattr(driven, name))
        theory = iso._compute_linear_response(vehicle, speed, found.frequency)[name]
        assert found.frequency[[0, -1]].tolist() == pytest.approx([0.2, 2.0])
        assert (np.abs(found.H - theory) < 2.0 * found.sd).all()
        np.testing.assert_allclose(found.H, theory, rtol=0.02)


def test_the_standard_deviation_is_that_of_estimates_in_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 200.0, 0.02)
    steer = rng.standard_normal(len(t))
    errors, claimed = [], []
    for _ in range(60):
        found = iso._estimate_frequency_response(
            t, steer, 2.0 * steer + rng.standard_normal(len(t))
        )
        errors.append(found.H - 2.0)
        claimed.append(found.sd)
    each = np.sqrt(np.mean(np.real(errors) ** 2, axis=0) + np.mean(np.imag(errors) ** 2, axis=0))
    ratio = each / math.sqrt(2.0) / np.mean(claimed, axis=0)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


def test_a_drive_shorter_than_a_segment_is_refused() -> None:
    t = np.arange(0.0, 5.0, 0.01)
    with pytest.raises(ValueError, match=r"longer than the 5.0 s driven"):
        iso._estimate_frequency_response(t, np.sin(t), np.sin(t))


def test_the_linear_step_is_that_of_a_linear_drive() -> None:
    t = np.arange(0.0, 5.0, 0.001)
    driven = linear(PASSENGER_CAR, V, t, 0.01 * np.clip((t - 1.0) / 0.2, 0.0, 1.0))
    theory = iso._compute_linear_step(PASSENGER_CAR, V, driven)
    found = iso._compute_step_response(driven.t, driven.steer, driven.gamma)
    assert vars(theory["gamma"]) == pytest.approx(vars(found), rel=1e-9)
    model = make_bicycle_model(PASSENGER_CAR, V)
    steady = -np.linalg.solve(model.A, model.B)[1, 0]
    assert found.gain == pytest.approx(steady, rel=1e-3)
    a_y = iso._compute_step_response(driven.t, driven.steer, driven.a_y)
    assert theory["a_y"].gain == pytest.approx(a_y.gain, rel=1e-3)


def make_car(vehicle: Vehicle) -> TestCar:
    return TestCar(vehicle, 10.0, 16.0, 4.0, 0.8)


def steady(vehicle: Vehicle, steer: float, fastest: float) -> Series:
    """The linear car's steady states at rising speeds."""
    t = np.arange(0.0, 30.0, 0.01)
    zero, speed = np.zeros_like(t), np.linspace(2.0, fastest, len(t))
    models = [make_bicycle_model(vehicle, v) for v in speed]
    beta, gamma = steer * np.array([-np.linalg.solve(x.A, x.B)[:, 0] for x in models]).T
    return Series(t, zero + steer, speed, speed * beta, gamma, zero, zero, zero)


@CARS
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_steady_states_of_the_linear_car_have_its_gradient(vehicle: Vehicle, side: float) -> None:
    K, offset = iso._fit_understeer(steady(vehicle, 0.06 * side, 13.0), make_car(vehicle))
    assert pytest.approx(make_car(vehicle).understeer_gradient, rel=1e-6) == K
    assert abs(offset) < 1e-12


@CARS
def test_the_gradient_is_the_weights_over_the_stiffnesses(vehicle: Vehicle) -> None:
    """delta_f = l/R + (m/l) (l_r / 2 C_f - l_f / 2 C_r) a_y; the COMS oversteers."""
    front = vehicle.rear_arm / (2.0 * vehicle.front_stiffness)
    rear = vehicle.front_arm / (2.0 * vehicle.rear_stiffness)
    expected = vehicle.mass / vehicle.wheelbase * (front - rear)
    assert make_car(vehicle).understeer_gradient == pytest.approx(expected)
    assert (expected > 0.0) is (vehicle is PASSENGER_CAR)


def test_a_circle_without_lateral_acceleration_is_refused() -> None:
    with pytest.raises(ValueError, match=r"circle reached .* m/s2, not 2.45"):
        iso._fit_understeer(steady(PASSENGER_CAR, 0.001, 10.0), make_car(PASSENGER_CAR))
