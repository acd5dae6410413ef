"""A user's contestant that goes wrong is a result with its reason, and nobody else's end."""

import re
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest

import sideslip
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import Chunk
from sideslip.benchmarks.control.tasks import YAW, ControlTask
from sideslip.benchmarks.entrants.challenge import ComparisonRequest, make_user_entries
from sideslip.benchmarks.entrants.worker import IsolatedDrive, run_user_chunk

SHORT = {"scenario": {"base": "gust", "duration": 0.05}}
GUST = ControlTask(scenario="gust", changes=SHORT)
HEAD = """
import os
import numpy as np


class Mine:
    def __init__(self, env):
        self.calls = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls += 1
        action = np.zeros((len(observation), 1), np.float32)
"""


def chunk(folder: Path, body: str, estimator: str = "") -> Chunk:
    (folder / "mine.py").write_text(f"{HEAD}        {body}\n")
    return Chunk(GUST, Entry(str(folder / "mine.py"), estimator), (0, 1, 2), keep=True)


WRONG = {
    "raises": ("return action / self.forgotten, state", r"no attribute 'forgotten' .mine.py, line"),
    "one action for all": ("return action[0], state", r"actions \(3, 1\).* got shape \(1,\)"),
    "too wide": ("return np.hstack([action] * 2), state", r"got shape \(3, 2\)"),
    "ragged": ("return [[0.0], [0.0, 1.0], [0.0]], state", "inhomogeneous"),
    "no state": ("return action", r"predict returns \(action, state\), got"),
    "nothing": ("pass", r"predict returns \(action, state\), got None"),
    "NaN": ("return action * np.nan, state", "every action is NaN"),
    "NaN once all drive": ("return action * (1.0 if self.calls < 3 else np.nan), state", "NaN"),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_agent_that_goes_wrong_was_not_driven(case: str, tmp_path: Path) -> None:
    body, reason = WRONG[case]
    driven = run_user_chunk(chunk(tmp_path, body))
    assert np.isnan(driven.numbers).all()
    assert re.search(reason, driven.error), driven.error


def test_one_nan_ends_its_episode_alone(tmp_path: Path) -> None:
    """As the env has it: a failure of that episode, no end of the others."""
    driven = run_user_chunk(chunk(tmp_path, "action[1] = np.nan; return action, state"))
    assert not driven.error
    assert driven.mark_failures("bad-action").tolist() == [0.0, 1.0, 0.0]


def test_what_ends_a_process_is_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends, or never returns; the numbers of one that drives are those of this process."""
    gone = IsolatedDrive()(chunk(tmp_path, "os._exit(3)"))
    assert gone.error == "its process ended with status 3"
    asleep = chunk(tmp_path, "import time; time.sleep(1e6)")
    assert IsolatedDrive(1.0)(asleep).error.startswith("no end within 1 s")
    fine = chunk(tmp_path, "print('hello'); action[:] = 0.1; return action, state")
    apart, here = IsolatedDrive()(fine), run_user_chunk(fine)
    assert not apart.error
    assert np.array_equal(apart.numbers, here.numbers)
    assert apart.series is not None and np.array_equal(apart.series, here.series)  # type: ignore[arg-type]


FILTER = """
import numpy as np
from sideslip.envs.record import FAST


class Integrator:
    names = ("beta", "gamma")

    def __init__(self, *, vehicle, sensors, dt, speed):
        self.dt, self.speed = dt, speed or 7.0

    def reset(self, sensors, first):
        self.x, self.P = np.zeros(2), np.diag([0.02, 0.005]) ** 2

    def step(self, rows, packets):
        for row in rows:
            rate = row[FAST.accel_y] / self.speed - row[FAST.gyro] - 2.0 * self.x[0]
            self.x = np.array([self.x[0] + self.dt * rate, row[FAST.gyro]])
        self.P = self.P + 1e-6 * len(packets) * np.eye(2)
"""


def test_a_filter_in_a_child_gives_the_bits_of_one_in_this_process(tmp_path: Path) -> None:
    (tmp_path / "filter.py").write_text(FILTER)
    chunk = Chunk(GUST, Entry("lqr", str(tmp_path / "filter.py")), (0, 1, 2))
    apart, here = (drive(chunk) for drive in (IsolatedDrive(), run_user_chunk))
    assert not apart.error
    assert np.array_equal(apart.numbers, here.numbers)


@pytest.mark.long
def test_a_zip_drives_as_its_export_does(tmp_path: Path) -> None:
    """On the observation that it was trained on."""
    sb3 = pytest.importorskip("stable_baselines3")
    from sideslip.agents.training.export import export_zip
    from sideslip.agents.vec_env import make_vec_env

    zipped, exported = tmp_path / "mine.zip", tmp_path / "mine.safetensors"
    sb3.A2C("MlpPolicy", make_vec_env(YAW, 1), policy_kwargs={"net_arch": [4]}).save(zipped)
    export_zip(zipped, exported, YAW, trust=True)
    short = {"base": "gust", "duration": 0.3}
    options: dict[str, Any] = {"scenarios": short, "seeds": (1, 2), "jobs": 1, "estimator": ""}
    found = [
        sideslip.score(str(path), YAW, trust=path == zipped, **options)
        for path in (zipped, exported)
    ]
    assert not found[0].error and found[0].cost == found[1].cost


def test_a_zip_is_read_where_it_is_trusted(tmp_path: Path) -> None:
    """Alone, without a filter that it did not see in training."""
    mine = str(tmp_path / "mine.zip")
    with ZipFile(mine, "w") as archive:
        archive.writestr("data", "{}")
        archive.writestr("policy.pth", "")
    (pair, other) = make_user_entries([mine, "esc"], [], trust=True)
    assert pair.estimator == "" and ControlCase(ControlTask(), pair).options["controller"] == {
        "trust": True
    }
    assert not other.trust
    ComparisonRequest((pair,))
    with pytest.raises(PermissionError, match=r"`sideslip export .*mine.zip --trust`"):
        ComparisonRequest(tuple(make_user_entries([mine], [])))
