"""The grip limit: no controller asks for more than its share of what friction gives."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.agents.helpers import observe
from tests.envs.helpers import bits

YAW, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"
CONTROLLERS = ("two-dof", "esc", "sliding-mode", "lqr", "mpc", "model-following")
LOAD = COMS.mass * 9.81 / (2.0 * COMS.wheelbase)  # N of a tyre for a metre of the other axle's arm


def made(name: str, friction: bool = False, **options: Any) -> tuple[Any, Any]:
    """(env, agent); friction: the observation has the true one."""
    env_id = AFS if name == "model-following" else YAW
    env: Any = EstimateObservation(gym.make(env_id), "dakf", outputs=["beta", "gamma", "d1", "d2"])
    if friction:
        env = TruthObservation(env, ["friction"])
    return env, make_agent(name, env, **options)


def harsh(env: Any, beta: float = 0.3, **more: float) -> np.ndarray:
    """An observation of a car that slides."""
    return observe(env, beta_hat=beta, **more)


def most(friction: float, grip: float) -> float:
    """The share of full scale by which both rear tyres push with `grip` of their friction."""
    force = grip * friction * LOAD * COMS.front_arm
    return min(force * COMS.rear_track / COMS.yaw_moment_limit, 1.0)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_moment_stays_within_the_share_of_friction(name: str) -> None:
    """Of the nominal car's, or of the true one where the observation has it."""
    env, agent = made(name, grip=0.1)
    for sign in (-1.0, 1.0):
        action, _ = agent.predict(harsh(env, 0.3 * sign))
        assert abs(action[0]) == pytest.approx(most(COMS.friction, 0.1), rel=1e-3)
    env, agent = made(name, friction=True, grip=0.1)
    for friction in (0.05, 0.3, 0.9):
        action, _ = agent.predict(harsh(env, true_friction=friction))
        assert abs(action[0]) == pytest.approx(most(friction, 0.1), rel=1e-3)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_limit_that_is_not_met_changes_nothing(name: str) -> None:
    (env, without), (_, limited) = made(name), made(name, grip=0.5)
    calm = harsh(env, beta=1e-4, beta_ref=1e-5, steer_command=1e-4)
    assert bits(without.predict(calm)[0]) == bits(limited.predict(calm)[0])


def test_integrals_stop_at_the_grip_limit() -> None:
    env, agent = made("two-dof", grip=0.1)
    state: Any = None
    for _ in range(100):
        _, state = agent.predict(harsh(env, 0.2), state)
    assert abs(state[0, 0]) < 1e-9


def test_no_steering_is_added_that_only_slides_the_front_tyres() -> None:
    env = TruthObservation(EstimateObservation(gym.make(AFS), "exact-kf"), ["friction"])
    names = [entry.name for entry in env.layout]
    agent = make_agent("lqr", env, grip=0.7)
    for friction in (0.05, 0.3, 0.9):
        for beta, gamma, driver in ((0.3, 0.0, 0.0), (0.05, 1.0, 0.02), (-0.1, 0.5, 0.1)):
            obs = harsh(env, beta, gamma_hat=gamma, steer_command=driver, true_friction=friction)
            state = None
            for _ in range(20):  # as far as its rate limit lets it
                action, state = agent.predict(obs, state)
            beta, gamma, driver = (
                float(obs[names.index(name)]) for name in ("beta_hat", "gamma_hat", "steer_command")
            )
            slip = driver + 0.1 * action[1] - beta - COMS.front_arm * gamma / 7.0
            limit = 3.0 * friction * LOAD * COMS.rear_arm / COMS.front_stiffness
            undriven = driver - beta - COMS.front_arm * gamma / 7.0
            assert abs(slip) <= limit + 1e-6 or abs(slip) <= abs(undriven) + 1e-6


@pytest.mark.parametrize("name", ["two-dof", "esc", "lqr"])
def test_no_more_is_asked_than_the_motors_power_gives(name: str) -> None:
    """P / omega of a wheel at the measured speed: an integral does not wind up beyond it."""
    strong = {"base": "coms", "motor_power": 2000.0}
    env = EstimateObservation(gym.make(YAW, vehicle=strong), "exact-kf")
    action, _ = make_agent(name, env).predict(harsh(env))
    torque = 2000.0 * COMS.wheel_radius / 7.0
    assert abs(action[0]) == pytest.approx(torque / COMS.motor_torque, rel=1e-4)
