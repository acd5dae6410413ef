"""On the linear plant iterative LQR comes to the one optimum, that of a quadratic programme."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy.optimize import minimize

import sideslip

pytest.importorskip("casadi")
pytest.importorskip("osqp")
from sideslip.agents.clairvoyant.forecast import make_forecast
from sideslip.agents.clairvoyant.plan import _simulate_run, _solve_ilqr
from tests.agents.clairvoyant.programme import Array, solve_linear

assert sideslip.__version__

LINEAR: dict[str, Any] = {
    "base": "random-steering", "small_angle": True, "tyres": "linear", "roll": False,
    "speed": 25.0 / 3.6, "onset": 0.0,
}  # fmt: skip


def make(reference: str = "zero-slip", **changes: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make("sideslip/YawVision-v0", scenario=LINEAR | changes, reference=reference)


def optimum(env: gymnasium.Env[Any, Any], seed: int) -> tuple[Array, float]:
    """The programme's actions for an episode, and its least cost; a forecast of every tick."""
    base: Any = env.unwrapped
    how = {"scenario": base.scenario, "reference": base.reference}
    ticks = gymnasium.make("sideslip/YawVision-v0", control_period=1, **how)
    ticks.reset(seed=seed)
    actions, least, status = solve_linear(make_forecast(ticks.unwrapped), base.control_period)
    assert status == "solved"
    return actions, least


@pytest.mark.parametrize("reference", ["zero-slip", "model"])
def test_iterative_lqr_comes_to_the_programmes_optimum(reference: str) -> None:
    """On the linear plant there is one optimum; limits and disturbances act in this episode."""
    env = make(reference, duration=2.0, disturbance_moment=300.0, noise={"wheel": 0.0})
    exact, _ = optimum(env, 3)
    start = np.random.default_rng(0).uniform(-1.0, 1.0, exact.shape)
    found, status = _solve_ilqr(env, 3, start)
    assert status == "settled"
    assert (np.abs(exact) > 1.0 - 1e-6).any()
    assert found.cost == pytest.approx(_simulate_run(env, 3, exact).cost, rel=2e-4)
    assert found.cost < 0.05 * _simulate_run(env, 3, start).cost


@pytest.mark.parametrize("lags", [False, True])
def test_the_programmes_cost_is_that_in_the_env(lags: bool) -> None:
    """The programme has the env's own ticks; only the actions' float32 is between the two."""
    env = make(lags=lags, duration=2.0)
    actions, least = optimum(env, 3)
    assert _simulate_run(env, 3, actions).cost == pytest.approx(least, rel=1e-6)
    found, _ = _solve_ilqr(env, 3)
    assert found.cost == pytest.approx(least, rel=2e-4)
    assert found.cost == _simulate_run(env, 3, found.actions).cost
    assert found.cost < 0.2 * _simulate_run(env, 3, np.zeros_like(found.actions)).cost


def probe_cost(env: gymnasium.Env[Any, Any], K: int) -> tuple[float, Array, Array]:
    """J(u) = J_0 + g' u + u' H u / 2 over K periods, probed by replays; a quarter of full scale is
    exact in float32."""
    step = 0.25
    units = step * np.eye(K)[:, :, None]
    none = _simulate_run(env, 1, np.zeros((K, 1))).cost
    ahead = np.array([_simulate_run(env, 1, unit).cost for unit in units])
    back = np.array([_simulate_run(env, 1, -unit).cost for unit in units])
    g = (ahead - back) / (2.0 * step)
    H = np.empty((K, K))
    for i in range(K):
        for j in range(K):
            pair = _simulate_run(env, 1, units[i] + units[j]).cost
            H[i, j] = (pair - ahead[i] - ahead[j] + none) / step**2
    return none, g, H


@pytest.mark.parametrize("ticks", [5, 10, 25])
def test_a_plan_weighs_the_moments_rate(ticks: int) -> None:
    """Its cost is the least of the quadratic function that replays tell; the rate matters there.

    The plan takes a rate over a period where that is shorter than 10 ms, the env over 10 ms."""
    scenario = LINEAR | {"duration": 0.02 * ticks, "lags": True, "amplitude": (0.04, 0.04)}
    world = {"moment_rate": 0.002, "tyres": "linear"}
    options: dict[str, Any] = {"world": world, "control_period": ticks, "scenario": scenario}
    env = gymnasium.make("sideslip/YawVision-v0", reference="zero-slip", **options)
    none, g, H = probe_cost(env, 20)
    least = minimize(
        lambda u: none + g @ u + 0.5 * u @ H @ u, np.zeros(20), jac=lambda u: g + H @ u,
        method="L-BFGS-B", bounds=[(-1.0, 1.0)] * 20, options={"ftol": 1e-14, "gtol": 1e-12},
    )  # fmt: skip
    found, _ = _solve_ilqr(env, 1)
    assert found.cost < (1.01 if ticks < 10 else 1.0001) * least.fun


def test_the_programmes_plan_meets_the_conditions_of_optimality_of_the_envs_cost() -> None:
    """At the plan the slope vanishes, or points out of the limits where one is reached."""
    env = make(duration=0.1, lags=True, disturbance_moment=600.0, amplitude=(0.04, 0.04))
    _, g, H = probe_cost(env, 10)
    found = optimum(env, 1)[0][:, 0]
    slope = (g + H @ found) / np.abs(g).max()
    at_limit = np.abs(found) > 1.0 - 1e-6
    assert at_limit.any() and not at_limit.all()  # both conditions are put to the test
    assert np.abs(slope[~at_limit]).max() < 1e-5
    assert np.all(slope[at_limit] * found[at_limit] < 0.0)


def test_the_measured_speed_of_a_reference_is_all_that_the_plan_does_not_know() -> None:
    silent = make("model", duration=2.0, noise={"wheel": 0.0})
    actions, least = optimum(silent, 3)
    assert _simulate_run(silent, 3, actions).cost == pytest.approx(least, rel=1e-6)
