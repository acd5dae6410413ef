"""A column that contradicts the others is warned of, and no clean drive is."""

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from sideslip.agents.rollout import rollout
from sideslip.benchmarks.recorded.quality import (
    COMPASS,
    TRUTH,
    estimate_resolution,
    find_contradictions,
    find_saturated,
    sort_remarks,
)
from sideslip.benchmarks.recorded.replay import TRUTH_WARNING, replay_file
from sideslip.benchmarks.report.html import write_report
from sideslip.benchmarks.report.tables import print_suite
from sideslip.envs.record import FAST, PACKET, Array, Log
from sideslip.envs.recordings.log_file import make_packets
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, Vehicle

from .simulated import decimated
from .slalom import VEHICLE, columns, saved

DEG = math.pi / 180.0
IDS = ("sideslip/YawGps-v0", "sideslip/YawFusion-v0", "sideslip/YawVision-v0")
MANOEUVRES = ("random", "slalom", "sine", "step", "sine-with-dwell")
Change = Callable[[Array], Array]


@functools.cache
def drive(seed: int, duration: float = 12.0) -> tuple[Log, Vehicle]:
    """(log at 1 kHz with truth, the car that its estimators assume) of a drive that differs with
    its seed in id, car, tyres, friction, speed and manoeuvre; noise as shipped."""
    rng = np.random.default_rng(seed)
    small = seed % 3 == 2
    speed = rng.uniform(6.0, 10.0) if small else rng.uniform(12.0, 28.0)
    scenario: dict[str, Any] = {
        "base": "random-steering", "steering": MANOEUVRES[seed % len(MANOEUVRES)],
        "amplitude": rng.uniform(0.3, 1.0) * 0.03 * min(1.0, 14.0 / speed),
        "frequency": rng.uniform(0.2, 0.6), "duration": duration, "speed": speed,
        "surge": float(rng.choice([0.0, 0.7])), "friction": (0.7, 1.0), "half_width": 1e4,
        "front_stiffness": (0.7, 1.3), "rear_stiffness": (0.8, 1.3), "gyro_bias": (-0.005, 0.005),
        "gps_latency": float(rng.choice([0.0, 0.2])),
    }  # fmt: skip
    name = "coms" if small else "passenger-car"
    env: Any = gym.make(IDS[seed // 5 % 3], scenario=scenario, vehicle=name)
    return rollout(env, seed=seed).log, env.unwrapped.nominal


@functools.cache
def clean() -> Log:
    """A passenger car in random steering at 100 Hz with GPS and truth."""
    return decimated(drive(0, 20.0)[0])


def changed(
    log: Log,
    fast: Mapping[str, Change] | None = None,
    truth: Change | None = None,
    course: Change | None = None,
) -> Log:
    """The log with some of its columns changed; "speed" stands for both wheels'."""
    rows, packets, known = log.record.fast.copy(), log.record.packets.copy(), dict(log.truth)
    for name, change in (fast or {}).items():
        for each in ("wheel_left", "wheel_right") if name == "speed" else (name,):
            rows[:, getattr(FAST, each)] = change(rows[:, getattr(FAST, each)])
    if truth is not None:
        known["beta"] = truth(known["beta"])
    if course is not None:
        angle = course(packets[:, PACKET.value])
        packets[:, PACKET.value] = np.arctan2(np.sin(angle), np.cos(angle))
    record = dataclasses.replace(log.record, fast=rows, packets=packets)
    return dataclasses.replace(log, record=record, truth=known)


def put(value: float, start: int, count: int = 1) -> Change:
    """A change that writes a value into so many rows."""

    def change(x: Array) -> Array:
        x = x.copy()
        x[start : start + count] = value
        return x

    return change


def times(factor: float) -> Change:
    return lambda x: factor * x


def filled(log: Log, value: float) -> Log:
    """A course of one value between its fixes."""
    fixes = log.record.packets
    courses = np.full(len(log.time), value)
    courses[(fixes[:, PACKET.captured] - log.record.first).astype(int)] = fixes[:, PACKET.value]
    values = {"time": log.time, "speed_x": log.speed, "course": courses}
    packets, _ = make_packets(values, log.record.first, log.record.dt)
    return dataclasses.replace(log, record=dataclasses.replace(log.record, packets=packets))


def of_heading(log: Log) -> Log:
    noise = np.random.default_rng(0).normal(0.0, 0.002, len(log.record.packets))
    rows = (log.record.packets[:, PACKET.captured] - log.record.first).astype(int)
    return changed(log, course=lambda x: log.heading[rows] + noise)


def make_warnings(logs: list[Log], car: Vehicle) -> list[str]:
    return [finding.text for finding in find_contradictions(logs, car)]


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(i, marks=pytest.mark.long) for i in range(4, 50))]
)
def test_a_clean_drive_has_no_warning(seed: int) -> None:
    log, car = drive(seed)
    for every in (1, 10, 50):
        short = decimated(log, every)
        assert make_warnings([short], car) == []
        assert make_warnings([dataclasses.replace(short, truth={})], car) == []
        assert sort_remarks([], [short], PASSENGER_CAR)[1] == []


@pytest.mark.parametrize(
    ("text", "spoil"),
    [
        (f"the course turns against the gyro .*{re.escape(COMPASS)}",
            lambda log: changed(log, course=lambda x: math.pi / 2.0 - x)),
        ("the change of the course is 0.01.* radians in a column of degrees",
            lambda log: changed(log, course=times(DEG))),
        ("the course jumps to 0 deg and back", lambda log: filled(log, 0.0)),
        ("the course jumps to -57.3 deg and back", lambda log: changed(log, course=put(-1.0, 40))),
        ("the course stands still in [0-9]* fixes",
            lambda log: changed(log, course=lambda x: put(x[30], 30, 40)(x))),
        ("the course does not follow", lambda log: changed(log, course=times(0.0))),
        ("the course shows no sideslip", of_heading),
        ("accel_y is 0.1.* g in a column", lambda log: changed(log, {"accel_y": times(0.102)})),
        ("accel_y is -1.* its sign", lambda log: changed(log, {"accel_y": times(-1.0)})),
        ("accel_y is 0 in", lambda log: changed(log, {"accel_y": times(0.0)})),
        ("accel_y jumps", lambda log: changed(log, {"accel_y": put(-999.0, 900)})),
        ("the speed in km/h", lambda log: changed(log, {"speed": times(3.6)})),
        ("speed jumps .* in 11 rows", lambda log: changed(log, {"speed": put(0.0, 900, 10)})),
        ("the yaw rate is 5[0-9].* degrees", lambda log: changed(log, {"gyro": times(1.0 / DEG)})),
        ("the yaw rate is -[01].* its sign", lambda log: changed(log, {"gyro": times(-1.0)})),
        ("gyro is 0 in", lambda log: changed(log, {"gyro": times(0.0)})),
        ("steer is 0 in", lambda log: changed(log, {"steer": times(0.0)})),
    ],
)  # fmt: skip
def test_a_column_beside_the_others_is_warned_of(text: str, spoil: Callable[[Log], Log]) -> None:
    found = make_warnings([spoil(clean())], PASSENGER_CAR)
    assert any(re.search(text, each) for each in found), found
    assert not any(each.startswith(TRUTH) for each in found) or "gyro is 0" in text
    assert make_warnings([clean()], PASSENGER_CAR) == []


@pytest.mark.parametrize(
    ("text", "truth"),
    [
        ("is 5[0-9].* degrees in a column of radians", times(1.0 / DEG)),
        ("is -[01].* its sign", times(-1.0)),
        ("jumps .* in 2 rows", put(999.0, 900)),
        ("jumps .* in 2 rows", put(-1.0, 900)),
        ("is 0 in", lambda x: np.where(np.arange(len(x)) % 10, 0.0, x)),
        ("and what .* unrelated", lambda x: np.random.default_rng(0).normal(0.0, 0.02, len(x))),
    ],
)
@pytest.mark.parametrize("without", ["", "accel_y"])
def test_a_truth_beside_the_others_is_warned_of(text: str, truth: Change, without: str) -> None:
    """By accel_y, and where that was not logged by the course."""
    record = clean().record
    present = tuple(name for name in record.present if name != without)
    log = dataclasses.replace(clean(), record=dataclasses.replace(record, present=present))
    log = changed(log, {without: times(0.0)} if without else {})
    assert make_warnings([log], PASSENGER_CAR) == []
    found = make_warnings([changed(log, truth=truth)], PASSENGER_CAR)
    assert any(re.match(f"{TRUTH} {text}", each) for each in found) or (
        without and "unrelated" in text
    ), found


def test_a_gyro_of_coarse_steps_is_not_at_its_limit() -> None:
    """Its steps are said instead; a fine one is, and one that holds its samples is not."""
    step = 1.28 * DEG
    coarse = changed(clean(), {"gyro": lambda x: step * np.rint(x / step)})
    assert not find_saturated(coarse).any() and make_warnings([coarse], PASSENGER_CAR) == []
    assert sort_remarks([], [coarse], PASSENGER_CAR)[1] == ["The gyro's resolution is 1.28 deg/s."]
    assert estimate_resolution(clean().record.fast[:, FAST.gyro]) == 0.0
    assert sort_remarks([], [clean()], PASSENGER_CAR)[1] == []
    held = changed(clean(), {"gyro": lambda x: x[::10].repeat(10)[: len(x)]})
    assert not find_saturated(held).any()
    clipped = changed(clean(), {"gyro": lambda x: np.clip(x, -0.5 * x.max(), 0.5 * x.max())})
    assert find_saturated(clipped).sum() > 20


def reversing(signed: bool) -> dict[str, Array]:
    """The slalom, and after it 5 s backward with the truth of a car that moves so."""
    table = columns()
    more = 500
    back = {name: np.full(more, 0.0) for name in table}
    back["time_s"] = table["time_s"][-1] + 0.01 * np.arange(1, more + 1)
    back["speed_x_mps"] = np.where(np.arange(more) < 50, 0.0, -3.0 if signed else 3.0)
    back["sideslip_rad"] = np.where(np.arange(more) < 50, 0.0, math.pi - 0.01)
    return {name: np.append(table[name], back[name]) for name in table}


@pytest.mark.parametrize("signed", [True, False])
def test_rows_driven_backward_are_not_scored(tmp_path: Path, signed: bool) -> None:
    vehicle = tmp_path / "car.toml"
    vehicle.write_text(VEHICLE)
    table = reversing(signed)
    settings: dict[str, Any] = {"estimators": ["bicycle-kf"], "figures": False}
    suite = replay_file(saved(tmp_path, **table), vehicle, **settings)
    (row,) = (r for r in suite.rows if r.metric == "rmse")
    assert row.value < 1.0 * DEG
    assert "450 rows are driven backward, and not scored" in suite.text
    assert not clean().is_backward.any()


def test_warnings_stand_over_the_verdict(tmp_path: Path) -> None:
    vehicle = tmp_path / "car.toml"
    vehicle.write_text(VEHICLE)
    table = columns()
    course = np.where(np.arange(len(table["time_s"])) % 10, np.nan, 0.0)
    psi = np.cumsum(table["yaw_rate_radps"]) * 0.01 + table["sideslip_rad"]
    spoilt = {"course_rad": course + psi, "sideslip_rad": table["sideslip_rad"] / DEG}
    file = saved(tmp_path, **spoilt)
    suite = replay_file(file, vehicle, estimators=["bicycle-kf"], figures=False)
    assert len(suite.warnings) == 1 and suite.warnings[0].startswith(TRUTH)
    assert suite.verdict.splitlines()[0] == TRUTH_WARNING and len(suite.verdict.splitlines()) <= 5
    console = Console(record=True, width=200)
    print_suite(console, suite)
    lines = console.export_text().splitlines()
    at = next(i for i, line in enumerate(lines) if "WARNING: the sideslip truth" in line)
    assert lines[at].endswith("?") and lines[at + 1] == TRUTH_WARNING
    write_report(tmp_path / "report.html", [suite], "sideslip replay", {})
    page = (tmp_path / "report.html").read_text()
    assert page.index("<li>WARNING: ") < page.index(f"<li>{TRUTH_WARNING}")
    right = replay_file(saved(tmp_path), vehicle, estimators=["bicycle-kf"], figures=False)
    assert right.warnings == [] and TRUTH_WARNING not in right.verdict
