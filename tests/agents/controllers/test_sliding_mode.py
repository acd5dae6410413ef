"""Sliding mode: s decays at its rate, on s = 0 the slip at its pole, in the sampled loop too."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.yaw_stability import SlidingMode, _compute_surface_slope
from sideslip.agents.design.pi import BicyclePlant
from sideslip.envs import COMS, critical_speed
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.estimators import EstimateObservation

T = 0.01


def env_of(reference: str, period: int = 10) -> Any:
    env = gym.make("sideslip/YawFusion-v0", reference=reference, control_period=period)
    return EstimateObservation(env, "bicycle-kf", outputs=["beta", "gamma"])


def moment(env: Any, agent: Any, **told: float) -> float:
    """The yaw moment in N m that is asked for in a state, at 7 m/s."""
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    obs = np.zeros(len(names), np.float32)
    for name, value in ({"wheel_left": 7.0, "wheel_right": 7.0} | told).items():
        obs[names.index(name)] = value
    return float(agent.predict(obs)[0][0]) * COMS.yaw_moment_limit


def agent_of(env: Any, **options: float) -> SlidingMode:
    agent = make_agent("sliding-mode", env, **options)
    assert isinstance(agent, SlidingMode)
    return agent


def coefficients(speed: float) -> BicyclePlant:
    A, B = make_bicycle_model(COMS, speed).A, make_bicycle_model(COMS, speed).B
    return BicyclePlant(A[0, 0], A[0, 1], A[1, 0], A[1, 1], B[0, 0], B[1, 0], B[1, 1])


@pytest.mark.parametrize("reference", ["model", "zero-slip"])
@pytest.mark.parametrize("state", [(0.004, 0.02), (-0.003, 0.05), (0.0, -0.03)])
def test_the_distance_to_the_surface_decays_at_its_rate(
    reference: str, state: tuple[float, float]
) -> None:
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


def test_the_sampled_loop_is_stable_over_the_speeds() -> None:
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


def test_bad_input() -> None:
    env = env_of("model")
    for name in ("pole", "rate", "layer"):
        with pytest.raises(ValueError, match=f"{name} is a positive number"):
            make_agent("sliding-mode", env, **{name: 0.0})
    with pytest.raises(ValueError, match=r"beta_hat.*EstimateObservation"):
        make_agent("sliding-mode", gym.make("sideslip/YawFusion-v0"))
