"""Trainings over nominal's cost on the same seeds; what cannot be compared is refused."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("stable_baselines3")
from sideslip.agents import make_agent
from sideslip.agents.rollout import costs_of
from sideslip.agents.rungs import make_rung
from sideslip.agents.training import keeper
from sideslip.agents.training.train import CURVE, POLICY, Means, Task, train
from sideslip.benchmarks import curves
from sideslip.benchmarks.curves import FURTHER, further, table_of

SHORT: dict[str, Any] = {"scenario": {"base": "random-steering", "duration": 0.5}}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of a training of two rollouts."""
    monkeypatch.setattr(keeper, "_MEASURED", 8)
    task = Task(env_options=SHORT, num_envs=8, n_eval_envs=8)
    train(task, 512, tmp_path / "a", means=Means(eval_freq=256))
    return tmp_path / "a"


def test_a_training_stands_over_nominal_by_cpu_seconds(folder: Path) -> None:
    lines = [json.loads(line) for line in (folder / CURVE).read_text().splitlines()]
    env, agent = make_rung("nominal", "sideslip/YawVision-v0", 8, **SHORT)
    nominal = costs_of(env, agent, [2**64 + i for i in range(8)]).mean()
    table = table_of([folder])
    spent = [str(column.header) for column in table.columns[1:]]
    ratios = [next(iter(column.cells)) for column in table.columns[1:]]
    assert len(spent) == 8 and spent[-1] == f"{lines[-1]['cpu_seconds']:.0f}"
    assert ratios[-1] == f"{min(line['cost'] for line in lines) / nominal:.2f}"
    assert ratios[0] in ("", f"{lines[0]['cost'] / nominal:.2f}")
    console = Console(width=200)
    with console.capture() as shown:
        console.print(table)
    assert str(folder) in shown.get()


def test_on_further_seeds_the_best_policy_is_driven_beside_nominal(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kept one, not the last; level is one that may cost as little as nominal."""
    found = further([folder], 16)
    mean, better = (str(next(iter(found.columns[i].cells))) for i in (2, 4))
    seeds = range(FURTHER, FURTHER + 16)
    cars = gym.make_vec("sideslip/YawVision-v0", num_envs=16, **SHORT)
    costs = costs_of(cars, make_agent(str(folder / POLICY), cars), seeds)
    nominal = costs_of(*make_rung("nominal", "sideslip/YawVision-v0", 16, **SHORT), seeds)
    assert mean.split()[0] == f"{costs.mean() / nominal.mean():.3f}"
    assert better == f"{100 * np.mean(costs < nominal):.0f} %"
    for dearer, level in ((0.1, "0 of 1 level"), (10.0, "1 of 1 level")):
        monkeypatch.setattr(curves, "nominal_costs", lambda *_, of=dearer: of * nominal)
        assert level in str(further([folder], 16).title)


def test_trainings_that_read_different_things_stand_side_by_side(
    folder: Path, tmp_path: Path
) -> None:
    """Each drives with its own estimator."""
    task = Task(env_options=SHORT, num_envs=8, n_eval_envs=8, estimator="multirate-kf")
    train(task, 256, tmp_path / "b")
    table = further([folder, tmp_path / "b"], 4)
    assert list(table.columns[0].cells) == [str(folder), str(tmp_path / "b")]
    assert table_of([folder, tmp_path / "b"]).row_count == 2


def test_more_drives_than_rows_are_driven_in_parts(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each seed once, in its place, however many are driven at once."""
    whole = list(further([folder], 10).columns[2].cells)
    monkeypatch.setattr(curves, "_AT_ONCE", 4)
    assert list(further([folder], 10).columns[2].cells) == whole


def test_what_cannot_be_compared_is_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "b"
    train(Task(num_envs=8, n_eval_envs=4, env_options=SHORT), 256, other)
    with pytest.raises(ValueError, match="evaluated on different tasks"):
        table_of([folder, other])
    mixture = Task(num_envs=8, n_eval_envs=4, scenarios=[SHORT["scenario"]])
    train(mixture, 256, tmp_path / "c")
    with pytest.raises(ValueError, match="designed for one scenario"):
        table_of([tmp_path / "c"])
    plain = Task(num_envs=8, n_eval_envs=4)
    train(plain, 256, tmp_path / "d")
    for two in (["d", "c"], ["c", "d"]):
        with pytest.raises(ValueError, match="evaluated on different tasks"):
            table_of([tmp_path / each for each in two])
    with pytest.raises(FileNotFoundError, match="holds no training"):
        table_of([tmp_path])


@pytest.mark.parametrize(
    ("module", "arguments", "said"),
    [
        ("curves", ("nowhere",), "nowhere holds no training to go on with"),
        ("curves", (), "Missing argument"),
        ("readme", ("nowhere.json",), "nowhere.json"),
    ],
)
def test_a_mistake_is_no_traceback(module: str, arguments: tuple[str, ...], said: str) -> None:
    command = [sys.executable, "-m", f"sideslip.benchmarks.{module}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and said in done.stderr and "Traceback" not in done.stderr
