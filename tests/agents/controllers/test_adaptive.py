"""Adaptive controllers: they are what they are told of the tyres, and win by it."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.baselines import make_noise_options
from sideslip.agents.controllers.lqr import IN, INVERSE_FRICTION, TYRES, make_design_state
from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.run import Chunk, run_chunk
from sideslip.benchmarks.control.tasks import STEERING, ControlTask
from sideslip.envs import make_scenario
from sideslip.estimators import EstimateObservation
from sideslip.estimators.vector import EstimateObservation as Vector
from tests.agents.helpers import compute_gains

STEERED = ControlTask("", STEERING, "passenger-car", "lagged", "car-slalom")


def env_of(cars: int | None = None, friction: float = 0.3) -> Any:
    options = make_noise_options(make_scenario("car-slalom")) | {"slow": ["camera", "gps"]}
    outputs = ["beta", "gamma", "F_d", "N_d", "front_tyres", "rear_tyres"]
    if friction:
        options["inverse_friction_sd"] = friction
        outputs.append("inverse_friction")
    made = STEERED.env_options
    if cars is None:
        env: Any = gym.make(STEERING, **made)
        return EstimateObservation(env, "joint", outputs=outputs, std=False, options=options)
    env = gym.make_vec(STEERING, num_envs=cars, **made)
    return Vector(env, "joint", outputs=outputs, std=False, options=options)


def changed(env: Any, obs: Any, **values: float) -> Any:
    names, obs = [entry.name for entry in env.get_wrapper_attr("layout")], obs.copy()
    for name, value in values.items():
        obs[names.index(name)] = value
    return obs


@pytest.mark.parametrize("front, rear", [(0.7, 1.2), (1.0, 1.0)])
def test_the_gains_are_those_of_the_stiffness_estimated(front: float, rear: float) -> None:
    env = env_of(friction=0.0)
    agent: Any = make_agent("adaptive-lqr", env, grip=None, knots=5)
    obs, _ = env.reset(seed=0)
    small = {"beta_hat": 1e-4, "gamma_hat": 2e-4, "F_d_hat": 0.0, "N_d_hat": 0.0}
    obs = changed(env, obs, **small, **dict(zip(TYRES, (front, rear), strict=True)))
    action, _ = agent.predict(obs)
    x = obs[agent._columns].astype(float)
    z = np.empty(len(agent.design_spec.states))
    make_design_state(x, agent.share, z)
    car = agent.vehicle
    speed = 0.5 * (x[IN.wheel_left] + x[IN.wheel_right])
    K = compute_gains(agent, speed, front * car.front_stiffness, rear * car.rear_stiffness)
    u, w = -K @ z
    assert action == pytest.approx([u, w / agent.authority], rel=1e-4, abs=1e-7)


def test_the_grip_follows_the_friction_estimated() -> None:
    env = env_of()
    agent: Any = make_agent("adaptive-lqr", env, grip=0.5, knots=2)
    obs, _ = env.reset(seed=0)
    pushes = [
        abs(agent.predict(changed(env, obs, beta_hat=0.5, **{INVERSE_FRICTION: w}))[0][0])
        for w in (1.25, 2.5, 1e3)
    ]
    assert pushes[0] == pytest.approx(2.0 * pushes[1], rel=1e-4)
    assert pushes[1] == pytest.approx(2.0 * pushes[2], rel=1e-4)  # of 0.2, the least believed


@pytest.mark.parametrize("name", ["adaptive-lqr", "adaptive-nmpc"])
def test_one_car_and_many_decide_alike(name: str) -> None:
    many, one = env_of(2), env_of()
    agents = make_agent(name, many, knots=2), make_agent(name, one, knots=2)
    obs, _ = many.reset(seed=[3, 4])
    single, _ = one.reset(seed=4)
    state: list[Any] = [None, None]
    for _ in range(20):
        action, state[0] = agents[0].predict(obs, state[0])
        alone, state[1] = agents[1].predict(single, state[1])
        np.testing.assert_array_equal(action[1], alone)
        obs = many.step(action)[0]
        single = one.step(alone)[0]


@pytest.mark.long
def test_knowing_its_tyres_is_worth_a_third_of_the_cost() -> None:
    seeds = tuple(range(700, 705))
    costs = [
        run_chunk(Chunk(STEERED, Entry(who, estimator), seeds)).costs
        for estimator, who in (("", "nominal"), ("joint", "adaptive-lqr"))
    ]
    assert np.mean(np.log(costs[0] / costs[1])) > 0.4
