"""Rows survive the disk, and nothing is left half-written."""

import math
import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest

from sideslip.benchmarks.harness.metrics import EPISODE, METRICS, REDUCTIONS, compute_dissipation
from sideslip.benchmarks.harness.results import (
    ResultRow,
    check_writable,
    read_json,
    write_json,
    write_parquet,
)

ROWS = [
    ResultRow("estimation", "tie-vision-fig7", "rmse", 0.005, "dakf", low=0.004, high=0.006, n=100),
    ResultRow("speed", "x", "us_per_step", 2.5, verdict="report only"),
]


def test_rows_round_trip_through_json(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    write_json(path, ROWS)
    first, second = read_json(path)
    assert first == ROWS[0]
    assert math.isnan(second.low) and second.value == 2.5 and second.verdict == "report only"
    assert "NaN" not in path.read_text()
    assert os.listdir(tmp_path) == ["rows.json"]


def test_rows_as_parquet(tmp_path: Path) -> None:
    write_parquet(tmp_path / "rows.parquet", ROWS)
    assert pq.read_table(tmp_path / "rows.parquet")["metric"].to_pylist() == ["rmse", "us_per_step"]
    assert os.listdir(tmp_path) == ["rows.parquet"]


def test_words_outside_the_vocabulary_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown metric 'swiftness'"):
        ResultRow("a", "b", "swiftness", 1.0)
    with pytest.raises(ValueError, match="unknown verdict 'good'"):
        ResultRow("a", "b", "rmse", 1.0, verdict="good")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is no JSON, or is cut short"),
        ('[{"suite": "a", ', "is no JSON, or is cut short"),
        ("[" * 99999, "is no JSON, or is cut short"),
        ("\0", "is no JSON"),
        ('{"suite": "a"}', "expected a JSON list of objects"),
        ('[{"suite": "a"}, 3]', "expected a JSON list of objects"),
        ('[{"suite": "a", "colour": "red"}]', "row 1: unknown colour"),
        ("[GOOD, {}]", "row 2: missing metric, scenario, suite, value"),
        ('[GOOD, {"suite": "a", "scenario": "b", "metric": "rmse"}]', "row 2: missing value"),
        ('[GOOD, {"suite": null, "scenario": "b", "metric": "rmse", "value": 1}]', "suite is nan"),
        ('[{"suite": "a", "scenario": "b", "metric": "rmse", "value": "1"}]', "value is '1', not"),
        ('[{"suite": "a", "scenario": "b", "metric": "rmse", "value": true}]', "value is True"),
        ('[{"suite": "a", "scenario": "b", "metric": "rmse", "value": HUGE}]', "value is 1111"),
        ('[{"suite": "a", "scenario": "b", "metric": "fun", "value": 1}]', "row 1: unknown metric"),
    ],
)
def test_rows_that_are_none_name_their_file(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    write_json(path, ROWS[:1])
    good = path.read_text()[1:-2]
    path.write_text(content.replace("GOOD", good).replace("HUGE", "1" * 400))
    with pytest.raises(ValueError, match=message) as caught:
        read_json(path)
    assert str(caught.value).startswith(str(path)) and len(str(caught.value)) < 500


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere" / "file")
    check_writable(None, tmp_path / "file", tmp_path / "pipe", Path("/dev/null"))
    with pytest.raises(IsADirectoryError, match="it is a folder"):
        check_writable(tmp_path)
    for path in (tmp_path / "nowhere" / "file", tmp_path / "link"):
        with pytest.raises(FileNotFoundError, match="there is no such folder"):
            check_writable(path)
    writable = {tmp_path / "pipe"}
    monkeypatch.setattr(os, "access", lambda path, mode: path in writable)
    check_writable(tmp_path / "pipe")  # whatever its folder is
    with pytest.raises(PermissionError, match="read-only"):
        check_writable(tmp_path / "file")


VALUES = np.array([[0.3, -2.0], [-1.5, 0.5], [0.2, 0.1]])  # of 3 steps and 2 cars


@pytest.mark.parametrize(
    ("fold", "expected"),
    [
        ("sum", VALUES.sum(axis=0)),
        ("mean", VALUES.mean(axis=0)),
        ("rms", np.sqrt((VALUES**2).mean(axis=0))),
        ("max", np.abs(VALUES).max(axis=0)),
        ("last", VALUES[-1]),
    ],
)
def test_a_fold_is_what_its_name_is(fold: str, expected: np.ndarray) -> None:
    total = np.zeros(2)
    for step in VALUES:
        total = REDUCTIONS[fold].add(total, np.abs(step) if fold == "max" else step)
    assert REDUCTIONS[fold].finish(total, np.full(2, 3.0)) == pytest.approx(expected)


def test_every_metric_of_an_episode_has_a_unit_and_a_fold() -> None:
    names = [metric.name for metric in EPISODE]
    assert len(set(names)) == len(names)
    for metric in EPISODE:
        assert METRICS[metric.name] == metric.unit and metric.reduction in REDUCTIONS


NOTHING = ("acceleration", "disturbance_force", "disturbance_moment", "onset")
COASTING = dict.fromkeys(NOTHING, 0.0) | {"roll": False, "duration": 2.0}


@pytest.mark.parametrize("tyres", ["linear", "fiala"])
def test_it_is_the_kinetic_energy_that_a_coasting_car_loses(tyres: str) -> None:
    """No motor, wind, bank or roll: d/dt (m v^2 + I gamma^2) / 2 is minus the dissipation."""
    scenario = {"base": "slalom", "amplitude": 0.06, "frequency": 0.5, "tyres": tyres} | COASTING
    env: Any = gym.make_vec(
        "sideslip/YawFusion-v0", num_envs=2, scenario=scenario, control_period=1
    )
    env.reset(seed=[1, 2])
    base = env.unwrapped
    m, inertia = base.vehicle[0].mass, base.vehicle[0].yaw_inertia
    energy, heat = [], []
    for _ in range(1999):
        env.step(np.zeros((2, 1), np.float32))
        v_x, v_y, gamma = base.motion[:, :3].T
        energy.append(0.5 * m * (v_x**2 + v_y**2) + 0.5 * inertia * gamma**2)
        heat.append(compute_dissipation(*base.engine.arrays[:3]))
    lost = energy[0] - energy[-1]
    found = np.trapezoid(heat, dx=1e-3, axis=0)
    assert lost.min() > 20.0
    np.testing.assert_allclose(found, lost, rtol=2e-3)
