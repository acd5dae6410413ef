"""A training begins with the weights of a zip: ours, or a foreign one with its VecNormalize."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sideslip.agents.training import trainer
from sideslip.agents.training.callbacks import BEST, RunOptions
from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.normalise import CLIP
from sideslip.agents.vec_env import make_vec_env

SHORT: dict[str, Any] = {"scenario": {"base": "sine-with-dwell", "duration": 0.3}}
TASK = TrainingTask(num_envs=4, env_options=SHORT, n_eval_envs=4)


def observations() -> Any:
    env = TASK.vector_env(4)
    obs, _ = env.reset(seed=1)
    return np.concatenate([obs, env.step(np.full((4, 1), 0.5))[0]])


def begun(tmp_path: Path, zipped: Path, trust: bool = False) -> Any:
    """The model before its first step."""
    place = tmp_path / "new"
    place.mkdir()
    return trainer.EvalCallback(TASK, place, None, RunOptions()).build(zipped, trust)


def foreign(path: Path, normalised: bool, **options: Any) -> Any:
    """A zip as rl-baselines3-zoo leaves it, and what acts in it."""
    env: Any = make_vec_env(TASK.env_id, 2, env_kwargs=SHORT)
    if normalised:
        env = VecNormalize(env)
    model = PPO("MlpPolicy", env, device="cpu", seed=1, n_steps=32, batch_size=64, **options)
    model.learn(64)
    model.save(path)
    if normalised:
        env.save(path.with_name("vecnormalize.pkl"))
    return lambda x: model.predict(env.normalize_obs(x) if normalised else x, deterministic=True)[0]


def test_our_zip_goes_on_as_it_was(tmp_path: Path) -> None:
    first = trainer.train(TASK, 128, tmp_path / "first").model
    model = begun(tmp_path, tmp_path / "first" / BEST)
    assert model.num_timesteps == 0
    one, other = first.policy.state_dict(), model.policy.state_dict()
    best = PPO.load(tmp_path / "first" / BEST, device="cpu").policy.state_dict()
    assert one.keys() == other.keys()
    assert all(torch.equal(best[name], other[name]) for name in best)
    assert float(other["features_extractor.clip"]) == CLIP
    done = trainer.train(TASK, 128, tmp_path / "on", trained_agent=tmp_path / "first" / BEST)
    assert done.model.num_timesteps == 128
    again = trainer.train(TASK, 256, tmp_path / "on", resume=True)  # the scaling is the zip's still
    assert torch.equal(
        again.model.policy.state_dict()["features_extractor.mean"], other["features_extractor.mean"]
    )


@pytest.mark.parametrize("normalised", [True, False])
def test_a_zip_from_elsewhere_acts_as_it_did(normalised: bool, tmp_path: Path) -> None:
    acts = foreign(tmp_path / "model.zip", normalised)
    model = begun(tmp_path, tmp_path / "model.zip", trust=True)
    x = observations()
    assert np.ptp(acts(x)) > 1e-4
    if normalised:  # what hardly varied in training is not read, as in an export
        scale = model.policy.state_dict()["features_extractor.scale"].numpy()
        x[:, scale == 0.0] = model.policy.state_dict()["features_extractor.mean"].numpy()[
            scale == 0.0
        ]
    assert model.predict(x, deterministic=True)[0] == pytest.approx(acts(x), abs=1e-6)
