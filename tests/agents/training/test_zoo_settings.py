"""rl-baselines3-zoo trains with our settings, its zip goes on here, and it drives our folder."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")
from sideslip.agents.learned.policy import load_policy
from sideslip.agents.rollout import evaluate_episodes
from sideslip.agents.training.callbacks import POLICY, RunOptions, describe_for_zoo
from sideslip.agents.training.config import ALGORITHMS, HYPERPARAMS, TrainingTask
from sideslip.agents.training.trainer import Trainer
from sideslip.benchmarks.cli.policies import _choose_folder

THEIRS = [name for name, each in ALGORITHMS.items() if not each.on_tensors]
FEW = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "learning_starts": 32, "buffer_size": 1000}


def run_zoo(script: str, algo: str, folder: Path, *words: str) -> str:
    """What a script of the zoo prints; it drives `YawVision` on one core."""
    command = [
        *(sys.executable, "-m", f"rl_zoo3.{script}", "--algo", ALGORITHMS[algo].zoo),
        *("--env", "sideslip/YawVision-v1", "--gym-packages", "sideslip", "--device", "cpu"),
        *("-f", str(folder), "--seed", "0", *words),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.long
@pytest.mark.parametrize("algo", THEIRS)
def test_the_zoo_takes_our_settings_and_we_its_zip(algo: str, tmp_path: Path) -> None:
    zoo, settings = ALGORITHMS[algo].zoo, TrainingTask(algo=algo).settings
    few = [f"{name}:{value}" for name, value in FEW.items() if name in settings]
    file = ("--conf-file", str(HYPERPARAMS / f"{zoo}.yml"), "--eval-freq", "-1")
    run_zoo("train", algo, tmp_path, *file, "-n", "256", "-params", *few)
    (zipped,) = (tmp_path / zoo / "sideslip-YawVision-v1_1").glob("sideslip*.zip")
    task = TrainingTask(algo=algo, num_envs=4, n_eval_envs=4)
    Trainer(task, 64, tmp_path / "on", initial=zipped, trust=True).train()


@pytest.mark.long
@pytest.mark.parametrize("algo", THEIRS)
def test_the_zoo_finds_and_drives_what_we_left(algo: str, tmp_path: Path) -> None:
    """The best model, on seed 0, at the cost of our own file of it."""
    few: dict[str, Any] = {"num_envs": 4, "n_eval_envs": 4, "estimator": "exact-kf"}
    task = TrainingTask(algo=algo, env_options={"scenario": "sine-with-dwell"}, **few)
    folder = _choose_folder(task, "", None, tmp_path)
    describe_for_zoo(task, folder, 64, 64)
    Trainer(task, 64, folder, run_options=RunOptions(eval_freq=64)).train()
    agent = load_policy(folder / POLICY).network
    cost = evaluate_episodes(task.vector_env(1), agent, [0])[0][0]
    out = run_zoo("enjoy", algo, tmp_path, "--no-render", "-n", "1001", "--load-best")
    assert f"Episode Reward: {-cost:.2f}" in out
