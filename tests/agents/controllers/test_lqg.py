"""LQG: what the env's own cost is on average, against the value that theory gives.

On the small-angle plant with linear tyres the exact Kalman filter's estimate is orthogonal to its
error, so that under u = -K x_hat the covariance of the state is that of the estimate plus the
Riccati recursion's P, and the mean cost of an episode is a sum over its ticks. Plant, sensors,
noise, filter, controller and cost must all be right for the env to agree.
"""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import norm

from sideslip.agents import Lqr, make_agent
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.vehicle.linear import LinearModel, make_bicycle_model
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import compute_gains
from tests.estimators.riccati import riccati

V, STEPS, PERIOD = 7.0, 200, 10
LEVELS = {"force_sd": 15.0, "moment_sd": 6.0, "disturbance_time": 0.3, "gyro_noise": 0.002}
CAR = {"base": "coms", "motor_lag": 0.0, "steering_lag": 0.0}
SCENARIO = {
    "name": "lqg", "duration": STEPS * PERIOD * TICK, "speed": V, "small_angle": True,
    "tyres": "linear", "roll": False, "disturbance_force": LEVELS["force_sd"],
    "disturbance_moment": LEVELS["moment_sd"],
    "noise": {"wheel": 0.0, "gyro": LEVELS["gyro_noise"]},
}  # fmt: skip
KNOWN = dict.fromkeys(("beta", "gamma", "psi", "y_l"), 0.0)  # where the car starts


def make_env(**noise: float) -> Any:
    """The env, with other noise than the filter is told if asked for."""
    scenario = SCENARIO | {"noise": {**SCENARIO["noise"], **noise}}  # type: ignore[dict-item]
    env = gym.make("sideslip/YawVision-v0", scenario=scenario, vehicle=CAR, reference="model")
    outputs = ["beta", "gamma", "F_d", "N_d"]
    options: dict[str, Any] = {**LEVELS, "prior": KNOWN}
    return EstimateObservation(env, "exact-kf", outputs=outputs, std=False, options=options)


def gains_of(env: Any) -> np.ndarray:
    """K (1, 4) on beta, gamma, F_d and N_d; without lag the delivered moment has no column."""
    agent = make_agent("lqr", env)
    assert isinstance(agent, Lqr)
    K = compute_gains(agent, V)
    assert np.abs(K[:, 2]).max() < 1e-9
    return K[:, [0, 1, 7, 8]]


def mean_cost(env: Any, K: np.ndarray, first: int = 0) -> float:
    """The expectation of J under u = -K x_hat, u the share of the full yaw moment.

    first: the step from which on cost counts.
    """
    vehicle, sensors = env.unwrapped.vehicle, env.unwrapped.slow_sensors
    model = make_bicycle_model(vehicle, V)
    push = np.diag([1.0 / (vehicle.mass * V), 1.0 / vehicle.yaw_inertia])
    B = np.hstack([model.B[:, 1:] * vehicle.yaw_moment_limit, push])
    plane, inputs = LinearModel(model.A, B, np.eye(2), ("beta", "gamma"), (), ()).discretise(TICK)
    keep = math.exp(-TICK / LEVELS["disturbance_time"])
    F, H = np.eye(4), np.zeros((4, 1))
    F[:2, :2], F[:2, 2:], H[:2] = plane, inputs[:, 1:], inputs[:, :1]
    F[2, 2] = F[3, 3] = keep
    stationary = np.diag([0.0, 0.0, LEVELS["force_sd"] ** 2, LEVELS["moment_sd"] ** 2])
    W = (1.0 - keep**2) * stationary
    weights = np.diag([0.02**-2, 0.1**-2, 0.0, 0.0])
    P, names = riccati(
        vehicle, sensors=sensors, speed=V, seconds=STEPS * PERIOD * TICK + TICK, **LEVELS
    )
    rows = [names.index(name) for name in ("beta", "gamma", "F_d", "N_d")]
    P = P[:, rows][:, :, rows]
    S, J = stationary, 0.0  # covariance of the state
    for k in range(0, STEPS * PERIOD, PERIOD):
        X = S - P[k]  # of the estimate
        effort = 0.01 * float((K @ X @ K.T)[0, 0])
        known, unknown, noise = np.eye(4), P[k], np.zeros((4, 4))
        for _ in range(PERIOD):  # x = known x_hat + error + noise
            known = F @ known - H @ K
            unknown, noise = F @ unknown @ F.T, F @ noise @ F.T + W
            S = known @ X @ known.T + unknown + noise
            if k >= first * PERIOD:
                J += TICK * (float(np.trace(weights @ S)) + effort)
    return J


def drive(env: Any, episodes: int) -> np.ndarray:
    """J of each episode under `lqr`; nothing saturates."""
    agent, costs = make_agent("lqr", env), []
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        J, over = 0.0, False
        while not over:
            action, _ = agent.predict(obs)
            assert abs(action[0]) < 1.0
            obs, reward, terminated, truncated, _ = env.step(action)
            J, over = J - reward, terminated or truncated
        costs.append(J)
    return np.array(costs)


def deviation(costs: np.ndarray, value: float) -> float:
    """How far the mean is from a value, in standard errors."""
    return float((costs.mean() - value) / (costs.std(ddof=1) / math.sqrt(len(costs))))


QUANTILE = float(norm.ppf(0.995))  # of a 99 % interval


@pytest.mark.long
def test_monte_carlo_cost_is_the_riccati_value() -> None:
    env = make_env()
    K, costs = gains_of(env), drive(env, 400)
    assert abs(deviation(costs, mean_cost(env, K))) < QUANTILE
    # the interval is narrow enough to refuse a controller that is not the one that drove
    assert abs(deviation(costs, mean_cost(env, 0.2 * K))) > 2.0 * QUANTILE


@pytest.mark.long
def test_a_noise_that_the_filter_was_not_told_is_noticed() -> None:
    env = make_env(gyro=6.0 * LEVELS["gyro_noise"])
    assert deviation(drive(env, 200), mean_cost(env, gains_of(env))) > 2.0 * QUANTILE


def test_no_other_gain_costs_less() -> None:
    """Once the start is forgotten: changes of 10 % either way, of each gain, cost more."""
    env, settled = make_env(), STEPS * 3 // 4
    K = gains_of(env)
    least = mean_cost(env, K, settled)
    for i in range(K.shape[1]):
        for factor in (0.9, 1.1):
            changed = K.copy()
            changed[0, i] *= factor
            assert mean_cost(env, changed, settled) > least
