"""Procedures over our own environment: the kernel's steering, and theorems on the linear plant."""

import math

import numpy as np
import pytest

from sideslip.benchmarks.procedures import fmvss126, iso
from sideslip.benchmarks.procedures.drive import CALM, CARS, ENTRIES, DriveFunction
from sideslip.benchmarks.procedures.outside import _make_steering_profile
from sideslip.envs import Scenario
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.scenarios.driver import compute_steering
from sideslip.envs.vehicle.parameters import GRAVITY

EACH = pytest.mark.parametrize("name", CARS)
LINEAR = {"small_angle": True, "tyres": "linear", "lags": False, "roll": False}


def linear(name: str) -> DriveFunction:
    """Drives of the small-angle car with linear tyres and no lag."""
    drive = ENTRIES["none"].drive(name)
    return lambda fields: drive({**fields, **LINEAR})


def slow(name: str) -> float:
    """The steering angle in rad of 0.1 g, slowly."""
    car = CARS[name]
    per = car.vehicle.wheelbase / car.speed**2 + car.understeer_gradient
    return 0.1 * GRAVITY * per


@EACH
@pytest.mark.parametrize("output", iso.OUTPUTS)
def test_the_measured_frequency_response_is_that_of_the_matrices(name: str, output: str) -> None:
    """C (j w I - A)^-1 B, within the estimate's error."""
    car = CARS[name]
    driven = linear(name)(iso._make_sweep(car, slow(name)))
    found = iso._estimate_frequency_response(driven.t, driven.steer, getattr(driven, output))
    theory = iso._compute_linear_response(car.vehicle, car.speed, found.frequency)[output]
    assert (np.abs(found.H - theory) < 3.0 * found.sd).all()
    np.testing.assert_allclose(found.H, theory, rtol=0.03)


@EACH
def test_the_linear_plant_steps_as_the_linear_model_does(name: str) -> None:
    car = CARS[name]
    driven = linear(name)(iso._make_step(car, slow(name)))
    theory = iso._compute_linear_step(car.vehicle, car.speed, driven)["gamma"]
    found = iso._compute_step_response(driven.t, driven.steer, driven.gamma)
    assert vars(found) == pytest.approx(vars(theory), rel=0.02, abs=1e-3)


@EACH
def test_a_slow_circle_of_the_linear_plant_has_its_gradient(name: str) -> None:
    K = iso.run_circle(linear(name), CARS[name], seconds=120.0)
    np.testing.assert_allclose(K, CARS[name].understeer_gradient, rtol=0.02)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_kernels_sine_with_dwell_is_the_standards(side: float) -> None:
    """One period of 0.7 Hz that waits for 0.5 s at the second peak."""
    car = CARS["passenger-car"]
    fields = fmvss126._make_sine_with_dwell(car, side * 2.0)
    programme = _make_steering_profile(Scenario(**(CALM | dict(fields))))

    def angle(t: float) -> float:
        phase = 0.7 * (t - fmvss126.ONSET)
        phase = max(min(phase, 0.75), phase - 0.7 * 0.5)
        return side * 2.0 / car.ratio * math.sin(math.tau * phase) if 0.0 < phase < 1.0 else 0.0

    ticks = np.arange(round(fields["duration"] / TICK))
    expected = [angle(tick * TICK) for tick in ticks]
    found = [compute_steering(float(tick), programme) for tick in ticks]
    np.testing.assert_allclose(found, expected, atol=1e-3 * 2.0 / car.ratio)


@pytest.mark.parametrize(("name", "large"), [("coms", 3.5), ("passenger-car", 6.5)])
def test_uncontrolled_cars_pass_small_amplitudes_alone(name: str, large: float) -> None:
    car, drive = CARS[name], ENTRIES["none"].drive(name)
    A = fmvss126.measure_reference_angle(drive, car)
    result = fmvss126.run(drive, car, A, [1.5, large])
    assert [run.passed for run in result.runs] == [True, True, False, False]
    one, other = result.runs[:2]
    assert one.sideways == pytest.approx(other.sideways, rel=1e-2)


@EACH
@pytest.mark.parametrize("track", iso.TRACKS)
def test_a_slow_driver_touches_no_cone(name: str, track: str) -> None:
    car = CARS[name]
    drive = ENTRIES["none"].drive(name)
    runs = [iso.run_track(drive, car, track, share * car.speed) for share in (0.45, 1.1)]
    assert [run.passed for run in runs] == [True, False]


def test_a_failed_episode_is_told_and_ends_early() -> None:
    spun = ENTRIES["none"].drive("passenger-car")(
        {"steering": "held-step", "amplitude": 0.5, "speed": 30.0, "duration": 5.0}
    )
    assert spun.failed
    assert spun.t[-1] < 5.0
