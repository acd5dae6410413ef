"""ESC: stable in the sampled loop, quiet in its dead band, bounded in slip, no wind-up."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.yaw_stability import _compute_yaw_gains
from sideslip.envs import COMS, PASSENGER_CAR, critical_speed
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.estimators import EstimateObservation

T = 0.01


@pytest.fixture
def env() -> Any:
    return EstimateObservation(gym.make("sideslip/YawFusion-v0"), "bicycle-kf")


def observed(env: Any, **told: float) -> np.ndarray:
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    obs = np.zeros(len(names), np.float32)
    for name, value in ({"wheel_left": 7.0, "wheel_right": 7.0} | told).items():
        obs[names.index(name)] = value
    return obs


@pytest.mark.parametrize("car", [COMS, PASSENGER_CAR], ids=["coms", "passenger-car"])
def test_the_sampled_loop_is_stable_over_the_speeds(car: Any) -> None:
    """Moment held over a period and late by the motors; below the critical speed."""
    for speed in np.arange(2.0, min(40.0, 0.95 * critical_speed(car)), 1.0):
        k_p, k_i = _compute_yaw_gains(car, float(speed))
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
    assert agent.predict(observed(env, gyro=0.019))[0] == 0.0
    assert agent.predict(observed(env, gyro=-0.019))[0] == 0.0
    assert (
        agent.predict(observed(env, gyro=0.1))[0] < 0.0 < agent.predict(observed(env, gyro=-0.1))[0]
    )


def test_slip_is_bounded_with_an_estimate_and_without_one_it_is_not_needed(env: Any) -> None:
    agent = make_agent("esc", env, slip=0.05)
    assert agent.predict(observed(env, beta_hat=0.04))[0] == 0.0
    assert agent.predict(observed(env, beta_hat=0.06))[0] == pytest.approx(0.2, rel=1e-5)
    assert agent.predict(observed(env, beta_hat=-0.06))[0] == pytest.approx(-0.2, rel=1e-5)
    assert "beta_hat" not in make_agent("esc", gym.make("sideslip/YawFusion-v0")).needs


def test_the_yaw_rate_asked_for_is_what_friction_holds(env: Any) -> None:
    """0.85 mu g / v, Rajamani 8.2: there the moment is none, however much the driver steers."""
    limit = 0.85 * COMS.friction * 9.81 / 7.0
    agent = make_agent("esc", env, band=0.0)
    action, _ = agent.predict(observed(env, gyro=limit, steer_command=0.5))
    assert abs(action[0]) < 1e-4


def test_the_integral_neither_winds_up_nor_stays(env: Any) -> None:
    agent = make_agent("esc", env)
    state: Any = None
    for _ in range(500):
        action, state = agent.predict(observed(env, gyro=-1.0), state)
    assert action == pytest.approx([1.0]) and abs(state[0, 0]) <= COMS.yaw_moment_limit
    for _ in range(500):
        action, state = agent.predict(observed(env), state)
    assert abs(action[0]) < 1e-3


def test_bad_input(env: Any) -> None:
    for option in ({"bandwidth": 0.0}, {"slip": -1.0}):
        with pytest.raises(ValueError, match="is a positive number"):
            make_agent("esc", env, **option)
    with pytest.raises(ValueError, match="band is zero or more"):
        make_agent("esc", env, band=-0.1)
