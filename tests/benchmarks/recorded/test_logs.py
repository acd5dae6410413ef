"""Downloaded drives are scored with one setting, absent ones named; a found car is validated."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.recorded.identify import identify
from sideslip.benchmarks.recorded.replay import _make_validation_table, _split_blocks
from sideslip.benchmarks.report.study import Request
from sideslip.benchmarks.studies.logs import STUDY
from sideslip.envs.record import FAST
from sideslip.envs.vehicle.parameters import PASSENGER_CAR
from sideslip.estimators.wires import SignalCalibration, move_course

from .drawn_cars import drawn_car
from .simulated import as_table, drive


def test_without_data_there_are_instructions_and_no_numbers() -> None:
    suite = STUDY.run(Request())
    assert not suite.rows and not suite.tables and suite.verdict.startswith("No drive was read")
    assert any("250 LM" in line and "MIT" in line and "https" in line for line in suite.warnings)


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        STUDY.run(Request(data=tmp_path / "none"))


def test_each_drive_has_a_row_and_a_smoother_beside_it(tmp_path: Path) -> None:
    drawn = drawn_car(4, 20.0, 5.0)
    (tmp_path / "own").mkdir()
    table = as_table(drawn.log).assign(sideslip_rad=drawn.log.truth["beta"])
    table.to_csv(tmp_path / "own" / "a.csv", index=False)
    table.drop(columns="sideslip_rad").to_csv(tmp_path / "own" / "b.csv", index=False)
    (tmp_path / "own" / "c.csv").write_text("hello")
    suite = STUDY.run(Request(data=tmp_path))
    (result,) = suite.tables
    filtered, smoothed = result.cells
    assert (filtered["estimator"], smoothed["estimator"]) == ("joint", "its smoother, 1 s")
    assert 0.0 < filtered["median"] < filtered["p95"] < filtered["worst"] < np.radians(5.0)
    assert any("b is not scored: no true sideslip" in line for line in suite.warnings)
    assert any("c.csv: " in line for line in suite.warnings)


def test_a_found_car_stays_within_the_corridors_and_a_wrong_one_does_not() -> None:
    log = copy.deepcopy(drive(1, duration=100.0)[0])
    odd, even = _split_blocks([log])
    rows = sum(len(block.time) for block in (*odd, *even))
    assert rows == len(log.time) and odd[0].time[-1] < even[0].time[0]
    found = _make_validation_table([log], PASSENGER_CAR, None, None)
    assert "assumptions" in found.note and len(found.cells) == 2
    assert [cell[-1] for cell in found.cells] == ["yes", "yes"]
    for block in even:  # another car drives them: it turns 1.3 times as much
        start = block.record.first - log.record.first
        part = slice(start, start + len(block.time))
        log.record.fast[part, [FAST.gyro, FAST.accel_y]] *= 1.3
    other = _make_validation_table([log], PASSENGER_CAR, None, None)
    assert [cell[-1] for cell in other.cells] == ["no", "no"]


def test_an_antenna_ahead_is_moved_before_the_car_is_sought() -> None:
    """The same drive with the antenna 1.5 m ahead and said gives the same car."""
    log, _ = drive(1, duration=100.0)
    at = {"gps": (1.5, 0.0, 0.0)}
    record = dataclasses.replace(log.record, packets=log.record.packets.copy())
    ahead = dataclasses.replace(log, record=record)
    move_course(record.fast, record.packets, record.first, {"gps": (-1.5, 0.0, 0.0)})
    plain, moved = (
        identify([x], PASSENGER_CAR, SignalCalibration(at=places), "linear").car
        for x, places in ((log, {}), (ahead, at))
    )
    assert moved.front_stiffness == pytest.approx(plain.front_stiffness, rel=1e-3)
    assert moved.rear_stiffness == pytest.approx(plain.rear_stiffness, rel=1e-3)


def test_a_log_without_excitation_is_not_validated() -> None:
    log, _ = drive(1)
    table = _make_validation_table([_split_blocks([log])[0][0]], PASSENGER_CAR, None, None)
    assert not table.cells and table.note.startswith("Not validated")
