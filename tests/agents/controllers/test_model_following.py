"""dakf-stability V: what feedback and feedforward make of the nominal car, and the limits."""

from types import SimpleNamespace
from typing import Any

import control
import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.yaw_stability import ModelFollowing
from sideslip.envs import COMS, critical_speed
from sideslip.envs.task import MODEL, compute_reference, make_reference_params
from sideslip.envs.vehicle.linear import LinearModel, make_bicycle_model
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import observe

V = 25.0 / 3.6
K = (5.0, 8.0)
OMEGA = np.logspace(-2.0, 3.0, 40)


def plant(speed: float) -> Any:
    """P_n of (27): both inputs to both states."""
    model = make_bicycle_model(COMS, speed)
    return control.StateSpace(model.A, model.B, np.eye(2), np.zeros((2, 2)))


def feedback_gains(speed: float, bandwidth: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """P and I of C_fb = P + I / s: (31) solved for P_n^-1 diag(K / s), from errors to inputs.

    The printed (32) is this for equal K only.
    """
    model = make_bicycle_model(COMS, speed)
    P = np.linalg.solve(model.B, np.diag(bandwidth))
    return P, -np.linalg.solve(model.B, model.A @ np.diag(bandwidth))


def feedback(speed: float, bandwidth: tuple[float, float]) -> Any:
    P, I = feedback_gains(speed, bandwidth)  # noqa: E741
    return control.StateSpace(np.zeros((2, 2)), np.eye(2), I, P)


def response(system: Any) -> np.ndarray:
    """(frequencies, outputs, inputs)."""
    return np.moveaxis(system(1j * OMEGA), -1, 0)


def agent_for(**options: Any) -> tuple[ModelFollowing, Any]:
    """An agent that decides at every tick, and its env."""
    env: Any = gym.make("sideslip/AfsYawFusion-v0", control_period=1)
    env = EstimateObservation(env, "dakf", outputs=["beta", "gamma", "d1", "d2"])
    agent = make_agent("model-following", env, **options)
    assert isinstance(agent, ModelFollowing)
    return agent, env


def commands(action: Any) -> np.ndarray:
    """An action as (added steering in rad, yaw moment in N m)."""
    return np.array([action[1] * COMS.steering_authority, action[0] * COMS.yaw_moment_limit])


@pytest.mark.parametrize("speed", [3.0, V, 15.0])
def test_closed_loop_is_the_wanted_model(speed: float) -> None:
    """(30)-(31), for K_beta other than K_gamma."""
    loop = plant(speed) * feedback(speed, K)
    found = response(control.feedback(loop, np.eye(2)))
    s = 1j * OMEGA
    wanted = np.zeros_like(found)
    wanted[:, 0, 0], wanted[:, 1, 1] = K[0] / (s + K[0]), K[1] / (s + K[1])
    assert np.abs(found - wanted).max() < 1e-9


@pytest.mark.parametrize("bandwidth", [(5.0, 5.0), K])
def test_the_printed_feedback_agrees_for_equal_bandwidths_only(bandwidth: Any) -> None:
    model = make_bicycle_model(COMS, V)
    (a11, a12), (a21, a22) = model.A
    (b11, _), (b21, b22) = model.B
    K_b, K_g = bandwidth
    s = 1j * OMEGA
    printed = np.empty((len(s), 2, 2), complex)
    b, g = (s + K_g) / s * K_b / (s + K_b), (s + K_b) / s * K_g / (s + K_g)
    printed[:, 0, 0] = (b22 * s - b22 * a11) / (b11 * b22) * b  # (32)
    printed[:, 0, 1] = -a12 / b11 * g
    printed[:, 1, 0] = (-b21 * s - b11 * a21 + b21 * a11) / (b11 * b22) * b
    printed[:, 1, 1] = (b11 * s + b21 * a12 - b11 * a22) / (b11 * b22) * g
    exact = response(feedback(V, bandwidth))
    off = np.max(np.abs(printed - exact) / np.abs(exact))
    assert off < 1e-12 if K_b == K_g else off > 0.1


@pytest.mark.parametrize("speed", [3.0, V, 17.0])
def test_internal_stability_is_that_of_the_nominal_car(speed: float) -> None:
    """Poles: -K, and the car's own, which the feedback's zeros cancel."""
    closed = control.feedback(plant(speed) * feedback(speed, K), np.eye(2))
    expected = np.poly(np.append(plant(speed).poles(), [-K[0], -K[1]]))
    # as polynomials, which stay well-conditioned where poles lie close together
    assert np.poly(closed.poles()) == pytest.approx(expected, rel=1e-9)
    assert closed.poles().real.max() < 0.0
    assert speed < critical_speed(COMS)


def test_the_papers_own_check_overlooks_the_cancelled_poles() -> None:
    """V.D looks at P^-1 T and (P C)^-1 T: no pole but -K, where the loop has an unstable one."""
    speed = 1.1 * critical_speed(COMS)
    closed = control.feedback(plant(speed) * feedback(speed, K), np.eye(2))
    assert closed.poles().real.max() > 0.1
    model, s = make_bicycle_model(COMS, speed), 1j * OMEGA[:, None, None]
    wanted = np.array([np.diag([K[0] / (w + K[0]), K[1] / (w + K[1])]) for w in 1j * OMEGA])
    first = np.linalg.solve(model.B, (s * np.eye(2) - model.A) @ wanted)
    # P^-1 T = B^-1 (diag(K) - (diag(K) + A) T): a proper function whose only poles are T's
    proper = np.linalg.solve(model.B, np.diag(K) - (np.diag(K) + model.A) @ wanted)
    assert first == pytest.approx(proper, rel=1e-9)


def test_the_agent_has_these_gains() -> None:
    """Its proportional part at the first decision, and its integral's growth in a millisecond."""
    agent, env = agent_for(bandwidth=K)
    P, I = feedback_gains(V, K)  # noqa: E741
    for i, name in enumerate(("beta_hat", "gamma_hat")):
        obs = observe(env, V, **{name: -1e-3})
        first, state = agent.predict(obs)
        assert commands(first) == pytest.approx(1e-3 * P[:, i], rel=1e-6)  # float32
        assert state[0, :2] == pytest.approx(1e-6 * I[:, i], rel=1e-6)
        second, _ = agent.predict(obs, state)
        assert commands(second) == pytest.approx(1e-3 * P[:, i] + 1e-6 * I[:, i], rel=1e-6)


def test_disturbances_are_rejected_through_the_inverse_of_b() -> None:
    """(26), and nothing of it when it is switched off."""
    for rejection in (True, False):
        agent, env = agent_for(rejection=rejection)
        action, _ = agent.predict(observe(env, V, d1_hat=0.02, d2_hat=-0.3))
        rest = make_bicycle_model(COMS, V).B @ commands(action) + rejection * np.array([0.02, -0.3])
        assert rest == pytest.approx(0.0, abs=1e-6)  # float32


def driven(agent: Any, env: Any, model: LinearModel, steering: Any) -> np.ndarray:
    """beta, gamma and their references, (ticks, 4): the agent on a linear car that it sees."""
    G, H = model.discretise(1e-3)
    x, state, rows = np.zeros(2), None, []
    for driver in steering:
        refs = compute_reference(driver, V, make_reference_params(COMS), MODEL)
        told = dict(
            zip(("beta_ref", "gamma_ref", "beta_hat", "gamma_hat"), (*refs, *x), strict=True)
        )
        obs = observe(env, V, steer_command=driver, **told)
        rows.append([*x, *refs])
        action, state = agent.predict(obs, state)
        x = G @ x + H @ (commands(action) + np.array([driver, 0.0]))
    return np.array(rows)


UNCONTROLLED = SimpleNamespace(predict=lambda obs, state: (np.zeros(2), state))


def test_feedforward_inverts_the_nominal_plant() -> None:
    """(28)-(29) with the references' derivatives: the nominal car follows as if it had no lag."""
    agent, env = agent_for(bandwidth=(1e-9, 1e-9))  # no feedback to speak of
    t = np.arange(1500) * 1e-3
    rows = driven(agent, env, make_bicycle_model(COMS, V), 0.02 * np.sin(np.pi * t) ** 2)
    error = np.abs(rows[:, :2] - rows[:, 2:]).max(axis=0)
    # one millisecond late: the derivative is the last one, and the action holds
    slope = np.abs(np.diff(rows[:, 2:], axis=0)).max(axis=0)
    assert (error < 1.5 * slope).all()
    alone = driven(UNCONTROLLED, env, make_bicycle_model(COMS, V), 0.02 * np.sin(np.pi * t) ** 2)
    assert (np.abs(alone[:, :2] - alone[:, 2:]).max(axis=0) > 20.0 * error).all()


def test_with_feedback_a_wrong_car_ends_up_where_the_model_says() -> None:
    """Integral action: no error is left by tyres 30 % softer than the nominal ones."""
    agent, env = agent_for(bandwidth=K)
    rows = driven(agent, env, make_bicycle_model(COMS.scale_stiffness(0.7), V), np.full(4000, 0.02))
    assert rows[-1, :2] == pytest.approx(rows[-1, 2:], rel=1e-4)


def test_integrals_hold_at_the_limits() -> None:
    agent, env = agent_for()
    obs, state = observe(env, V, beta_hat=0.2, gamma_hat=-0.5), None
    for _ in range(2000):
        action, state = agent.predict(obs, state)
    assert np.abs(action) == pytest.approx([1.0, 1.0])
    assert state is not None
    assert np.all(np.abs(state[0, :2]) <= [COMS.steering_authority, COMS.yaw_moment_limit])
    turned, _ = agent.predict(observe(env, V, beta_hat=-0.2, gamma_hat=0.5), state)
    assert (np.sign(turned) == -np.sign(action)).all()  # at once


def test_the_gyro_stands_in_for_an_estimate_and_no_disturbances_are_asked_for() -> None:
    env: Any = gym.make("sideslip/AfsYawFusion-v0")
    env = EstimateObservation(env, "course-kf", outputs=["beta"], std=False)
    agent = make_agent("model-following", env, rejection=False)
    assert "gyro" in agent.needs
    assert "gamma_hat" not in agent.needs
