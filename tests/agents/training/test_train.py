"""Training: what is kept is what was evaluated, a stopped training goes on, files stay whole."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip import __version__
from sideslip.agents import make_agent
from sideslip.agents.baselines import make_oracle
from sideslip.agents.learned.policy import PolicyController
from sideslip.agents.rollout import evaluate_episodes
from sideslip.envs.vector import StabilityVectorEnv

pytest.importorskip("stable_baselines3")
import torch
from safetensors.torch import save
from stable_baselines3 import PPO

from sideslip.agents.training import callbacks, trainer
from sideslip.agents.training.callbacks import (
    _FORMAT,
    BEST,
    CHECKPOINT,
    CURVE,
    POLICY,
    Checkpoint,
    RunOptions,
    read_training,
)
from sideslip.agents.training.config import TrainingTask

SHORT = {"scenario": {"base": "sine-with-dwell", "duration": 0.5}}
TINY = TrainingTask(num_envs=8, env_options=SHORT, seed=3, n_eval_envs=4)
ROLLOUT = 256  # steps of 8 environments
EACH = RunOptions(eval_freq=ROLLOUT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a training of three rollouts."""
    path = tmp_path_factory.mktemp("trained")
    trainer.Trainer(TINY, 3 * ROLLOUT, path, run_options=EACH).train()
    return path


def curve(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / CURVE).read_text().splitlines()]


def test_the_best_evaluation_is_kept(folder: Path) -> None:
    lines = curve(folder)
    assert [line["steps"] for line in lines] == [0, ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT]
    assert np.all(np.diff([line["cpu_seconds"] for line in lines]) > 0.0)
    model = PPO.load(folder / BEST, device="cpu")
    env = TINY.vector_env(4)
    seeds = callbacks._make_evaluation_seeds(4)
    best = min(line["cost"] for line in lines)
    assert evaluate_episodes(env, model, seeds)[0].mean() == pytest.approx(best, rel=1e-6)
    policy = PolicyController(env, folder / POLICY)
    assert evaluate_episodes(env, policy, seeds)[0].mean() == pytest.approx(best, rel=1e-4)
    card, kept = policy.policy.card, min(lines, key=lambda line: line["cost"])
    assert (card.steps, card.cpu_seconds) == (kept["steps"], kept["cpu_seconds"])
    assert card.env_id == TINY.env_id and card.env_options == TINY.env_options
    assert not policy.policy.network.reads[-1]  # gamma_ref: with zero slip it never varies
    still: Any = type("Still", (), {"predict": lambda *_, **__: (np.zeros((4, 1)), None)})()
    none = evaluate_episodes(env, still, seeds)[0].mean()
    assert lines[0]["of_none"] == pytest.approx(lines[0]["cost"] / none, rel=1e-12)
    assert sorted(os.listdir(folder)) == sorted([BEST, CHECKPOINT, CURVE, POLICY])


def test_no_seed_serves_two_purposes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test and calibration seeds are below 2^63; a training that goes on has new episodes."""
    told: list[int] = []
    reset = StabilityVectorEnv.reset

    def watched(self: Any, *, seed: Any = None, options: Any = None) -> Any:
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
            told.extend(set(seeds))
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(StabilityVectorEnv, "reset", watched)
    trainer.Trainer(TINY, ROLLOUT, tmp_path).train()
    trainer.Trainer(TINY, 2 * ROLLOUT, tmp_path, resume=True).train()
    tested = set(callbacks._make_evaluation_seeds(4))
    others = [seed for seed in told if seed not in tested]
    assert len(others) == len(set(others)) == 8 + 8 + 8  # scaling, training, going on
    assert min(told) >= 2**63


def test_progress_is_told_after_every_rollout(tmp_path: Path) -> None:
    told = list[tuple[int, float | None, int]]()
    options = RunOptions(
        report=lambda x: told.append((x.model.num_timesteps, x.cost, len(x.evaluations)))
    )
    trainer.Trainer(TINY, 2 * ROLLOUT, tmp_path, run_options=options).train()
    (first, second) = told
    assert first == (ROLLOUT, None, 1) and second[::2] == (2 * ROLLOUT, 1)
    assert second[1] is not None and second[1] > 0.0  # 64 steps: episodes have 50


def test_a_kill_in_the_middle_of_saving_leaves_the_older_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer.Trainer(TINY, ROLLOUT, tmp_path).train()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def killed(_: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", killed)
        with pytest.raises(KeyboardInterrupt):
            trainer.Trainer(TINY, 2 * ROLLOUT, tmp_path, resume=True).train()
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert after.keys() == before.keys()
    assert after[CHECKPOINT] == before[CHECKPOINT] and after[CURVE] == before[CURVE]
    again = trainer.Trainer(TINY, 2 * ROLLOUT, tmp_path, resume=True).train()
    assert again.model.num_timesteps == 2 * ROLLOUT


@pytest.mark.long
def test_a_kill_at_any_time_leaves_a_checkpoint_that_goes_on(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from sideslip.agents.training import trainer\n"
        "options = {'scenario': 'sine-with-dwell'}\n"
        "task = trainer.TrainingTask(num_envs=8, env_options=options, n_eval_envs=4)\n"
        "run_options = trainer.RunOptions(eval_freq=256)\n"
        "trainer.Trainer(task, 10**8, sys.argv[1], len(sys.argv) > 2, run_options).train()\n"
    )
    path, reached = tmp_path / CHECKPOINT, [-1]
    for wait in np.random.default_rng(0).uniform(0.0, 0.5, 4):
        command = [sys.executable, "-c", code, str(tmp_path), *(["on"] if path.exists() else [])]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        child = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
        before = path.read_bytes() if path.exists() else b""
        while child.poll() is None and (path.read_bytes() if path.exists() else b"") == before:
            time.sleep(0.01)
        time.sleep(wait)
        child.kill()
        assert child.communicate()[1] == b"" and child.returncode == -signal.SIGKILL
        reached.append(read_training(tmp_path).steps)
        assert reached[-1] > reached[-2]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("env_id", "sideslip/YawFusion-v0"),
        ("estimator", "exact-kf"),
        ("env_options", {}),
        ("seed", 4),
        ("num_envs", 16),
    ],
)
def test_a_checkpoint_of_another_training_is_refused(folder: Path, name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"is of {name} .*, not .*: train that in another"):
        read_training(folder, **{name: value})
    assert read_training(folder).task == TINY
    with pytest.raises(ValueError, match="train that in another folder"):
        trainer.Trainer(dataclasses.replace(TINY, **{name: value}), 10, folder, resume=True).train()


def test_a_folder_that_holds_a_training_is_not_overwritten(folder: Path, tmp_path: Path) -> None:
    before = (folder / CHECKPOINT).read_bytes()
    with pytest.raises(ValueError, match="holds a training already: go on with it"):
        trainer.Trainer(TINY, 10, folder).train()
    assert (folder / CHECKPOINT).read_bytes() == before
    with pytest.raises(FileNotFoundError, match="holds no training to go on with"):
        trainer.Trainer(TINY, 10, tmp_path, resume=True).train()


def test_a_file_that_is_no_checkpoint_says_so(folder: Path, tmp_path: Path) -> None:
    whole = (folder / CHECKPOINT).read_bytes()
    for content in (b"", b"no", whole[:-100]):
        (tmp_path / CHECKPOINT).write_bytes(content)
        with pytest.raises(ValueError, match="is no checkpoint, or is cut short"):
            read_training(tmp_path)
    (tmp_path / CHECKPOINT).write_bytes(save({"a": torch.zeros(1)}))
    with pytest.raises(ValueError, match="is no checkpoint of this format"):
        read_training(tmp_path)


def test_a_log_without_its_package_is_refused_before_a_folder_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    options = RunOptions(tensorboard_log="logs")
    with pytest.raises(ModuleNotFoundError, match="a log for tensorboard needs it"):
        trainer.Trainer(TINY, 9, tmp_path / "other", run_options=options)
    assert not (tmp_path / "other").exists()


WHOLE: dict[str, object] = {
    "format": _FORMAT, "task": dataclasses.asdict(TrainingTask()), "sideslip": __version__,
    "aim": {"steps": 7, "eval_freq": 3}, "groups": {}, "steps": 3, "scaling": [], "evaluations": [],
}  # fmt: skip


def without(key: str) -> dict[str, object]:
    return {name: value for name, value in WHOLE.items() if name != key}


def of(**change: object) -> dict[str, object]:
    """A state whose task has something else."""
    return WHOLE | {"task": dataclasses.asdict(TrainingTask()) | change}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        *((without(each.name), f"checkpoint: missing {each.name}") for each in fields(Checkpoint)),
        (without("format"), "is no checkpoint of this format"),
        ([1], "is no checkpoint of this format"),
        (WHOLE | {"sideslip": "0.0.1"}, "was made by sideslip 0.0.1, this is"),
        ("cut", "is no checkpoint: its state is no JSON"),
        (WHOLE | {"task": 0}, "the checkpoint: task: expected a JSON object, got 0"),
        (of(seed="3"), ": the checkpoint: task: seed is '3', not int"),
        (of(reads=3), ": the checkpoint: task: reads is 3, not list"),
        (of(algo="dqn"), ": the checkpoint: task: unknown algorithm 'dqn'"),
        (of(estimator="evil.py"), ": estimator is a name, got the entry point 'evil.py'"),
        (
            of(estimator="dakf", estimator_options={"estimator": "evil.py"}),
            ": estimator_options holds an estimator",
        ),
        (WHOLE | {"aim": 7}, "the checkpoint: aim: expected a JSON object, got 7"),
        (WHOLE | {"aim": {"steps": "7"}}, "the checkpoint: aim: missing eval_freq"),
        (of(env_id="evil:Car-v0"), ": env_id is that of a registered env, got 'evil:Car-v0'"),
    ],
)
def test_what_a_checkpoint_lacks_is_named(state: object, message: str, tmp_path: Path) -> None:
    text = "{" if state == "cut" else json.dumps(state)
    (tmp_path / CHECKPOINT).write_bytes(save({"a": torch.zeros(1)}, {"checkpoint": text}))
    with pytest.raises(ValueError, match=message) as caught:
        read_training(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / CHECKPOINT))


def test_a_whole_checkpoint_is_read(tmp_path: Path) -> None:
    state = {"checkpoint": json.dumps(WHOLE)}
    (tmp_path / CHECKPOINT).write_bytes(save({"a": torch.zeros(1)}, state))
    assert read_training(tmp_path).task == TrainingTask()


@pytest.mark.long
def test_ppo_without_options_costs_at_most_a_fifth_more_than_nominal(tmp_path: Path) -> None:
    task = TrainingTask()
    trainer.Trainer(task, int(task.settings["n_timesteps"]), tmp_path).train()
    nominal, agent = make_oracle("nominal", task.env_id, 64)
    env, seeds = task.vector_env(64), range(64)
    policy = make_agent(str(tmp_path / POLICY), env)
    found, known = (
        evaluate_episodes(env, policy, seeds)[0],
        evaluate_episodes(nominal, agent, seeds)[0],
    )
    assert found.mean() < 1.2 * known.mean()
