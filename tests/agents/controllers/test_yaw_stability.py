"""ESC and sliding mode: stable in the sampled loop, quiet, bounded, at their poles, no wind-up."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.yaw_stability import (
    BANDWIDTH,
    SlidingMode,
    _compute_surface_slope,
    _compute_yaw_gains,
)
from sideslip.envs import COMS, PASSENGER_CAR, critical_speed
from sideslip.envs.vehicle.linear import BicyclePlant, make_bicycle_model
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import observe

T = 0.01


@pytest.fixture
def env() -> Any:
    return EstimateObservation(gym.make("sideslip/YawFusion-v0"), "bicycle-kf")


@pytest.mark.parametrize("car", [COMS, PASSENGER_CAR], ids=["coms", "passenger-car"])
def test_escs_sampled_loop_is_stable_over_the_speeds(car: Any) -> None:
    """Moment held over a period and late by the motors; below the critical speed."""
    for speed in np.arange(2.0, min(40.0, 0.95 * critical_speed(car)), 1.0):
        k_p, k_i = _compute_yaw_gains(car, float(speed), BANDWIDTH)
        model = make_bicycle_model(car, float(speed))
        G, H = model.discretise(T)
        lag = np.exp(-T / car.motor_lag)
        closed = np.zeros((4, 4))  # beta, gamma, delivered moment, integral
        closed[:2, :2], closed[:2, 2:3] = G, H[:, 1:]
        closed[2] = 0.0, -(1.0 - lag) * k_p, lag, 1.0 - lag
        closed[3] = 0.0, -k_i * T, 0.0, 1.0
        assert np.abs(np.linalg.eigvals(closed)).max() < 1.0


def test_gains_place_both_poles_of_the_yaw_equation() -> None:
    k_p, k_i = _compute_yaw_gains(COMS, 7.0, 20.0)
    damping = make_bicycle_model(COMS, 7.0).A[1, 1]
    poles = np.roots([1.0, k_p / COMS.yaw_inertia - damping, k_i / COMS.yaw_inertia])
    assert poles == pytest.approx([-20.0, -20.0], rel=1e-5)


def test_dead_band_and_side(env: Any) -> None:
    agent = make_agent("esc", env, band=0.02)
    assert agent.predict(observe(env, gyro=0.019))[0] == 0.0
    assert agent.predict(observe(env, gyro=-0.019))[0] == 0.0
    left, right = (agent.predict(observe(env, gyro=gyro))[0] for gyro in (0.1, -0.1))
    assert left < 0.0 < right


def test_the_integral_does_not_change_sign_in_a_long_period_within_the_dead_band() -> None:
    env = gym.make("sideslip/YawFusion-v0", control_period=800)
    _, memory = make_agent("esc", env).predict(observe(env), np.array([[100.0]]))
    assert memory[0, 0] == 0.0


def test_slip_is_bounded_with_an_estimate_and_without_one_it_is_not_needed(env: Any) -> None:
    agent = make_agent("esc", env, slip=0.05)
    assert agent.predict(observe(env, beta_hat=0.04))[0] == 0.0
    assert agent.predict(observe(env, beta_hat=0.06))[0] == pytest.approx(0.2, rel=1e-5)
    assert agent.predict(observe(env, beta_hat=-0.06))[0] == pytest.approx(-0.2, rel=1e-5)
    assert "beta_hat" not in make_agent("esc", gym.make("sideslip/YawFusion-v0")).needs


def test_the_yaw_rate_asked_for_is_what_friction_holds(env: Any) -> None:
    """0.85 mu g / v, Rajamani 8.2: there the moment is none, however much the driver steers."""
    limit = 0.85 * COMS.friction * 9.81 / 7.0
    agent = make_agent("esc", env, band=0.0)
    action, _ = agent.predict(observe(env, gyro=limit, steer_command=0.5))
    assert abs(action[0]) < 1e-4


def test_the_integral_neither_winds_up_nor_stays(env: Any) -> None:
    agent = make_agent("esc", env)
    state: Any = None
    for _ in range(500):
        action, state = agent.predict(observe(env, gyro=-1.0), state)
    assert action == pytest.approx([1.0]) and abs(state[0, 0]) <= COMS.yaw_moment_limit
    for _ in range(500):
        action, state = agent.predict(observe(env), state)
    assert abs(action[0]) < 1e-3


def env_of(reference: str, period: int = 10) -> Any:
    env = gym.make("sideslip/YawFusion-v0", reference=reference, control_period=period)
    return EstimateObservation(env, "bicycle-kf", outputs=["beta", "gamma"])


def moment(env: Any, agent: Any, **told: float) -> float:
    """The yaw moment in N m that is asked for in a state, at 7 m/s."""
    return float(agent.predict(observe(env, **told))[0][0]) * COMS.yaw_moment_limit


def agent_of(env: Any, **options: float) -> SlidingMode:
    agent = make_agent("sliding-mode", env, **options)
    assert isinstance(agent, SlidingMode)
    return agent


def coefficients(speed: float) -> BicyclePlant:
    A, B = make_bicycle_model(COMS, speed).A, make_bicycle_model(COMS, speed).B
    return BicyclePlant(A[0, 0], A[0, 1], A[1, 0], A[1, 1], B[0, 0], B[1, 0], B[1, 1])


@pytest.mark.parametrize("reference", ["model", "zero-slip"])
@pytest.mark.parametrize("state", [(0.004, 0.02), (-0.003, 0.05), (0.0, -0.03)])
def test_the_distance_to_the_surface_decays(reference: str, state: tuple[float, float]) -> None:
    """s' = -rate s within the layer, straight from the nominal car's equations."""
    env = env_of(reference)
    agent = agent_of(env, rate=8.0, layer=10.0)
    N_z = moment(env, agent, beta_hat=state[0], gamma_hat=state[1])
    model = make_bicycle_model(COMS, 7.0)
    moved = model.A @ state + model.B @ [0.0, N_z]
    xi = _compute_surface_slope(coefficients(7.0), agent.pole)
    s, ds = state[1] + xi * state[0], moved[1] + xi * moved[0]
    assert ds == pytest.approx(-8.0 * s, rel=1e-4)


def test_on_the_surface_the_slip_decays_at_its_pole() -> None:
    xi = _compute_surface_slope(coefficients(7.0), 15.0)
    a11, a12 = coefficients(7.0)[:2]
    assert a11 - a12 * xi == pytest.approx(-15.0)


def test_outside_the_layer_the_reach_is_bounded() -> None:
    """Beyond the layer only the equivalent control grows with the distance."""
    env = env_of("model")
    near, far = (agent_of(env, rate=1.0, layer=layer) for layer in (0.01, 1.0))
    told = {"gamma_hat": 0.1}
    difference = moment(env, near, **told) - moment(env, far, **told)
    assert difference == pytest.approx(COMS.yaw_inertia * (0.1 - 0.01), rel=1e-3)


def test_sliding_modes_sampled_loop_is_stable_over_the_speeds() -> None:
    """Within the layer, with the moment held over 10 ms and late by the motors."""
    defaults = agent_of(env_of("model"))
    lag = np.exp(-T / COMS.motor_lag)
    for speed in np.arange(2.0, 0.95 * critical_speed(COMS), 1.0):
        model = make_bicycle_model(COMS, float(speed))
        xi = _compute_surface_slope(coefficients(float(speed)), defaults.pole)
        row = np.array([xi, 1.0])
        K = COMS.yaw_inertia * (row @ model.A + defaults.rate * row)
        G, H = model.discretise(T)
        closed = np.zeros((3, 3))
        closed[:2, :2], closed[:2, 2] = G, H[:, 1]
        closed[2] = *(-(1.0 - lag) * K), lag
        assert np.abs(np.linalg.eigvals(closed)).max() < 1.0, speed
