"""On the linear plant the plan is the optimum of the env's own cost."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import sideslip

pytest.importorskip("casadi")
pytest.importorskip("osqp")
from sideslip.agents.clairvoyant import plan as clairvoyant
from sideslip.agents.clairvoyant.foresight import forecast_of
from sideslip.agents.clairvoyant.plan import plan, replay
from sideslip.agents.clairvoyant.qp import solve_linear

assert sideslip.__version__

LINEAR: dict[str, Any] = {
    "base": "random-steering",
    "small_angle": True,
    "tyres": "linear",
    "roll": False,
    "speed": 25.0 / 3.6,
    "onset": 0.0,
}


def make(reference: str = "zero-slip", **changes: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make("sideslip/YawVision-v0", scenario=LINEAR | changes, reference=reference)


def objective(env: gymnasium.Env[Any, Any], seed: int) -> float:
    """The programme's least cost of an episode."""
    env.reset(seed=seed)
    base: Any = env.unwrapped
    return solve_linear(forecast_of(base, base.control_period))[1]


@pytest.mark.parametrize("reference", ["zero-slip", "model"])
def test_iterative_lqr_comes_to_the_programmes_optimum(
    reference: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the linear plant there is one optimum; limits and disturbances act in this episode."""
    env = make(reference, duration=2.0, disturbance_moment=300.0, noise={"wheel": 0.0})
    exact = plan(env, 3)
    monkeypatch.setattr(clairvoyant, "is_linear", lambda base: False)
    start = np.random.default_rng(0).uniform(-1.0, 1.0, exact.actions.shape)
    found = plan(env, 3, start)
    assert found.status == "settled"
    assert (np.abs(exact.actions) > 1.0 - 1e-6).any()
    assert found.cost == pytest.approx(exact.cost, rel=2e-4)
    assert found.cost < 0.05 * replay(env, 3, start)


@pytest.mark.parametrize("lags", [False, True])
def test_its_cost_in_the_env_is_the_objective(lags: bool) -> None:
    """The programme has the env's own ticks; only the actions' float32 is between the two."""
    env = make(lags=lags, duration=2.0)
    found = plan(env, 3)
    assert found.status == "solved"
    assert found.cost == pytest.approx(objective(env, 3), rel=1e-6)
    assert found.cost == replay(env, 3, found.actions)
    assert found.cost < 0.2 * replay(env, 3, np.zeros_like(found.actions))


def test_the_plan_meets_the_conditions_of_optimality_of_the_envs_cost() -> None:
    """J(u) = J_0 + g' u + u' H u / 2, probed by replays; a quarter of full scale is exact in
    float32. At the plan the slope vanishes, or points out of the limits where one is reached."""
    env = make(duration=0.1, lags=True, disturbance_moment=600.0, amplitude=(0.04, 0.04))
    K, step = 10, 0.25
    units = step * np.eye(K)[:, :, None]
    none = replay(env, 1, np.zeros((K, 1)))
    ahead = np.array([replay(env, 1, unit) for unit in units])
    back = np.array([replay(env, 1, -unit) for unit in units])
    g = (ahead - back) / (2.0 * step)
    H = np.empty((K, K))
    for i in range(K):
        for j in range(K):
            pair = replay(env, 1, units[i] + units[j])
            H[i, j] = (pair - ahead[i] - ahead[j] + none) / step**2
    found = plan(env, 1).actions[:, 0].astype(np.float64)
    slope = (g + H @ found) / np.abs(g).max()
    at_limit = np.abs(found) > 1.0 - 1e-6
    assert at_limit.any() and not at_limit.all()  # both conditions are put to the test
    assert np.abs(slope[~at_limit]).max() < 1e-5
    assert np.all(slope[at_limit] * found[at_limit] < 0.0)


def test_the_measured_speed_of_a_reference_is_all_that_the_plan_does_not_know() -> None:
    silent = make("model", duration=2.0, noise={"wheel": 0.0})
    found = plan(silent, 3)
    assert found.cost == pytest.approx(objective(silent, 3), rel=1e-6)
