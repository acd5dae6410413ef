"""Learned policies: torch's numbers without torch, read by name, refused where they do not fit."""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import PolicyController, make_agent
from sideslip.agents.learned.network import Network
from sideslip.agents.learned.policy import Card, Policy, save_policy
from sideslip.estimators import EstimateObservation

VISION, FUSION, STEERING = (
    f"sideslip/{name}-v0" for name in ("YawVision", "YawFusion", "AfsYawFusion")
)


def a_policy(card: Card, width: int = 1, scale: float = 1.0) -> Policy:
    rng = np.random.default_rng(0)
    sizes = (len(card.observation), 16, width)
    weights = [rng.normal(size=(b, a)) / a**0.5 for a, b in pairwise(sizes)]
    biases = [rng.normal(size=size) for size in sizes[1:]]
    network = Network(rng.normal(size=sizes[0]), np.full(sizes[0], scale), weights, biases)
    return Policy("mine", network, card)


@pytest.fixture(scope="module")
def policy() -> Policy:
    return a_policy(Card.from_env_id(VISION))


def named(env: Any, values: dict[str, float]) -> np.ndarray:
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    return np.array([values.get(name, 7.0) for name in names], np.float32)


def test_a_row_is_its_single_observation_to_rounding(policy: Policy) -> None:
    """And whatever the batch around it; the rounding is double precision's."""
    agent = PolicyController(gym.make(VISION), policy)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(300, policy.network.inputs)).astype(np.float32)
    together = agent.network(x.astype(np.float64))
    for n in (1, 2, 7, 256):
        some = agent.network(x[:n].astype(np.float64))
        assert np.abs(some - together[:n]).max() < 1e-14
    batch, state = agent.predict(x)
    for i in (0, 17, 299):
        alone, _ = agent.predict(x[i])
        assert alone.shape == (1,) and alone.dtype == np.float32
        assert alone == pytest.approx(batch[i], abs=1e-7)
    assert state.shape == (300, 0)


def test_entries_are_read_by_name_from_a_wider_observation(policy: Policy) -> None:
    """YawFusion's observation holds all of YawVision's, and the GPS."""
    narrow, wide, steering = (gym.make(each) for each in (VISION, FUSION, STEERING))
    rng = np.random.default_rng(4)
    values = {name: float(rng.normal()) for name, _ in policy.card.observation}
    action, _ = PolicyController(narrow, policy).predict(named(narrow, values))
    assert np.array_equal(PolicyController(wide, policy).predict(named(wide, values))[0], action)
    steered, _ = PolicyController(steering, policy).predict(named(steering, values))
    assert steered[0] == action[0] and steered[1] == 0.0


def test_an_entry_that_never_varied_is_not_read(policy: Policy) -> None:
    scale = np.ones(policy.network.inputs)
    names = [name for name, _ in policy.card.observation]
    scale[names.index("beta_ref")] = 0.0
    agent = PolicyController(
        gym.make(VISION), replace(policy, network=replace(policy.network, scale=scale))
    )
    assert set(names) - set(agent.needs) == {"beta_ref"}
    x = np.random.default_rng(5).normal(size=len(names))
    whole = replace(policy.network, scale=scale)(x[None])
    assert agent.predict(x.astype(np.float32))[0] == pytest.approx(np.clip(whole[0], -1, 1), 1e-5)
    x[names.index("beta_ref")] = np.nan
    assert np.isfinite(agent.predict(x.astype(np.float32))[0]).all()


def test_a_policy_of_an_estimate_needs_it() -> None:
    options: dict[str, Any] = {"outputs": ["beta", "gamma"], "std": False}
    card = Card.from_env_id(VISION, {}, "multirate-kf", options)
    assert card.observation[-2:] == (("beta_hat", "rad"), ("gamma_hat", "rad/s"))
    policy = a_policy(card)
    with pytest.raises(ValueError, match=r"needs beta_hat, gamma_hat .*EstimateObservation"):
        PolicyController(gym.make(VISION), policy)
    env = EstimateObservation(gym.make(VISION), "multirate-kf", **options)
    assert PolicyController(env, policy).needs[-1] == "gamma_hat"


def test_a_vector_env_takes_it_too(policy: Policy) -> None:
    env = gym.make_vec(FUSION, num_envs=3)
    obs, _ = env.reset(seed=0)
    action, _ = PolicyController(env, policy).predict(obs)
    assert env.action_space.contains(action)


def test_an_env_that_does_not_fit_is_refused(policy: Policy) -> None:
    layouts = r"needs camera_psi, .* mine was trained on gyro, .*camera_psi.*; here are gyro, .*gps"
    with pytest.raises(ValueError, match=layouts):
        PolicyController(gym.make("sideslip/YawGps-v0"), policy)
    with pytest.raises(ValueError, match=r"mine was trained with .* of 10 ticks, this env has 5"):
        PolicyController(gym.make(VISION, control_period=5), policy)
    with pytest.raises(ValueError, match="gives 2 numbers, the env's action has 1"):
        PolicyController(gym.make(VISION), a_policy(policy.card, width=2))
    entries = (("gyro", "deg/s"), *policy.card.observation[1:])
    with pytest.raises(ValueError, match=r"trained on gyro in deg/s \(here rad/s\)"):
        PolicyController(
            gym.make(VISION), replace(policy, card=replace(policy.card, observation=entries))
        )
    with pytest.raises(TypeError, match="speed"):
        make_agent("learned", gym.make(VISION), speed=1)


def test_make_agent_takes_a_path(policy: Policy, tmp_path: Any) -> None:
    path = tmp_path / "mine.safetensors"
    save_policy(path, policy.network, policy.card)
    env = gym.make(VISION)
    obs, _ = env.reset(seed=0)
    action, _ = PolicyController(env, policy).predict(obs)
    for agent in (make_agent(str(path), env), make_agent("learned", env, policy=path)):
        assert np.array_equal(agent.predict(obs)[0], action)


def test_no_torch_is_loaded(policy: Policy, tmp_path: Any) -> None:
    path = tmp_path / "mine.safetensors"
    save_policy(path, policy.network, policy.card)
    code = (
        "import sys, gymnasium as gym, sideslip\n"
        f"env = gym.make({VISION!r})\n"
        "agent = sideslip.make_agent(sys.argv[1], env)\n"
        "print(agent.predict(env.reset(seed=0)[0])[0].shape)\n"
        "print({'torch', 'stable_baselines3'} & set(sys.modules))\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    env = os.environ | {"PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.stdout.split("\n")[:2] == ["(1,)", "set()"], done.stderr
