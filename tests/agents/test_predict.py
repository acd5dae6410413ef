"""One contract over every agent: stable-baselines3's predict."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

import sideslip
from sideslip.agents import AGENTS, make_agent
from sideslip.estimators import EstimateObservation
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.agents.helpers import observe
from tests.envs.helpers import bits
from tests.policies import VISION

PARAMETERS = ["front_stiffness", "rear_stiffness", "friction"]
STATES = ["beta", "gamma", "d1", "d2"]


@pytest.fixture
def env() -> gym.Env[Any, Any]:
    bare = gym.make("sideslip/YawVision-v0", scenario="lane-change")
    return EstimateObservation(bare, "bicycle-kf")


NAMES = [VISION if name == "learned" else name for name in AGENTS]


@pytest.fixture
def steered() -> gym.Env[Any, Any]:
    """An env with all that any agent needs, whose action steers."""
    env = gym.make("sideslip/AfsYawFusion-v0", scenario="lane-change")
    camera = EstimateObservation(env, "multirate-kf", outputs=["psi", "y_l"])
    tyres = EstimateObservation(camera, "joint", outputs=["front_tyres", "rear_tyres"])
    return TruthObservation(EstimateObservation(tyres, "dakf", outputs=STATES), PARAMETERS)


@pytest.mark.parametrize("name", NAMES)
def test_single_and_batch_agree_with_memory_outside(name: str, steered: gym.Env[Any, Any]) -> None:
    env, agent = steered, make_agent(name, steered)
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(15, 3, env.observation_space.shape[0])).astype(np.float32)  # type: ignore[index]
    observations[5, 1] = np.nan  # this row alone, and without an effect later
    together: Any = None
    alone: list[Any] = [None] * 3
    for obs in observations:
        before = None if together is None else together.copy()
        actions, after = agent.predict(obs, together)
        again, _ = agent.predict(obs, before)
        assert bits(actions) == bits(again)
        together = after
        for i in range(3):
            action, alone[i] = agent.predict(obs[i], alone[i])
            assert action.shape == (2,) and bits(action) == bits(actions[i])
            broken = agent.needs and np.isnan(obs[i]).any()
            assert np.isnan(action).all() if broken else env.action_space.contains(action)


@pytest.mark.parametrize("name", NAMES)
def test_a_nan_that_is_read_comes_out_as_nan(name: str, steered: gym.Env[Any, Any]) -> None:
    """Entry by entry; what a controller does not read does not disturb it."""
    agent = make_agent(name, steered)
    names = [entry.name for entry in steered.get_wrapper_attr("layout")]
    for i, entry in enumerate(names):
        obs = np.zeros(len(names), np.float32)
        obs[i] = np.nan
        action, _ = agent.predict(obs)
        assert np.isnan(action).all() == np.isnan(action).any() == (entry in agent.needs)


def test_episode_start_clears_the_memory(env: gym.Env[Any, Any]) -> None:
    agent = make_agent("two-dof", env)
    obs = np.stack([observe(env, beta_hat=0.001)] * 2)
    _, state = agent.predict(obs)
    _, state = agent.predict(obs, state)
    fresh, _ = agent.predict(obs)
    action, _ = agent.predict(obs, state, episode_start=np.array([True, False]))
    assert action[0] == fresh[0] and action[1] != fresh[1]


@pytest.mark.parametrize("name", NAMES)
def test_stable_baselines3_evaluates_them(name: str, steered: gym.Env[Any, Any]) -> None:
    agent: Any = make_agent(name, steered)
    reward, _ = evaluate_policy(agent, DummyVecEnv([lambda: steered]), 1, warn=False)
    assert np.isfinite(reward) and float(np.mean(reward)) < 0.0


def test_rollout_and_evaluate_policy_agree(env: gym.Env[Any, Any]) -> None:
    agent: Any = make_agent("two-dof", env)
    vec = DummyVecEnv([lambda: env])
    vec.seed(3)
    reward, _ = evaluate_policy(agent, vec, 1, warn=False)
    assert -sideslip.rollout(env, agent, seed=3).cost == pytest.approx(reward, rel=1e-6)


def test_moment_controllers_leave_the_steering_alone(steered: gym.Env[Any, Any]) -> None:
    rng = np.random.default_rng(1)
    obs = rng.normal(size=steered.observation_space.shape).astype(np.float32)
    for name in ("none", "feedforward", "two-dof"):
        action, _ = make_agent(name, steered).predict(obs)
        assert action[1] == 0.0
        assert (action[0] == 0.0) == (name == "none")


def test_an_observation_of_another_width_is_refused(env: gym.Env[Any, Any]) -> None:
    with pytest.raises(ValueError, match="width"):
        make_agent("none", env).predict(np.zeros(3, np.float32))
