"""Wrappers around stable-baselines3's kind of env, and within it: transparent, or refused."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector

from sideslip.agents import make_agent

pytest.importorskip("stable_baselines3")
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from sideslip.agents.training.normalise import RewardScale, RewardScaleWrapper
from sideslip.agents.vec_env import make_vec_env

VISION = "sideslip/YawVision-v0"


def within(wrapper: Any) -> Any:
    """A bridged vector env with a wrapper of Gymnasium's inside of the bridge."""
    return make_vec_env(VISION, 2, 0, wrapper_class=wrapper)


def test_a_controller_is_not_designed_on_changed_observations(tmp_path: Path) -> None:
    env, single = make_vec_env(VISION, 2, 0), DummyVecEnv([lambda: Monitor(gym.make(VISION))])
    rated = RewardScaleWrapper(env, RewardScale([[1.0, 1.0]]))
    drawn = make_vec_env(VISION, 2, 0, env_kwargs={"render_mode": "rgb_array"})
    film = VecVideoRecorder(drawn, str(tmp_path), lambda _: False)
    rewards = VecNormalize(env, norm_obs=False)
    for same in (env, single, rated, film, rewards, VecCheckNan(env), VecMonitor(env)):
        assert make_agent("none", same).nominal == env.get_attr("nominal")[0]
    assert make_agent("none", within(vector.NormalizeReward)).control_period == 10
    changed: Any = VecNormalize(env), VecFrameStack(env, 2), within(vector.ClipAction)
    changed += (DummyVecEnv([lambda: wrappers.NormalizeObservation(gym.make(VISION))]),)
    names = "VecNormalize", "VecFrameStack", "ClipAction", "NormalizeObservation"
    for name, each in zip(names, changed, strict=True):
        with pytest.raises(ValueError, match=f"^{name} may change observations or actions"):
            make_agent("none", each)
