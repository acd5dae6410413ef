"""rl-baselines3-zoo trains with our settings, its zip goes on here, and it drives our folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
from sideslip.agents.learned.policy import load_policy
from sideslip.agents.rollout import evaluate_costs
from sideslip.agents.training.callbacks import POLICY, RunOptions
from sideslip.agents.training.config import ALGORITHMS, HYPERPARAMS, TrainingTask
from sideslip.agents.training.trainer import train
from sideslip.agents.training.warm_start import _NetworkAgent

THEIRS = [name for name, each in ALGORITHMS.items() if not each.on_tensors]
FEW = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "learning_starts": 32, "buffer_size": 1000}


@pytest.mark.long
@pytest.mark.parametrize("algo", THEIRS)
def test_the_zoo_takes_our_settings_and_we_its_zip(algo: str, tmp_path: Path) -> None:
    zoo = ALGORITHMS[algo].zoo
    settings = TrainingTask(algo=algo).settings
    few = [f"{name}:{value}" for name, value in FEW.items() if name in settings]
    command = [
        *(sys.executable, "-m", "rl_zoo3.train", "--algo", zoo, "--env", "sideslip/YawVision-v0"),
        *("--gym-packages", "sideslip", "--conf-file", str(HYPERPARAMS / f"{zoo}.yml")),
        *("-n", "256", "--seed", "0", "--eval-freq", "-1", "-f", str(tmp_path), "--device", "cpu"),
        *("-params", *few),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    (zipped,) = (tmp_path / zoo / "sideslip-YawVision-v0_1").glob("sideslip*.zip")
    task = TrainingTask(algo=algo, num_envs=4, n_eval_envs=4)
    train(task, 64, tmp_path / "on", trained_agent=zipped, trust=True)


@pytest.mark.long
@pytest.mark.parametrize("algo", THEIRS)
def test_the_zoo_finds_and_drives_what_we_left(algo: str, tmp_path: Path) -> None:
    """The best model, on seed 0, at the cost of our own file of it."""
    task = TrainingTask(
        algo=algo,
        env_options={"scenario": "sine-with-dwell"},
        estimator="exact-kf",
        num_envs=4,
        n_eval_envs=4,
    )
    folder = task.find_zoo_folder(tmp_path)
    task.describe_for_zoo(folder, 64, 64)
    train(task, 64, folder, run_options=RunOptions(eval_freq=64))
    cars = task.vector_env(1)
    cost = evaluate_costs(cars, _NetworkAgent(load_policy(folder / POLICY).network), [0])[0]
    command = [
        *(sys.executable, "-m", "rl_zoo3.enjoy", "--algo", ALGORITHMS[algo].zoo, "--no-render"),
        *("--env", "sideslip/YawVision-v0", "--gym-packages", "sideslip", "-f", str(tmp_path)),
        *("-n", "1001", "--seed", "0", "--load-best", "--device", "cpu"),
    ]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert f"Episode Reward: {-cost:.2f}" in done.stdout
