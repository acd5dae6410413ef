"""The folder that rl-baselines3-zoo's `enjoy` is to find, against what it looks for there."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sideslip.agents.rollout import evaluate_episodes
from sideslip.agents.training import trainer
from sideslip.agents.training.callbacks import (
    EVALUATIONS,
    RunOptions,
    _make_evaluation_seeds,
    describe_for_zoo,
    find_zoo_folder,
)
from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.trainer import Trainer
from sideslip.benchmarks.cli.policies import _choose_folder
from tests.agents.vec_env.test_zoo import wrapper_of

ENV = "sideslip/YawGps-v0"
NAME = "sideslip-YawGps-v0"
TASK = TrainingTask(
    env_id=ENV, estimator="exact-kf", estimator_options={"outputs": ["beta"], "std": False},
    env_options={"reference": "zero-slip"},
    scenarios=["sine-with-dwell", {"base": "lane-change", "duration": 3.0}], num_envs=4,
    n_eval_envs=4,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of two evaluations."""
    patch = pytest.MonkeyPatch()
    patch.setattr(trainer, "_SCALING_ENVS", 8)
    place = _choose_folder(TASK, "", None, tmp_path_factory.mktemp("logs"))
    describe_for_zoo(TASK, place, 256, 128)
    Trainer(TASK, 128, place, run_options=RunOptions(eval_freq=128)).train()
    patch.undo()
    return place


def test_every_file_is_where_the_zoo_has_it(folder: Path) -> None:
    assert (folder.parent.name, folder.name) == ("ppo", f"{NAME}_1")
    assert {each.name for each in folder.iterdir()} == {
        NAME, f"{NAME}.zip", "best_model.zip", "evaluations.npz",
        "policy.safetensors", "checkpoint.safetensors", "curve.jsonl",
    }  # fmt: skip
    assert {each.name for each in (folder / NAME).iterdir()} == {"config.yml", "args.yml"}


def test_the_next_number_is_one_above_the_largest(tmp_path: Path) -> None:
    """Other ids' numbers and words count for nothing."""
    assert find_zoo_folder(tmp_path, TASK) == tmp_path / "ppo" / f"{NAME}_1"
    for name in (f"{NAME}_2", f"{NAME}_9", f"{NAME}_x", f"{NAME}_11_b", "other_40", f"a{NAME}_50"):
        (tmp_path / "ppo" / name).mkdir(parents=True)
    assert find_zoo_folder(tmp_path, TASK).name == f"{NAME}_10"


def enjoyed(folder: Path, model: str) -> tuple[Any, Any]:
    """(env, model) as `get_saved_hyperparams`, `create_test_env` and `enjoy` make them."""
    hyperparams = yaml.safe_load((folder / NAME / "config.yml").read_text())
    arguments = yaml.safe_load((folder / NAME / "args.yml").read_text())
    assert not hyperparams["normalize"]  # else statistics are looked for that are not there
    assert arguments["env"] == ENV and "frame_stack" not in hyperparams
    kind = wrapper_of(hyperparams["env_wrapper"])
    spec, kwargs = gym.spec(ENV), arguments["env_kwargs"]
    env = make_vec_env(spec.make, 1, seed=0, wrapper_class=kind, env_kwargs=kwargs)
    custom = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    return env, PPO.load(folder / model, custom_objects=custom, device="cpu", seed=0)


@pytest.mark.parametrize("model", [f"{NAME}.zip", "best_model.zip"])
def test_what_enjoy_makes_of_it_drives_as_the_evaluation_did(folder: Path, model: str) -> None:
    """The network's scales are in the zip; the mixture's first scenario is driven."""
    env, loaded = enjoyed(folder, model)
    seed = _make_evaluation_seeds(1)[0]
    cost, done = 0.0, False
    env.seed(seed)
    obs = env.reset()
    while not done:
        action, _ = loaded.predict(obs, deterministic=True)
        obs, rewards, dones, _ = env.step(action)
        cost, done = cost - float(rewards[0]), bool(dones[0])
    costs, _ = evaluate_episodes(TASK.vector_env(4), loaded, _make_evaluation_seeds(4))
    assert cost == pytest.approx(costs[0])
    if model != "best_model.zip":
        with np.load(folder / EVALUATIONS) as found:
            assert cost == pytest.approx(-found["results"][-1, 0], rel=1e-4)


def test_evaluations_are_as_eval_callback_has_them_and_go_on(folder: Path) -> None:
    def found() -> dict[str, Any]:
        with np.load(folder / EVALUATIONS, allow_pickle=False) as file:
            return dict(file)

    first = found()
    assert sorted(first) == ["ep_lengths", "results", "timesteps"]
    assert first["timesteps"].tolist() == [0, 128]
    assert first["results"].shape == first["ep_lengths"].shape == (2, 4)
    short = round(3.0 / 0.01)  # the mixture's second
    assert (first["results"] < 0.0).all() and (first["ep_lengths"][:, 1] == short).all()
    assert (first["ep_lengths"][:, 0] > short).all()
    Trainer(TASK, 256, folder, resume=True, run_options=RunOptions(eval_freq=128)).train()
    assert found()["timesteps"].tolist() == [0, 128, 256]
    assert np.array_equal(found()["results"][:2], first["results"])


def test_another_folder_gets_none_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer, "_SCALING_ENVS", 8)
    Trainer(TrainingTask(num_envs=4, n_eval_envs=2), 64, tmp_path / "plain").train()
    assert not list((tmp_path / "plain").glob("sideslip*"))
    assert not (tmp_path / "plain" / EVALUATIONS).exists()


def test_an_algorithm_of_ours_alone_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rl-baselines3-zoo has no gradient"):
        _choose_folder(TrainingTask(algo="gradient"), "", None, tmp_path)
