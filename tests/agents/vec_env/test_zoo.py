"""stable-baselines3 and rl-zoo as their users call them, around the single environment."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.estimators import EstimateObservation

pytest.importorskip("stable_baselines3")
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

VISION, FUSION = "sideslip/YawVision-v0", "sideslip/YawFusion-v0"
SHORT: dict[str, Any] = {"base": "random-steering", "duration": 0.25}
NAME = "sideslip.estimators.EstimateObservation"

WORKERS = """
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
import numpy
from sideslip.agents.vec_env import make_vec_env as make_ours
from sideslip.estimators import EstimateObservation

NAME, SHORT = "sideslip/YawVision-v0", {"base": "random-steering", "duration": 0.25}

def drive(env):
    rows = [env.reset()]
    for k in range(60):
        obs, rewards, dones, infos = env.step(numpy.full((2, 1), 0.03 * k - 1.0, "f"))
        rows += [obs, numpy.asarray(rewards, "f"), dones]
        rows += [info["terminal_observation"] for info in infos if "terminal_observation" in info]
    env.close()
    return [row.tobytes() for row in rows]

if __name__ == "__main__":
    theirs = make_vec_env(
        "sideslip:" + NAME, 2, 5, wrapper_class=EstimateObservation,
        env_kwargs={"scenario": SHORT}, wrapper_kwargs={"outputs": ["beta"]},
        vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "spawn"},
    )
    ours = make_ours(NAME, 2, 5, {"outputs": ["beta"]}, {"scenario": SHORT}, scaled=False)
    assert drive(theirs) == drive(ours)
    print("the same everywhere")
"""


def wrapper_of(wish: Any) -> Any:
    """What rl_zoo3.utils.get_wrapper_class makes of `env_wrapper`: names, or {name: arguments}."""
    chosen = []
    for each in wish if isinstance(wish, list) else [wish]:
        name, arguments = next(iter(each.items())) if isinstance(each, dict) else (each, {})
        module, _, kind = name.rpartition(".")
        chosen.append((getattr(importlib.import_module(module), kind), arguments))

    def wrap(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        for kind, arguments in chosen:
            env = kind(env, **arguments)
        return env

    return wrap


@pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
@pytest.mark.parametrize("name", [VISION, FUSION])
@pytest.mark.parametrize(
    "wish",
    [
        NAME,
        {NAME: {"estimator": "exact-kf", "outputs": ["beta", "F_d"], "std": False}},
        [{NAME: {"estimator": "exact-kf", "name": "a"}}, {NAME: {"name": "b"}}],
    ],
    ids=["by name", "with arguments", "a list"],
)
def test_rl_zoos_env_wrapper_estimates(name: str, wish: Any) -> None:
    """`make_vec_env` puts its Monitor inside, which must change nothing."""
    env: Any = make_vec_env(name, 2, seed=4, wrapper_class=wrapper_of(wish))
    alone = wrapper_of(wish)(gym.make(name))
    assert env.observation_space == alone.observation_space
    first = env.reset()
    assert first[1].tobytes() == alone.reset(seed=5)[0].tobytes()
    for k in range(40):
        action = np.full(alone.action_space.shape, 0.05 * k - 1.0, np.float32)
        obs, _, _, infos = env.step(np.stack([action, action]))
        wanted = alone.step(action)
        assert obs[1].tobytes() == wanted[0].tobytes()
        assert wanted[4].items() <= infos[1].items()


def test_monitor_keeps_words_of_the_info(tmp_path: Path) -> None:
    env = Monitor(
        EstimateObservation(gym.make(VISION, scenario=SHORT)),
        str(tmp_path / "drive"),
        info_keywords=("cost", "failure", "is_success", "beta_hat", "nees"),
    )
    env.reset(seed=0)
    over = False
    info: dict[str, Any] = {}
    while not over:
        *_, terminated, truncated, info = env.step(np.zeros(1, np.float32))
        over = terminated or truncated
    env.close()
    assert info["episode"]["is_success"] is True and info["episode"]["cost"] == info["cost"]
    header, row = (tmp_path / "drive.monitor.csv").read_text().splitlines()[1:]
    assert header == "r,l,t,cost,failure,is_success,beta_hat,nees"
    assert row.split(",")[1] == "25" and row.split(",")[4:6] == ["0", "True"]


@pytest.mark.long
def test_worker_processes_equal_the_bridge(tmp_path: Path) -> None:
    path = tmp_path / "script.py"
    path.write_text(WORKERS)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, str(path)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "the same everywhere"
