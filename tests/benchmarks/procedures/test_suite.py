"""The suite of procedures: its cases, and its tables and figures of the uncontrolled cars."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("vehiclemodels")
from sideslip.benchmarks.procedures import fmvss126, outside, suite
from sideslip.benchmarks.procedures.drive import CARS, ENTRIES, ENV_ID, ProcedureCase
from sideslip.benchmarks.report.tables import format_columns
from sideslip.benchmarks.suites import SUITES, Request
from sideslip.envs.outside.plants import OUTSIDE_PLANTS


def test_every_contestant_drives_every_procedure_that_has_a_verdict() -> None:
    assert "procedures" in SUITES
    cases = suite._make_cases(quick=False)
    assert len(set(cases)) == len(cases)
    for procedure in ("fmvss-126", "iso-3888-1", "iso-3888-2"):
        mine = {(case.car, case.agent) for case in cases if case.procedure == procedure}
        assert mine == {(car, agent) for car in CARS for agent in ENTRIES}
    driven = {case.car: case.seeds for case in cases if case.procedure == "outside"}
    assert set(driven) == set(OUTSIDE_PLANTS)
    assert {len(seeds) for seeds in driven.values()} == {8}


@pytest.mark.parametrize("car", [*CARS, "drift"])
def test_each_contestant_has_what_it_reads(car: str) -> None:
    """Policies drive the car that they learned on, outside cars as the passenger car."""
    names = [each.get_configuration(car)[0] for each in ENTRIES.values()]
    assert names[-1] == f"distill-{'coms' if car == 'coms' else 'car'}-steering"
    for each in ENTRIES.values():
        each.make(car, ENV_ID, vehicle="coms" if car == "coms" else "passenger-car")


def test_a_car_that_passes_its_own_series_does_not_fail_beside_one_with_a_longer_one() -> None:
    """The smaller A, the more of it is in 270 degrees."""
    (case, *_) = suite._make_cases(quick=True)
    results = [
        fmvss126.SineDwellResult(
            1.0, tuple(fmvss126.SineDwellRun(k, 0.0, 0.0, 9.0) for k in multiples)
        )
        for multiples in ((1.5, 6.5), (1.5, 6.5, 8.5), (1.5, 7.5))
    ]
    (record,) = suite._make_sine_records({case: results})
    assert record["passed"] == (7.5, 7.5, 0) and record["text"] == "passes"


def test_the_interval_of_the_median_amplitude_holds_it() -> None:
    """A jackknife's has no width in half of such samples, and holds 66 % of them."""
    (case, *_), rng = suite._make_cases(quick=True), np.random.default_rng(0)
    held = []
    for _ in range(400):
        multiples = 0.5 * np.round(10.0 * rng.lognormal(0.0, 0.3, 16))
        runs = [(fmvss126.SineDwellRun(k, 0.0, 0.0, 9.0),) for k in multiples.tolist()]
        records = suite._make_sine_records({case: [fmvss126.SineDwellResult(1.0, x) for x in runs]})
        amplitude: Any = records[0]["amplitude"]
        held.append(amplitude.low <= 5.0 <= amplitude.high)
    assert np.mean(held) > 0.93
    few: Any = suite._make_sine_records({case: [fmvss126.SineDwellResult(1.0, runs[0])] * 2})
    assert np.isnan(few[0]["amplitude"].low)


def test_who_plans_is_left_out_of_a_quick_run() -> None:
    driven = {case.agent for case in suite._make_cases(quick=True)}
    assert "adaptive-nmpc" not in driven
    assert {"adaptive-lqr", "policy on joint"} <= driven


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
    known = [case for case in suite._make_cases(quick=True) if case.agent == "none"]
    cases = [case for case in known if case.car != "multi-body"]
    monkeypatch.setattr(suite, "_make_cases", lambda quick: cases)
    found = suite.STUDY.run(Request(quick=True, jobs=1))
    assert [table.title.split(",")[0] for table in found.tables[:2]] == ["FMVSS 126", "ISO 3888"]
    for table in found.tables:
        assert all(len(x.texts) == len(table.cells) for x in format_columns(table))
    metrics = {row.metric for row in found.rows}
    assert metrics >= {"amplitude", "speed", "understeer_gradient", "overshoot", "cost", "share"}
    assert [row.verdict for row in found.rows if row.verdict] == ["reproduced", "reproduced"]
    assert len(found.figures) == 4 * len(CARS)
    assert ProcedureCase("check", outside.MODEL) in cases
