"""The suite of procedures: its cases, and its tables and figures of the uncontrolled cars."""

import math

import numpy as np
import pytest

pytest.importorskip("vehiclemodels")
from sideslip.benchmarks.harness.drives import make_env
from sideslip.benchmarks.procedures import fmvss126, outside, suite
from sideslip.benchmarks.procedures.drive import (
    CARS,
    ENTRIES,
    ENV_ID,
    DriveFunction,
    Fields,
    ProcedureCase,
    Series,
    TestCar,
)
from sideslip.benchmarks.procedures.outside import Law, _simulate_plant
from sideslip.benchmarks.suites import SUITES, Request
from sideslip.envs.outside.plants import OUTSIDE_PLANTS, Drift, make_outside_vehicle
from sideslip.envs.vehicle.dynamics import Motion
from sideslip.envs.vehicle.parameters import GRAVITY


def test_every_contestant_drives_every_procedure_that_has_a_verdict() -> None:
    assert "procedures" in SUITES
    cases = suite._make_cases(quick=False)
    assert len(set(cases)) == len(cases)
    for procedure in ("fmvss-126", "iso-3888-1", "iso-3888-2"):
        mine = {(case.car, case.entry_index) for case in cases if case.procedure == procedure}
        assert mine == {(car, k) for car in CARS for k in range(len(ENTRIES))}
    driven = {case.car: case.seeds for case in cases if case.procedure == "outside"}
    assert set(driven) == set(OUTSIDE_PLANTS)
    assert {len(seeds) for seeds in driven.values()} == {8}


@pytest.mark.parametrize("car", [*CARS, "drift"])
def test_each_contestant_has_what_it_reads(car: str) -> None:
    """Policies drive the car that they learned on, outside cars as the passenger car."""
    names = [each.get_configuration(car)[0] for each in ENTRIES]
    assert names[-1] == f"distill-{'coms' if car == 'coms' else 'car'}-steering"
    for each in ENTRIES:
        _, estimator, estimate = each.get_configuration(car)
        options = {"vehicle": "coms"} if car == "coms" else {"vehicle": "passenger-car"}
        env = make_env(ENV_ID, estimator, estimate, **options)
        each.make_agent(car, env)


def test_a_car_that_passes_its_own_series_does_not_fail_beside_one_with_a_longer_one() -> None:
    """The smaller A, the more of it is in 270 degrees."""
    (case, *_) = suite._make_cases(quick=True)
    results = [
        fmvss126.SineDwellResult(
            1.0, tuple(fmvss126.SineDwellRun(k, k, 0.0, 0.0, 9.0) for k in multiples)
        )
        for multiples in ((1.5, 6.5), (1.5, 6.5, 8.5), (1.5, 7.5))
    ]
    (record,) = suite._make_sine_records({case: results})
    assert record["passed"] == (7.5, 7.5, 0) and record["text"] == "passes"


def test_without_the_extra_outside_plants_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "_HAS_OUTSIDE", False)
    kinds = {case.procedure for case in suite._make_cases(quick=True)}
    assert kinds == {"fmvss-126", "iso-3888-1", "iso-3888-2", "iso-4138", "iso-7401"}


@pytest.mark.long
def test_the_check_on_the_drift_model_is_reproduced() -> None:
    """FMVSS 126 at 80 km/h: no control fails at 5 A, 500 N m pass at 6.5 A, on both sides."""
    none, law = outside.run_check()
    assert law.passed
    assert not any(run.stable for run in none.runs)
    assert len(law.runs) == 2


@pytest.mark.long
def test_tables_rows_and_figures_of_the_uncontrolled_cars(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("plotly")
    known = [case for case in suite._make_cases(quick=True) if case.entry_index == 0]
    cases = [case for case in known if case.car != "multi-body"]
    monkeypatch.setattr(suite, "_make_cases", lambda quick: cases)
    found = suite.STUDY.run(Request(quick=True, jobs=1))
    assert [table.title.split(",")[0] for table in found.tables[:2]] == ["FMVSS 126", "ISO 3888"]
    for table in found.tables:
        assert all(len(cells) == len(table.cells) for _, cells in table.split())
    metrics = {row.metric for row in found.rows}
    assert metrics >= {"amplitude", "speed", "understeer_gradient", "overshoot", "cost", "share"}
    assert [row.verdict for row in found.rows if row.verdict] == ["reproduced", "reproduced"]
    assert len(found.figures) == 4 * len(CARS)
    assert ProcedureCase("check", outside.MODEL) in cases


V = 80.0 / 3.6
BMW = TestCar(make_outside_vehicle(), V, 16.0, 4.508, 0.8)
MOST = 500.0  # N m


def steering(fields: Fields, t: float) -> float:
    """Slowly increasing steer and sine with dwell, written out once more."""
    since, amplitude = t - fields["onset"], fields["amplitude"]
    if since < 0.0:
        return 0.0
    if fields["steering"] == "ramp":
        return float(amplitude * min(1.0, since / fields["hold"]))
    phase, dwell = 0.7 * since, 0.7 * 0.5
    if phase > 0.75:
        phase = max(0.75, phase - dwell)
    return float(amplitude * math.sin(math.tau * phase)) if phase < 1.0 else 0.0


def drive_with(law: Law | None) -> DriveFunction:
    def drive(fields: Fields) -> Series:
        hold = fields["steering"] == "ramp"
        seconds = 3.0 if hold else fields["duration"]  # enough to pass 0.375 g
        return _simulate_plant(Drift(), lambda t: steering(fields, t), V, seconds, hold, law)

    return drive


def within_500(motion: Motion, steer: float) -> float:
    """Yaw rate error against what neutral steering and friction allow, saturated."""
    most = 0.85 * GRAVITY / motion.v_x
    wanted = np.clip(motion.v_x * steer / make_outside_vehicle().wheelbase, -most, most)
    return float(np.clip(2e4 * (wanted - motion.gamma), -MOST, MOST))


@pytest.fixture(scope="module")
def A() -> float:
    return fmvss126.measure_reference_angle(drive_with(None), BMW)


@pytest.mark.long
def test_without_control_the_car_fails_at_5_a(A: float) -> None:
    result = fmvss126.run(drive_with(None), BMW, A, [3.0, 5.0])
    assert result.highest == pytest.approx(3.0)
    assert not any(run.stable for run in result.runs if run.multiple > 4.9)


@pytest.mark.long
def test_a_yaw_moment_of_500_n_m_passes_at_6_5_a(A: float) -> None:
    result = fmvss126.run(drive_with(within_500), BMW, A, [6.5])
    assert result.passed
    assert min(run.sideways for run in result.runs) >= 1.83


def test_a_belongs_to_0_3_g_of_the_steady_car(A: float) -> None:
    """Within the lag of a slow ramp and what the Magic Formula loses by 0.3 g."""
    car = make_outside_vehicle()
    steady = 0.3 * GRAVITY * car.wheelbase / V**2  # of a neutral car
    assert A / BMW.ratio == pytest.approx(steady, rel=0.2)
