"""Stiffnesses and yaw inertia scaled together leave the yaw rate as it is; identification does not
slide down that valley, its intervals know it, and no estimator gets worse by the found car."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t as student
from typer.testing import CliRunner

from sideslip.benchmarks.cli.main import app
from sideslip.benchmarks.harness.drives import draw_steering
from sideslip.benchmarks.recorded import identify as identification
from sideslip.benchmarks.recorded.bicycle_fit import (
    BicycleFit,
    Theta,
    Windows,
    _estimate_noise_levels,
    fit,
)
from sideslip.benchmarks.recorded.identify import POSSIBLE, TYRES, IdentificationResult, identify
from sideslip.benchmarks.recorded.replay import Settings, _run_estimators
from sideslip.envs.record import FAST, Array, Log
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, Vehicle
from sideslip.estimators.wires import SignalCalibration, apply_wires

from .drawn_cars import NOISE, drawn_car, scenario_of, simulate, without
from .simulated import as_table
from .slalom import columns, saved

ESTIMATORS = ("bicycle-kf", "multirate-kf", "exact-kf")
NEUTRAL = PASSENGER_CAR.replace(  # steers nearly neutrally: the valley is exact
    mass=1776.0, sprung_mass=1500.0, front_arm=1.3, rear_arm=1.45, front_stiffness=72500.0,
    rear_stiffness=65000.0, yaw_inertia=3180.0,
)  # fmt: skip


def share(car: Vehicle) -> float:
    return car.yaw_inertia / (car.mass * car.front_arm * car.rear_arm)


def driven(car: Vehicle, quieter: float = 0.2) -> Log:
    """Mild random steering with sensors and disturbances that are quieter than usual."""
    trace = draw_steering(np.random.default_rng(3), 0.02, 60.0)
    changes = {
        "speed": 20.0, "surge": 0.7, "duration": 60.0, "trace": tuple(trace), "gps_latency": 0.2,
        "noise": {name: quieter * sd for name, sd in NOISE.items()},
        "disturbance_force": 150.0 * quieter, "disturbance_moment": 150.0 * quieter,
    }  # fmt: skip
    return simulate(scenario_of(car) | changes, 5)


def with_lagging_gyro(log: Log, lag: float) -> Log:
    fast, keeps = log.record.fast.copy(), math.exp(-log.record.dt / lag)
    fast[:, FAST.gyro] = lfilter([1.0 - keeps], [1.0, -keeps], fast[:, FAST.gyro])
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


def test_a_yaw_rate_alone_does_not_lead_down_the_valley() -> None:
    """A lagging gyro; the stated tyres are 1.3 times too stiff. Priors bound what is left open."""
    log = with_lagging_gyro(without(driven(NEUTRAL), accel=True, course=True), 0.08)
    found = identify([log], NEUTRAL.scale_stiffness(1.3))
    true = (2.0 * NEUTRAL.front_stiffness, 2.0 * NEUTRAL.rear_stiffness, NEUTRAL.yaw_inertia)
    for row, value in zip(found.findings[:3], true, strict=True):
        assert abs(row.value - value) < row.half, row
    assert POSSIBLE[0] < share(found.car) < POSSIBLE[1] and found.reason == ""


def test_the_priors_bound_what_a_disturbed_yaw_rate_leaves_open() -> None:
    log = with_lagging_gyro(without(driven(NEUTRAL, 1.0), accel=True, course=True), 0.08)
    w = dataclasses.replace(Windows.from_logs([log], NEUTRAL), tyres="fiala")
    found = fit(w, Theta(), ("front", "rear", "inertia", "gyro_bias"))
    for name, sd in (("front", 0.4), ("rear", 0.4), ("inertia", 0.2)):
        assert abs(getattr(found.theta, name)) < sd and found.halves[name] < 2.3 * sd, name


def test_the_course_tells_what_the_yaw_rate_leaves_open() -> None:
    log = driven(NEUTRAL)
    stated = NEUTRAL.scale_stiffness(1.3)
    alone, course = (
        identify([without(log, accel=True, course=not kept)], stated) for kept in (False, True)
    )
    for row, row_alone in zip(course.findings[:2], alone.findings[:2], strict=True):
        assert row.is_determined and row.half < 0.7 * row_alone.half
    assert course.wires.latency["gps"] == pytest.approx(0.2, abs=0.03)
    assert course.car.rear_stiffness == pytest.approx(NEUTRAL.rear_stiffness, rel=0.15)


def test_an_interval_without_data_is_that_of_the_prior() -> None:
    """And a prior belongs to no stretch: it stays when one is left out."""
    arrays = np.ones(1), np.zeros((20, 1, 1)), np.zeros((20, 1)), np.array([0.4**-2]), np.zeros(1)
    nothing = BicycleFit(Theta(front=0.1), ("front",), *arrays)
    assert nothing.halves["front"] == pytest.approx(student.ppf(0.975, 19) * 0.4)
    pulled = dataclasses.replace(nothing, H=nothing.H + 1.0, pull=np.array([0.3 * 0.4**-2]))
    gone = np.arange(20) < 15
    assert pulled.estimate_shift(gone)[0] == pytest.approx(-0.3 * 0.4**-2 / (5.0 + 0.4**-2))


def test_rows_that_are_alike_count_once() -> None:
    white = np.random.default_rng(0).normal(0.0, 0.2, (60, 1, 400))
    held = np.repeat(white[:, :, ::25], 25, axis=2)
    seldom = np.where(np.arange(400) % 10 == 0, white, 0.0)
    for rows, level in ((white, 0.2), (held, 0.2 * 5.0), (seldom, 0.2)):
        assert _estimate_noise_levels(rows, 0.01)[0] == pytest.approx(level, rel=0.15)


def test_a_car_that_cannot_be_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is written, the exit status is 1, and a replay keeps the stated car."""
    results: list[IdentificationResult] = []

    def identify_once(*arguments: Any) -> IdentificationResult:
        results.extend([] if results else [identify(*arguments)])
        return results[0]

    monkeypatch.setattr(identification, "identify", identify_once)
    log = driven(PASSENGER_CAR.replace(yaw_inertia=0.35 * 2700.0))
    path, out = tmp_path / "drive.csv", tmp_path / "car.toml"
    as_table(log).to_csv(path, index=False)
    run = CliRunner().invoke(app, ["identify", str(path), "--out", str(out)])
    assert run.exit_code == 1 and not out.exists()
    assert any(line.startswith("Not identified.") for line in run.output.splitlines())
    (found,) = results
    assert "I/(m l_f l_r) = 0." in found.reason
    assert found.car == PASSENGER_CAR and found.wires.gain == 1.0
    assert not any(row.is_determined for row in found.findings[:8])
    again = ["replay", str(path), "--vehicle", "identify", "--estimator", "exact-kf"]
    run = CliRunner().invoke(app, again)
    assert run.exit_code == 0, run.output
    text = " ".join(run.output.split())
    assert "the car is not identified" in text and "passenger-car-identified" not in text


def test_five_rows_identify_nothing(tmp_path: Path) -> None:
    path = saved(tmp_path, **{name: values[:5] for name, values in columns().items()})
    out = tmp_path / "car.toml"
    run = CliRunner().invoke(app, ["identify", str(path), "--out", str(out)])
    assert run.exit_code == 1 and not out.exists()
    assert "Not identified." in run.output


def slip_errors(log: Log, car: Vehicle, wires: SignalCalibration) -> Array:
    how = Settings(estimators=ESTIMATORS, seeds=1, noise=wires.noise)
    scores = _run_estimators([apply_wires(log, wires)], car, how).scores
    return np.array([scores[name][0, 0] for name in ESTIMATORS])


@pytest.mark.parametrize(
    ("seeds", "laws"),
    [
        (range(3), TYRES[:1]),
        pytest.param(range(100, 130), (None, TYRES[0]), marks=pytest.mark.long),
    ],
)
def test_estimators_get_no_worse_elsewhere(seeds: range, laws: tuple[str | None, ...]) -> None:
    """By all drawn cars together, and the chosen law's intervals hold stiffness and inertia."""
    errors: list[tuple[str | None, Array, Array]] = []
    outside = []
    for seed in seeds:
        drawn = drawn_car(seed)
        own = SignalCalibration(latency={"gps": drawn.late})
        both = SignalCalibration(), own
        stated = [slip_errors(drawn.held_out, PASSENGER_CAR, each) for each in both]
        for tyres in laws:
            found = identify([drawn.log], PASSENGER_CAR, tyres=tyres)
            now = [slip_errors(drawn.held_out, found.car, each) for each in (found.wires, own)]
            errors.append((tyres, np.array(stated), np.array(now)))
            if found.wires.latency.get("gps"):
                assert found.wires.latency["gps"] == pytest.approx(drawn.late, abs=0.06)
            if tyres is None:
                load = drawn.car.mass / PASSENGER_CAR.mass
                true = (2.0 * drawn.car.front_stiffness, 2.0 * drawn.car.rear_stiffness)
                pairs = zip(found.findings[:3], (*true, drawn.car.yaw_inertia), strict=True)
                outside += [abs(row.value - value / load) > row.half for row, value in pairs]
    for law in laws:
        before = np.sum([stated for tyres, stated, _ in errors if tyres == law], axis=0)
        after = np.sum([now for tyres, _, now in errors if tyres == law], axis=0)
        assert np.all(np.sqrt(after / before) < 1.05), np.sqrt(after / before)
    # 95 % intervals, and friction is not the stated one
    assert not outside or np.mean(outside) < 0.15
