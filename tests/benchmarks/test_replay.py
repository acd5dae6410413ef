"""A recorded drive is replayed with honest emulated sensors, scored, and drawn."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from sideslip.benchmarks.emulate import Emulation, heading, path
from sideslip.benchmarks.recorded import ESTIMATORS, GYRO_ONLY
from sideslip.benchmarks.replay import corners, read_vehicle, replay, replay_file
from sideslip.benchmarks.rows import Suite, read_json, write_json
from sideslip.envs.linear import bicycle
from sideslip.envs.logs import read_log
from sideslip.envs.record import FAST, PACKET, PACKET_WIDTH, Log, Record
from sideslip.envs.vehicle import PASSENGER_CAR
from sideslip.estimators import make_estimator

Array = npt.NDArray[np.float64]

STANFORD = Path(__file__).parents[3] / "shared" / "data" / "stanford_250lm" / "log.csv"
DEG = math.pi / 180.0
SPEED, DT, ROWS = 20.0, 0.01, 1001
SLALOM = 0.02 * np.sin(2.0 * np.pi * 0.4 * DT * np.arange(ROWS))


def columns() -> dict[str, Array]:
    """A slalom of the linear passenger car: row k's steering acts from k to k+1."""
    G, H = bicycle(PASSENGER_CAR, SPEED).discrete(DT)
    x = np.zeros((ROWS, 2))
    for k in range(ROWS - 1):
        x[k + 1] = G @ x[k] + H[:, 0] * SLALOM[k]
    return {
        "time_s": 100.0 + DT * np.arange(ROWS),
        "speed_x_mps": np.full(ROWS, SPEED),
        "yaw_rate_radps": x[:, 1],
        "steer_rad": SLALOM,
        "sideslip_rad": x[:, 0],
    }


def saved(folder: Path, **changes: Array | None) -> Path:
    """The slalom as a CSV, with columns replaced, added, or (None) left out."""
    table = {name: c for name, c in (columns() | changes).items() if c is not None}
    file = folder / "slalom.csv"
    lines = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in _rows(table)]
    file.write_text("\n".join([",".join(table), *lines]) + "\n")
    return file


def _rows(table: dict[str, Array]) -> Any:
    return zip(*table.values(), strict=True)


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return read_log(saved(tmp_path))


def values(suite: Suite, metric: str) -> dict[str, float]:
    return {row.estimator: row.value for row in suite.rows if row.metric == metric}


# the emulated course


def test_a_noiseless_course_is_truth_plus_the_integral_of_the_yaw_rate(log: Log) -> None:
    seen = Emulation(course_noise_deg=0.0, bias_deg=1.0).with_course(log, 0)
    packets = seen.record.packets_of("gps")
    captured = packets[:, PACKET.captured].astype(int)
    np.testing.assert_array_equal(captured, np.arange(10_000, 11_001, 10))
    gamma, beta = log.record.fast[:, FAST.gyro], log.truth["beta"]
    for packet, row in zip(packets, captured - 10_000, strict=True):
        psi = sum(0.5 * (gamma[i] + gamma[i + 1]) * DT for i in range(row))  # slowly
        assert packet[PACKET.value] == pytest.approx(psi + beta[row] + 1.0 * DEG, abs=1e-12)
    assert (packets[:, PACKET.quality] == 1.0).all()
    assert seen.slow["gps"].period == pytest.approx(0.1)
    assert seen.truth is log.truth


def test_a_late_course_arrives_so_many_rows_later(log: Log) -> None:
    fresh = Emulation().with_course(log, 3).record.packets
    late = Emulation(delay=0.2).with_course(log, 3)
    packets = late.record.packets
    np.testing.assert_array_equal(packets[:, PACKET.arrived], packets[:, PACKET.captured] + 20)
    np.testing.assert_array_equal(packets[:, PACKET.value], fresh[: len(packets), PACKET.value])
    assert packets[-1, PACKET.arrived] <= log.record.ticks[-1]
    assert late.slow["gps"].delays == pytest.approx((0.2,))


def test_the_noise_has_its_seed_and_size(log: Log) -> None:
    how = Emulation(course_rate=100.0, course_noise_deg=0.5)
    one, same, other = (how.with_course(log, seed).record.packets for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    noise = one[:, PACKET.value] - (log.truth["beta"] + heading(log))
    assert np.std(noise) == pytest.approx(0.5 * DEG, rel=0.1)
    assert not np.array_equal(one, other)


def test_a_gyro_bias_reaches_the_estimators_but_not_the_heading(log: Log) -> None:
    plain, biased = Emulation(), Emulation(gyro_bias_degps=0.2)
    one, two = plain.with_course(log, 0).record, biased.with_course(log, 0).record
    np.testing.assert_allclose(two.fast[:, FAST.gyro] - one.fast[:, FAST.gyro], 0.2 * DEG)
    np.testing.assert_array_equal(two.packets, one.packets)


def test_no_course_where_the_truth_is_unknown_and_none_to_use_at_a_standstill(
    tmp_path: Path,
) -> None:
    beta, speed = columns()["sideslip_rad"], np.full(ROWS, SPEED)
    beta[95:105] = np.nan
    speed[:50] = 0.5
    log = read_log(saved(tmp_path, sideslip_rad=beta, speed_x_mps=speed))
    packets = Emulation().with_course(log, 0).record.packets
    assert 10_100 not in packets[:, PACKET.captured]
    np.testing.assert_array_equal(packets[:6, PACKET.quality], [0, 0, 0, 0, 0, 1])


def test_a_path_of_a_circle() -> None:
    """Constant speed, yaw rate and sideslip drive a circle of radius V / gamma."""
    fast = np.zeros((20_001, len(FAST)))
    fast[:, FAST.gyro] = 0.1
    fast[:, [FAST.wheel_left, FAST.wheel_right]] = 10.0
    drive = Log(Record(fast, np.zeros((0, PACKET_WIDTH))), {})
    x, y = path(drive, np.zeros(20_001))
    radius = np.hypot(x, y - 100.0)
    np.testing.assert_allclose(radius, 100.0, atol=0.01)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"course_rate": 0.0}, "course_rate must be positive"),
        ({"course_rate": 250.0}, r"a course at 250 Hz needs a log at least as fast; .* 100 rows"),
        ({"course_noise_deg": -1.0}, "course_noise_deg must not be negative"),
        ({"delay": -0.1}, "delay must not be negative"),
        ({"bias_deg": math.nan}, "bias_deg must be finite"),
        ({"seeds": 0}, "expected seeds >= 1"),
        ({"q_gamma": -1.0}, "q_gamma must be finite and not negative"),
        ({"estimators": ["kf"]}, "unknown estimator kf; known here: bicycle-kf"),
        ({"stiffness_factor": -1.0}, "front_stiffness"),
    ],
)
def test_bad_settings_are_refused(log: Log, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replay(log, PASSENGER_CAR, figures=False, **settings)


def test_an_unknown_setting_is_refused(log: Log) -> None:
    with pytest.raises(TypeError, match="course_rat"):
        replay(log, PASSENGER_CAR, course_rat=5.0)


# the replay


def test_told_the_true_car_the_drive_is_followed_exactly(log: Log) -> None:
    """The input's shift by one row is what makes this exact: UNSHIFTED."""
    suite = replay(log, PASSENGER_CAR, estimators=["multirate-kf"], seeds=2, figures=False)
    rmse = values(suite, "rmse")
    assert rmse[GYRO_ONLY] < 1e-12
    assert rmse["multirate-kf"] < 0.2 * DEG  # the course's noise


def test_rows_hold_what_the_estimator_gives_by_itself(log: Log) -> None:
    soft = PASSENGER_CAR.scaled(0.7)
    settings: dict[str, Any] = {"estimators": ["multirate-kf"], "seeds": 3, "seed": 5}
    suite = replay(log, PASSENGER_CAR, stiffness_factor=0.7, figures=False, **settings)
    errors = []
    for seed in (5, 6, 7):
        seen = Emulation().with_course(log, seed)
        estimator = make_estimator(
            "multirate-kf",
            vehicle=soft,
            sensors=seen.slow,
            dt=log.record.dt,
            q_beta=1e-3,
            q_gamma=0.1,
            q_psi=0.0,
            course_noise=0.5 * DEG,
        )
        error = estimator.run(seen)["beta"][200:] - log.truth["beta"][200:]
        errors.append(np.sqrt(np.mean(error**2)))
    row = next(r for r in suite.rows if r.metric == "rmse" and r.estimator == "multirate-kf")
    assert (row.low, row.value, row.high) == pytest.approx(tuple(sorted(errors)), rel=1e-12)
    assert row.n == 3
    spec = json.loads(row.spec)
    assert spec["vehicle"]["front_stiffness"] == soft.front_stiffness
    assert spec["settings"]["seed"] == 5
    ratio = values(suite, "ratio")
    assert ratio[GYRO_ONLY] == 1.0
    assert ratio["multirate-kf"] == pytest.approx(row.value / values(suite, "rmse")[GYRO_ONLY])


def test_all_estimators_are_scored_tabled_and_drawn(log: Log) -> None:
    suite = replay(log, PASSENGER_CAR, stiffness_factor=0.7, seeds=2)
    assert suite.name == "replay"
    assert set(values(suite, "rmse")) == set(ESTIMATORS) == set(values(suite, "us_per_tick"))
    (table,) = suite.tables
    assert {line[0] for line in table.cells} == set(ESTIMATORS)
    numbers = [float(line[1]) for line in table.cells]
    assert numbers == sorted(numbers)
    assert "cannot see" in table.note  # dakf's unobservable direction
    assert len(suite.figures) == 5
    for title, figure, text in suite.figures:
        assert title.startswith(log.name)
        assert len(figure.data) > 0
        assert text


def test_a_log_without_truth_or_slow_sensors_runs_and_says_what_it_leaves_out(
    tmp_path: Path,
) -> None:
    log = read_log(saved(tmp_path, sideslip_rad=None))
    suite = replay(log, PASSENGER_CAR)
    assert set(values(suite, "us_per_tick")) == {GYRO_ONLY}
    assert values(suite, "rmse") == values(suite, "ratio") == {}
    assert "no sideslip truth, so nothing is scored" in suite.text
    assert "`course-kf` left out: needs gps" in suite.tables[0].note
    assert "`exact-kf` left out: needs gps or camera" in suite.tables[0].note
    assert len(suite.figures) == 3
    with pytest.raises(ValueError, match="corners are scored against sideslip truth"):
        corners(log, PASSENGER_CAR)


def test_a_logged_course_is_used_as_it_is(tmp_path: Path) -> None:
    course = np.full(ROWS, np.nan)
    plain = read_log(saved(tmp_path))
    course[::20] = (plain.truth["beta"] + heading(plain))[::20] + 0.7  # another zero of heading
    log = read_log(saved(tmp_path, course_rad=course))
    suite = replay(log, PASSENGER_CAR, figures=False)
    assert "Slow sensors are the log's own: gps" in suite.text
    rmse = values(suite, "rmse")
    assert set(rmse) == set(ESTIMATORS)
    assert rmse["course-kf"] < 0.01 * DEG
    assert {row.n for row in suite.rows} == {1}
    unscored = replay(
        read_log(saved(tmp_path, course_rad=course, sideslip_rad=None)), PASSENGER_CAR
    )
    assert set(values(unscored, "us_per_tick")) == set(ESTIMATORS)
    assert values(unscored, "rmse") == {}


def test_a_drive_that_ends_before_errors_count(tmp_path: Path) -> None:
    short = {name: column[:150] for name, column in columns().items()}
    log = read_log(saved(tmp_path, **short))
    with pytest.raises(ValueError, match=r"lasts 1\.49 s, errors count from 2 s on"):
        replay(log, PASSENGER_CAR)


def test_corners_are_four(log: Log) -> None:
    suite = corners(log, PASSENGER_CAR, estimators=[GYRO_ONLY], seeds=1)
    rows = [row for row in suite.rows if row.metric == "rmse"]
    name = f"{log.name}: passenger-car"
    assert [row.scenario for row in rows] == [
        f"{name}, front x {front}, rear x {rear}" for front in (0.7, 1.3) for rear in (0.7, 1.3)
    ]
    stiffness = [json.loads(row.spec)["vehicle"]["front_stiffness"] for row in rows]
    nominal = PASSENGER_CAR.front_stiffness
    assert stiffness == pytest.approx([0.7 * nominal, 0.7 * nominal, 1.3 * nominal, 1.3 * nominal])
    assert all(row.value > 1e-4 for row in rows)
    assert len(suite.tables[0].cells) == 4


# files

VEHICLE = """\
name = "mine"
mass = 1500
yaw_inertia = 2400
front_arm = 1.2
rear_arm = 1.5
front_stiffness_axle = 110000.0
rear_stiffness_per_tyre = 60000.0
"""


def test_a_vehicle_file_is_toml_or_json(tmp_path: Path) -> None:
    toml, other = tmp_path / "mine.toml", tmp_path / "mine.json"
    toml.write_text(VEHICLE)
    lines = (line.partition(" = ") for line in VEHICLE.splitlines())
    other.write_text(json.dumps({key: json.loads(value) for key, _, value in lines}))
    assert read_vehicle(toml) == read_vehicle(other)
    assert read_vehicle(toml) == PASSENGER_CAR.replace(name="mine", preview=PASSENGER_CAR.preview)


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ("", ValueError, "names no parameter"),
        ("mass = ", ValueError, "expected TOML or JSON"),
        ('{"mass": }', ValueError, "expected TOML or JSON"),
        (VEHICLE.replace("_axle", ""), ValueError, "must say front_stiffness_per_tyre or"),
        (VEHICLE.replace("1500", "-1500"), ValueError, "mass: -1500 kg is not positive"),
        (VEHICLE.replace("1500", '"heavy"'), TypeError, "mass: expected a number, got 'heavy'"),
        (VEHICLE + "wings = 2\n", TypeError, "unknown vehicle parameter 'wings'"),
    ],
)
def test_a_bad_vehicle_file_is_refused(
    tmp_path: Path, content: str, error: type[Exception], message: str
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(content)
    with pytest.raises(error, match=message) as caught:
        read_vehicle(file)
    assert str(file) in str(caught.value)


def test_a_vehicle_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.toml.*ferrari-250lm-nominal"):
        read_vehicle(tmp_path / "nowhere.toml")
    with pytest.raises(ValueError, match="found a folder"):
        read_vehicle(tmp_path)


@pytest.mark.smoke
def test_the_vehicles_of_the_stanford_log_come_with_the_package() -> None:
    """Figures of the recording's source: axle stiffness is twice a tyre's."""
    nominal, fitted = map(read_vehicle, ("ferrari-250lm-nominal", "ferrari-250lm-fitted"))
    assert (nominal.mass, nominal.yaw_inertia) == (982.0, 1605.0)
    assert (nominal.front_stiffness, nominal.rear_stiffness) == (0.35e5, 0.6e5)
    assert (fitted.front_stiffness, fitted.rear_stiffness) == (2.165e4, 4.29e4)
    assert fitted.yaw_inertia == 1340.0


def test_files_in_rows_out(tmp_path: Path) -> None:
    vehicle = tmp_path / "mine.toml"
    vehicle.write_text(VEHICLE)
    table = columns()
    drive = saved(tmp_path, steer_rad=None, Delta=table["steer_rad"] / DEG)
    settings: dict[str, Any] = {"estimators": ["multirate-kf"], "seeds": 1, "figures": False}
    suite = replay_file(drive, vehicle, mapping=["steer_deg=Delta"], **settings)
    assert len(suite.tables) == 2
    assert len(suite.rows) == (1 + 4) * 2 * 3
    write_json(tmp_path / "rows.json", suite.rows)
    assert len(read_json(tmp_path / "rows.json")) == len(suite.rows)
    anyway = replay_file(drive, mapping=["steer_deg=Delta"], **settings)
    assert "No vehicle was named" in anyway.text


@pytest.mark.skipif(not STANFORD.exists(), reason="the shared recordings are not here")
def test_the_stanford_drive_reaches_its_numbers() -> None:
    """Told the fitted car x 0.7: PAPERS section 4 has 1.11 deg gyro only, multirate 0.50-0.53."""
    suite = replay(
        read_log(STANFORD),
        read_vehicle("ferrari-250lm-fitted"),
        stiffness_factor=0.7,
        estimators=["multirate-kf"],
        seeds=3,
        figures=False,
    )
    rmse = values(suite, "rmse")
    assert rmse[GYRO_ONLY] == pytest.approx(1.11 * DEG, abs=0.02 * DEG)
    assert rmse["multirate-kf"] < 0.55 * DEG
    assert values(suite, "ratio")["multirate-kf"] <= 0.60
