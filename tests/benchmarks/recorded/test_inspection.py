"""Every planted fault of a log is named, none of a clean drive, and the page fits a screen."""

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

import sideslip
from sideslip.benchmarks.harness.drives import record_drive
from sideslip.benchmarks.recorded.checks import CHECKS, InspectedDrive
from sideslip.benchmarks.recorded.inspection import _predict, _read_drive, inspect_file
from sideslip.benchmarks.recorded.quality import BLOCKER, OK, WARNING, LogFinding
from sideslip.envs.record import PACKET
from sideslip.envs.sensors.slow import CAMERA
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, make_vehicle
from sideslip.estimators.make import make_estimator
from sideslip.estimators.wires import AS_LOGGED
from tests.benchmarks.conftest import Run

from .faulty_logs import FAULTS, drive, shift_fixes, spoil

assert sideslip.__version__
FAULTY, CLEAN = 7000, 8000  # first seeds; limits were set on others
COUNT, FIRST = 100, len(FAULTS)
_ROOT = Path(__file__).parents[3]
SHARED = next((p for p in (_ROOT / "shared", _ROOT.parent / "shared") if p.is_dir()), _ROOT)
STANFORD = SHARED / "data" / "stanford_250lm" / "log.csv"
CASES = SHARED / "cases"


def look(table: pd.DataFrame | Path, car: str | Path = "passenger-car") -> list[LogFinding]:
    """The findings on a table that are not OK."""
    _, findings, _ = _read_drive(table, {}, make_vehicle(car), AS_LOGGED)
    return [finding for finding in findings if finding.level != OK]


@pytest.mark.parametrize(
    "number",
    [*range(FIRST), *(pytest.param(i, marks=pytest.mark.long) for i in range(FIRST, COUNT))],
)
def test_a_planted_fault_is_named(number: int) -> None:
    """By the right check, on the right channel, with what mends it."""
    name, table = spoil(number, FAULTY)
    _, checks, channel = FAULTS[name]
    findings = look(table)
    right = [x for x in findings if x.check in checks.split() and x.channel == channel]
    assert right, (name, findings)
    assert all(finding.cure and finding.level in (BLOCKER, WARNING) for finding in right)


@pytest.mark.parametrize(
    "seed", [*range(10), *(pytest.param(i, marks=pytest.mark.long) for i in range(10, 50))]
)
def test_a_clean_drive_has_no_finding(seed: int) -> None:
    assert look(drive(CLEAN + seed)[0]) == []


def test_a_check_that_finds_nothing_is_counted() -> None:
    """Each check judges something of a clean drive but for contradictions, which are faults."""
    values, kinds, logs = (vars(_read_clean())[name] for name in ("values", "kinds", "logs"))
    checked = InspectedDrive(values, kinds, logs, PASSENGER_CAR)
    silent = [check for check in CHECKS if not list(check(checked))]
    assert [str(check) for check in silent] == ["operator.attrgetter('contradictions')"]


def _read_clean() -> InspectedDrive:
    return _read_drive(drive(CLEAN + 1)[0], {}, PASSENGER_CAR, AS_LOGGED)[0]


def test_innovations_of_two_sensors_count_by_what_each_packet_measures() -> None:
    """A camera gives two values 30 times a second, a GPS one 5 times."""
    options: dict[str, Any] = {"vehicle": "passenger-car", "scenario": "random-steering"}
    log = record_drive(gym.make("sideslip/YawFusion-v1", **options), 1)
    nis = make_estimator("joint", vehicle=PASSENGER_CAR, sensors=log.slow).run(log).nis
    used = np.isfinite(nis)
    values = np.where(log.record.packets[used, PACKET.sensor] == CAMERA, 2.0, 1.0)
    predicted = _predict(log, PASSENGER_CAR)
    assert predicted.nis == pytest.approx(nis[used].sum() / values.sum(), rel=1e-6)


def test_two_faults_are_both_named() -> None:
    """A speed in km/h hides no steering that is turned, nor a late course."""
    table = drive(CLEAN + 3)[0].assign(steer_rad=lambda x: -x["steer_rad"])
    table["speed_x_mps"] *= 3.6
    named = {(finding.check, finding.channel) for finding in look(table)}
    assert {("unit", "speed_x"), ("sign", "steer")} <= named


def test_a_number_is_measured_and_its_cure_mends_it(tmp_path: Path, run: Run) -> None:
    """What a finding says of a fault's size is the fault's size, and its option takes it away."""
    table, log = drive(CLEAN)[0], tmp_path / "late.csv"
    shifted = shift_fixes(table, np.full(len(table), 0.4))
    (late,) = look(shifted)
    option, value = late.cure.split()
    assert abs(float(value.removeprefix("gps=")) - 0.4) < 0.1
    shifted.to_csv(log, index=False)
    status, out, _ = run("inspect", log, option, value)
    assert status == 0 and "0 BLOCKER, 0 WARNING" in out
    (ratio,) = look(table.assign(steer_rad=15.0 * table["steer_rad"]))
    value = ratio.cure.removeprefix("--steering-ratio ")
    assert ratio.level == BLOCKER and 10.0 < float(value) < 22.0
    bias = look(table.assign(yaw_rate_radps=table["yaw_rate_radps"] + 0.03))
    assert any(x.check == "bias" and 1.2 < float(x.text.split()[1]) < 2.2 for x in bias)


def test_the_page_fits_a_screen(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)  # a long folder stands in a line of its own
    log, page = Path("drive.csv"), Path("page.html")
    drive(CLEAN)[0].to_csv(log, index=False)
    status, out, _ = run("inspect", log, "--html", page)
    lines = out.splitlines()
    assert status == 0 and len(lines) <= 60 and max(map(len, lines)) <= 80
    verdict = next(i for i, line in enumerate(lines) if line.startswith("This log is worth it"))
    assert verdict < next(i for i, line in enumerate(lines) if line.strip() == "Channels")
    assert "0 BLOCKER, 0 WARNING" in out
    text = page.read_text()
    assert "<details open><summary>Channels" in text and text.count("<figure") >= 5
    assert 'src="http' not in text


def test_a_cure_contains_what_is_stated(tmp_path: Path, run: Run) -> None:
    """An option replaces what was stated before: taken as it is said, it mends the log."""
    log = tmp_path / "drive.csv"
    table = drive(CLEAN)[0]
    table.assign(steer_rad=table["steer_rad"] - np.radians(2.0)).to_csv(log, index=False)
    _, out, _ = run("inspect", log, "--steering-offset", -1)
    offset = float(re.search(r"--steering-offset\s+(-?[\d.]+)", out)[1])  # type: ignore[index]
    assert offset == pytest.approx(2.0, abs=0.5)
    assert "--steering-offset" not in run("inspect", log, "--steering-offset", offset)[1]


def test_a_car_that_hardly_moves_is_no_drive(tmp_path: Path, run: Run) -> None:
    log, table = tmp_path / "drive.csv", drive(CLEAN)[0]
    speeds = {str(x): 0.0 * table[x] + 1.0 for x in table if "speed" in str(x)}
    table.assign(**speeds).to_csv(log, index=False)
    _, out, _ = run("inspect", log)
    assert "nan" not in out and "worth it:" not in out


def test_a_blocker_ends_with_status_1(tmp_path: Path, run: Run) -> None:
    log = tmp_path / "drive.csv"
    spoilt = drive(CLEAN)[0]
    spoilt.assign(steer_rad=-spoilt["steer_rad"]).to_csv(log, index=False)
    status, out, _ = run("inspect", log)
    assert status == 1 and "Do not estimate" in out and "--steering-sign -1" in out
    assert run("inspect", log, "--steering-sign", -1)[0] == 0
    spoilt.drop(columns="steer_rad").to_csv(log, index=False)
    status, out, _ = run("inspect", log)
    assert status == 1 and "--map steer_UNIT=COLUMN" in out
    renamed = spoilt.rename(columns={"steer_rad": "delta"})
    renamed.to_csv(log, index=False)
    assert run("inspect", log, "--map", "steer_rad=delta")[0] == 0


def test_what_is_no_drive_is_refused(tmp_path: Path, run: Run) -> None:
    nmea = tmp_path / "log.nmea"
    nmea.write_text("$GPRMC,\n")
    status, _, err = run("inspect", nmea)
    assert status == 2 and "has no gyro and no steering" in err
    assert run("inspect", tmp_path / "nowhere.csv")[0] == 2
    text = tmp_path / "text.csv"
    text.write_text("time_s,yaw_rate_radps\n0.0,hello\n0.1,0.2\n")
    status, out, _ = run("inspect", text)
    assert status == 1 and "hello" in " ".join(out.split())


def test_it_says_how_well() -> None:
    """The deviation that it expects is the filter's, and no smaller without a course."""
    table = drive(CLEAN + 2)[0]
    verdicts = [
        inspect_file(x, "passenger-car", figures=False).verdict
        for x in (table, table.drop(columns=["course_rad", "gps_speed_mps", "accel_y_mps2"]))
    ]
    with_all, with_gyro = (float(v.split("within ")[1].split()[0]) for v in verdicts)
    assert 0.02 < with_all <= with_gyro < 2.0


@pytest.mark.skipif(not STANFORD.exists(), reason="the shared recordings are not here")
def test_a_recording_has_only_what_it_lacks() -> None:
    """The Ferrari's log has no course."""
    (finding,) = look(STANFORD, "ferrari-250lm-nominal")
    assert (finding.level, finding.check, finding.channel) == (WARNING, "missing", "course")


@pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not here")
@pytest.mark.parametrize(
    ("file", "named"),
    [
        ("A00_right.csv", []),
        ("A01_part_without_gps.csv", [("gaps", "time")]),
        ("A02_gps_locks_late.mf4", []),
        ("A03_course_held.csv", [("held", "course")]),
        ("A04_course_compass.csv", [("sign", "course")]),
        ("A05_truth_in_degrees.csv", [("unit", "sideslip")]),
        ("A06_speed_at_10_hz.csv", []),
        ("A07_comma_decimals.csv", []),
        ("A11_gyro_in_steps_of_1.28_degps.csv", [("resolution", "yaw_rate")]),
    ],
)
def test_cases_with_their_right_answers(file: str, named: list[tuple[str, str]]) -> None:
    findings = look(CASES / file, CASES / "car.toml")
    assert [(finding.check, finding.channel) for finding in findings] == named
