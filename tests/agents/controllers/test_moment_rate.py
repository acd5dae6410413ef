"""The yaw moment's rate in the designs: the env's own cost, LQR, MPC and nonlinear MPC agree."""

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import Lqr, Mpc, make_agent
from sideslip.agents.design.sampled_model import SPEEDS, DesignSpec, make_design_model
from sideslip.agents.rollout import evaluate_episodes
from sideslip.envs import COMS
from sideslip.envs.task import MODEL
from sideslip.estimators.vector.estimate import TruthObservation as VectorTruth
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.agents.controllers.test_lqr import SMALL
from tests.agents.helpers import observe

YAW, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"
RATE = {"moment_rate": 0.00025}
STATES = ("beta", "gamma", "F_d", "N_d")
V = SPEEDS[18]


@pytest.mark.parametrize("steers", [False, True])
def test_a_slight_weight_changes_the_gains_slightly(steers: bool) -> None:
    spec = DesignSpec(10, COMS.yaw_moment_limit, steers, MODEL, "rates")
    free = make_design_model(COMS, 7.0, spec).solve()[0]
    slight = make_design_model(COMS, 7.0, dataclasses.replace(spec, moment_rate=1e-12)).solve()[0]
    np.testing.assert_allclose(slight[:, :-2], free, 1e-4, 1e-4)


def made(env_id: str, **options: Any) -> Any:
    """An env of the true state, of a linear car."""
    env = gym.make(env_id, scenario=SMALL, world=RATE, reference="model", **options)
    return TruthObservation(env, ["friction"], STATES)


@pytest.mark.parametrize("env_id", [YAW, AFS])
def test_all_three_ask_for_the_same_and_remember_it(env_id: str) -> None:
    """Where nothing is limited: over three decisions, each with the memory of those before."""
    env = made(env_id)
    lqr, mpc = (make_agent(name, env, disturbance_time=0.3) for name in ("lqr", "mpc"))
    slow = make_agent("lqr", env, steer_weight=10.0)
    nmpc = make_agent("nmpc", env, horizon=0.5)
    assert isinstance(lqr, Lqr) and isinstance(mpc, Mpc)
    memories: list[Any] = [None] * 4
    for beta in (3e-4, -1e-4, 2e-4):
        obs, actions = observe(env, V, true_friction=0.9, beta_hat=beta), []
        for i, agent in enumerate((lqr, mpc, slow, nmpc)):
            action, memories[i] = agent.predict(obs, memories[i])
            actions.append(action)
        size = np.abs(actions[0]).max()
        if env_id == YAW:  # the steering's rate limits MPC, and LQR by no plan
            assert np.abs(actions[1] - actions[0]).max() < 0.05 * size
        assert np.abs(actions[3] - actions[2]).max() < 0.05 * np.abs(actions[2]).max()
    plain = TruthObservation(gym.make(env_id, scenario=SMALL), ["friction"], STATES)
    free = make_agent("lqr", plain)
    assert abs(free.predict(obs)[0][0]) > 2.0 * abs(actions[0][0])


def test_a_command_that_is_not_its_own_is_remembered() -> None:
    agent = make_agent("lqr", made(AFS))
    assert isinstance(agent, Lqr) and agent.memory == 3
    memory = np.zeros((1, 3))
    agent.record_action(memory, np.array([[0.25, 0.5]], np.float32))
    assert memory == pytest.approx(np.array([[0.5 * agent.authority, 0.0, 0.25]]))


@pytest.mark.parametrize("name", ["lqr", "nmpc"])
def test_who_designs_it_pays_less(name: str) -> None:
    """Against the same controller that does not know of it, on a car that gusts push."""
    scenario, world = SMALL | {"disturbance_force": 100.0, "duration": 3.0}, RATE | {"gust": 0.3}
    costs = []
    for told in (world, world | {"moment_rate": 0.0}):
        env: Any = gym.make_vec(YAW, num_envs=8, scenario=scenario, world=world, reference="model")
        other = gym.make(YAW, scenario=scenario, world=told, reference="model")
        agent = make_agent(name, TruthObservation(other, ["friction"], STATES))
        costs.append(evaluate_episodes(VectorTruth(env, ["friction"], STATES), agent, range(8))[0])
    assert (costs[0] < 0.95 * costs[1]).all()
