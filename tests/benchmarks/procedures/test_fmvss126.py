"""FMVSS 126: the series of amplitudes, the criteria, and the check on the drift model."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sideslip.benchmarks.procedures import fmvss126
from sideslip.benchmarks.procedures.drive import Fields, Series, TestCar
from sideslip.envs import PASSENGER_CAR
from sideslip.envs.vehicle.parameters import GRAVITY

CAR = TestCar(PASSENGER_CAR, 80.0 / 3.6, 16.0, 4.2, 0.8)
A = math.radians(30.0)
Function = Callable[[float], float]
BEGIN, REVERSAL = fmvss126.ONSET, fmvss126.ONSET + 0.5 / 0.7
COMPLETION = fmvss126.ONSET + 1.0 / 0.7 + 0.5


def series(gamma: Function, Y: Function | None = None, until: float = COMPLETION + 2.0) -> Series:
    """A car that goes straight on along x but for what is given as functions of time."""
    t = np.arange(0.0, until, 0.001)
    zero = np.zeros_like(t)
    rate = np.vectorize(gamma)(t)
    place = zero if Y is None else np.vectorize(Y)(t)
    return Series(t, zero, zero + 20.0, zero, rate, zero, 20.0 * t, place)


def test_amplitudes_go_up_by_half_an_a_to_the_larger_of_6_5_a_and_270_degrees() -> None:
    found = np.degrees(fmvss126._list_amplitudes(math.radians(20.0)))
    assert found[:3].tolist() == pytest.approx([30.0, 40.0, 50.0])
    assert found[-2:].tolist() == pytest.approx([260.0, 270.0])
    assert np.degrees(fmvss126._list_amplitudes(math.radians(42.0)))[-1] == pytest.approx(273.0)
    exactly = np.degrees(fmvss126._list_amplitudes(math.radians(270.0 / 6.5)))
    assert exactly / (270.0 / 6.5) == pytest.approx(np.arange(1.5, 6.6, 0.5))


def test_no_amplitude_is_above_300_degrees() -> None:
    found = np.degrees(fmvss126._list_amplitudes(math.radians(50.0)))
    assert found[-2:].tolist() == pytest.approx([275.0, 300.0])
    assert (np.diff(found) > 0.0).all()


def test_a_is_where_the_line_through_the_accelerations_crosses_0_3_g() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    zero, steer = np.zeros_like(t), -0.01 * t
    a_y = -(steer / 0.05) * GRAVITY * np.where(np.abs(steer) > 0.08, 0.1, 1.0)  # 1 g at 0.05 rad
    driven = Series(t, steer, zero + 20.0, zero, a_y / 20.0, zero, 20.0 * t, zero)
    assert fmvss126._fit_reference_angle(driven, 16.0) == pytest.approx(16.0 * 0.3 * 0.05, rel=1e-6)


def test_a_car_that_does_not_get_there_has_no_a() -> None:
    with pytest.raises(ValueError, match=r"reached 0.00 m/s2, not 3.68"):
        fmvss126._fit_reference_angle(series(lambda t: 0.0), 16.0)


def test_ratios_are_those_to_the_peak_after_the_reversal() -> None:
    def gamma(t: float) -> float:
        if t < REVERSAL:
            return 9.0  # before the reversal nothing counts
        if t < COMPLETION:
            return -0.8
        return -0.8 * (0.3 if t < COMPLETION + 1.5 else 0.1)

    run = fmvss126._evaluate_run(series(gamma), 3.0 * A, A)
    assert (run.ratio_1, run.ratio_2) == pytest.approx((0.3, 0.1))
    assert run.stable
    assert run.passed
    mirrored = fmvss126._evaluate_run(series(lambda t: -gamma(t)), -3.0 * A, A)
    assert (mirrored.ratio_1, mirrored.ratio_2) == (run.ratio_1, run.ratio_2)


@pytest.mark.parametrize(("first", "second"), [(0.36, 0.1), (0.3, 0.21), (-0.36, 0.0)])
def test_too_much_yaw_rate_at_either_time_fails(first: float, second: float) -> None:
    def gamma(t: float) -> float:
        return -1.0 if t < COMPLETION else -(first if t < COMPLETION + 1.5 else second)

    assert not fmvss126._evaluate_run(series(gamma), 3.0 * A, A).stable


def test_a_spin_is_judged_by_the_peak_before_completion() -> None:
    run = fmvss126._evaluate_run(series(lambda t: -max(0.0, t - REVERSAL)), 3.0 * A, A)
    peak = COMPLETION - REVERSAL
    assert run.ratio_1 == pytest.approx((peak + 1.0) / peak, rel=1e-3)
    assert not run.stable


def test_an_end_before_the_time_is_a_failure() -> None:
    run = fmvss126._evaluate_run(series(lambda t: -1.0, until=COMPLETION + 0.5), 3.0 * A, A)
    assert math.isnan(run.ratio_1)
    assert not run.passed


@pytest.mark.parametrize(("way", "multiple", "passed"), [(1.84, 5.0, True), (1.82, 5.0, False)])
def test_the_displacement_is_asked_from_5_a_on(way: float, multiple: float, passed: bool) -> None:
    def Y(t: float) -> float:
        return 7.0 + way * (t - BEGIN) / 1.07

    still = series(lambda t: -1.0 if t < COMPLETION else 0.0, Y)
    run = fmvss126._evaluate_run(still, multiple * A, A)
    assert run.sideways == pytest.approx(way)
    assert run.stable
    assert run.passed is passed
    assert fmvss126._evaluate_run(still, 4.5 * A, A).passed


def test_the_highest_amplitude_is_below_the_first_failure_of_either_side() -> None:
    good = fmvss126.SineDwellRun(1.5, 0.0, 0.0, 9.0)
    runs = [
        good,
        fmvss126.SineDwellRun(2.0, 0.0, 0.0, 9.0),
        fmvss126.SineDwellRun(2.0, 0.9, 0.0, 9.0),
    ]
    result = fmvss126.SineDwellResult(A, tuple(runs))
    assert result.highest == 1.5
    assert not result.passed
    assert fmvss126.SineDwellResult(A, (good,)).passed


def test_both_sides_of_every_amplitude_are_driven_at_the_wheels() -> None:
    asked = []

    def drive(fields: Fields) -> Series:
        asked.append(fields)
        return series(lambda t: 0.0)

    fmvss126.run(drive, CAR, A, [2.0, 3.0])
    angles = [fields["amplitude"] * 16.0 / A for fields in asked]
    assert angles == pytest.approx([2.0, -2.0, 3.0, -3.0])
