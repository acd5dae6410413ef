"""The POMDP whose optimum is known: J* is what the LQG costs, and nobody costs less."""

from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.baselines import (
    OUTPUTS,
    Lqg,
    Optimum,
    _make_linear_plant,
    compute_optimum,
    wrap_optimal_estimate,
)
from sideslip.envs.record import FAST
from sideslip.estimators.vector.estimate import TruthObservation

IDS = ("sideslip/LinearYawVision-v0", "sideslip/LinearYawGps-v0")
LINEAR: Any = gym.spec(IDS[0]).kwargs["scenario"]


@cache
def best(env_id: str) -> Optimum:
    return compute_optimum(gym.make(env_id))


def forwards(found: Optimum, gains: Any) -> float:
    """The cost of u = -L E[x | ...], added up step by step from the covariance of x: nothing of
    Riccati's but the estimate's errors."""
    model = found.plant.model
    L = np.broadcast_to(gains, found.gains.shape)
    X, total = found.plant.start, 0.0
    for j, P in enumerate(found.errors[0]):
        known, answer = X - P, L[j : j + 1]
        total += np.trace(model.Q @ X) - 2.0 * np.trace(model.N.T @ known @ answer.T)
        total += np.trace(model.R @ answer @ known @ answer.T) + found.plant.rest
        closed = model.G - model.H @ answer
        X = closed @ known @ closed.T + model.G @ P @ model.G.T + found.plant.W
    return float(total)


def drive(env: Any, agent: Any, seed: int = 0) -> tuple[Any, Any, float]:
    """(costs of the rows' episodes, actions (steps, rows), largest cost per second)."""
    obs, _ = env.reset(seed=seed)
    costs, actions, largest, over = np.zeros(len(obs)), [], 0.0, False
    while not over:
        action, _ = agent.predict(obs)
        obs, rewards, terminated, truncated, _ = env.step(action)
        assert not terminated.any()
        actions.append(action[:, 0])
        costs, largest = costs - rewards, max(largest, float(-rewards.min()) / 0.01)
        over = bool(truncated.any())
    return costs, np.array(actions), largest


def agree(costs: Any, expected: float) -> bool:
    """Whether an expected cost is within the 95 % interval of some episodes'."""
    return bool(abs(costs.mean() - expected) < 1.96 * costs.std(ddof=1) / np.sqrt(len(costs)))


@pytest.mark.parametrize("n", [1, 10])
def test_the_linear_plant_is_the_envs_step_and_its_cost(n: int) -> None:
    """To rounding and the integrator's error; within a longer period nothing may push the car."""
    still = {} if n == 1 else {"disturbance_force": 1e-9, "disturbance_moment": 1e-9}
    env = gym.make(IDS[0], scenario=LINEAR | still | {"hold": 1e-3 * n}, control_period=n)
    base: Any = env.unwrapped
    model = _make_linear_plant(env).model
    names, rng = model.states, np.random.default_rng(0)
    env.reset(seed=0, options={"state": {"v_y": 0.2, "gamma": 0.1}})
    for _ in range(20):
        x = np.zeros(len(names))
        x[[names.index(name) for name in OUTPUTS]] = base.true_state[:4]
        action = rng.uniform(-1.0, 1.0, 1).astype(np.float32)
        obs, reward, *_ = env.step(action)
        entries = [entry.name for entry in env.get_wrapper_attr("layout")]
        x[names.index("driver")] = base.record.fast[-1, FAST.steer_command]
        assert obs[entries.index("steer_command")] == np.float32(x[names.index("driver")])
        u = action.astype(float)
        after = model.G @ x + model.H @ u
        # Kutta's error, 1.14e-7 of what changes, up to half a rad/s
        np.testing.assert_allclose(base.true_state[:2], after[:2], rtol=0.0, atol=6e-8)
        cost = x @ model.Q @ x + u @ model.R @ u + 2.0 * x @ model.N @ u
        assert -float(reward) == pytest.approx(cost, rel=1e-6)


@pytest.mark.parametrize("env_id", IDS)
def test_the_committed_threshold_is_the_optimum(env_id: str) -> None:
    assert gym.spec(env_id).reward_threshold == pytest.approx(-best(env_id).cost, rel=1e-6)


@pytest.mark.parametrize("env_id", IDS)
def test_every_other_gain_costs_more_and_as_much_as_added_up(env_id: str) -> None:
    found, rng = best(env_id), np.random.default_rng(1)
    assert forwards(found, found.gains) == pytest.approx(found.cost, rel=1e-9)
    steady = found.compute_cost(found.gains[0])
    assert found.cost < steady < 1.001 * found.cost  # what the last steps could save
    for size in (1e-3, 0.1, 1.0):
        gains = found.gains * (1.0 + size * rng.standard_normal(found.gains.shape))
        assert found.compute_cost(gains) > found.cost
        assert forwards(found, gains) == pytest.approx(found.compute_cost(gains), rel=1e-9)


@pytest.mark.parametrize("count", [64, pytest.param(1024, marks=pytest.mark.long)])
@pytest.mark.parametrize("env_id", IDS)
def test_the_lqg_meets_it_and_what_binds_is_rare(env_id: str, count: int) -> None:
    found, env = best(env_id), wrap_optimal_estimate(gym.make_vec(env_id, count))
    costs, actions, largest = drive(env, Lqg(env))
    assert agree(costs, found.cost) and agree(costs, found.compute_cost(found.gains[0]))
    assert np.mean(np.abs(actions) >= 1.0) < 1e-4
    assert largest < 10.0  # a tenth of the cap
    weaker = 0.1 * found.gains[0]
    costs, *_ = drive(env, Lqg(env, weaker))
    assert agree(costs, found.compute_cost(weaker)) and not agree(costs, found.cost)


@pytest.mark.parametrize("env_id", IDS)
def test_only_who_sees_the_state_costs_less(env_id: str) -> None:
    """A policy cheaper than J* would fail the test above: this one is, and cheats."""
    env = TruthObservation(gym.make_vec(env_id, 64), (), OUTPUTS)
    costs, *_ = drive(env, Lqg(env))
    assert costs.mean() < best(env_id).cost and not agree(costs, best(env_id).cost)


def test_late_rare_and_lost_pictures_cost_more() -> None:
    def cost(schedules: int = 1, **camera: Any) -> float:
        return compute_optimum(gym.make(IDS[0], camera={"period": 0.04} | camera), schedules).cost

    prompt, late, later = (cost(delays=[delay]) for delay in (0.0, 0.1, 0.3))
    assert prompt < late < later
    assert prompt < cost(delays=[0.0], period=0.2) < cost(delays=[0.1], period=0.2)
    assert late < cost(2, delays=[0.1], loss=0.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tyres": "fiala"}, "no known optimum: tyres 'fiala'"),
        ({"curvature": 0.01}, "curvature"),
        ({"noise": {"gyro": 0.003}}, "noise of accel below 10000"),
        ({"noise": LINEAR["noise"] | {"gyro_bias": 0.1}}, "noise of gyro_bias"),
        ({"vehicle": {"mass": 500.0}}, "a car of unknown parameters or with motor_lag"),
        ({"amplitude": (0.001, 0.002)}, "quantities that are drawn"),
        ({"hold": 0.02}, "hold 0.02 s at control periods of 0.01 s"),
    ],
)
def test_what_has_no_known_optimum_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _make_linear_plant(gym.make(IDS[0], scenario=LINEAR | changes))


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize(("share", "noise"), [(0.0, 0.0), (0.5, 0.0), (1.0, 0.2)])
def test_a_policy_costs_its_squared_errors_more(env_id: str, share: float, noise: float) -> None:
    """The performance difference of an LQG problem, against the costs of the same seeds and against
    what `compute_cost` says of a gain; the squares scatter less."""
    found, rng = best(env_id), np.random.default_rng(2)
    env = wrap_optimal_estimate(gym.make_vec(env_id, 64))
    names = [entry.name for entry in env.layout]
    agent, columns = Lqg(env, share * found.gains[0]), [names.index(each) for each in Lqg.needs]
    obs, _ = env.reset(seed=0)
    costs, read, actions = np.zeros(64), [], []
    for _ in range(found.plant.steps):
        action = agent.predict(obs)[0] + noise * rng.standard_normal((64, 1)).astype(np.float32)
        read.append(obs[:, columns].astype(float))
        actions.append(action[:, 0].astype(float))
        obs, rewards, *_ = env.step(action)
        costs -= rewards
    optimal, *_ = drive(env, Lqg(env))
    gains = found.gains[:, [found.plant.model.states.index(x) for x in (*OUTPUTS, "driver")]]
    gains[1:, -1] *= found.plant.decay  # the first angle is seen before it acts: no guess
    errors = np.stack(actions, 1) + np.einsum("nji,ji->nj", np.stack(read, 1), gains)
    excess = errors**2 @ found.weights
    assert agree(costs - optimal - excess, 0.0)
    assert excess.mean() > 5.0 * np.std(costs - optimal - excess) / 8.0  # so that it is tested
    assert excess.std() < 0.8 * (costs - optimal).std() or share == 0.0
    if not noise:
        assert agree(excess, found.compute_cost(share * found.gains[0]) - found.cost)
