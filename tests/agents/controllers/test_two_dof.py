"""tie-vision's controller: the published formula, the poles where they were placed, the claims."""

import functools
from typing import Any

import control
import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.agents import make_agent
from sideslip.agents.controllers.two_dof import POLE, _compute_static_gain, design_pi
from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.vehicle.linear import Bicycle, make_bicycle_model
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import observe

KMH, CAR = 1 / 3.6, Bicycle(*COMS.lateral)


@pytest.mark.smoke
def test_feedforward_is_the_ratio_of_dc_gains() -> None:
    """(24): -G_delta(0) / G_N(0), whose printed middle has the wrong sign."""
    for kmh in (10.0, 20.0, 25.0, 45.0):
        model = make_bicycle_model(COMS, kmh * KMH)
        dc = -np.linalg.solve(model.A, model.B)[0]  # beta over delta_f and N_z
        assert _compute_static_gain(CAR, kmh * KMH) == pytest.approx(-dc[0] / dc[1], rel=1e-12)


def test_feedforward_at_25_kmh_and_its_change_of_sign() -> None:
    assert _compute_static_gain(CAR, 25 * KMH) == pytest.approx(-2652.0, abs=0.1)
    assert _compute_static_gain(CAR, 20.72 * KMH) > 0 > _compute_static_gain(CAR, 20.74 * KMH)


def test_feedforward_stays_finite_where_the_moment_does_not_move_beta() -> None:
    """An understeering car has a speed at which (24) divides by zero."""
    m, l_f, l_r = PASSENGER_CAR.mass, PASSENGER_CAR.front_arm, PASSENGER_CAR.rear_arm
    C_f, C_r = PASSENGER_CAR.front_stiffness, PASSENGER_CAR.rear_stiffness
    speed = np.sqrt(2 * (l_r * C_r - l_f * C_f) / m)
    assert np.isfinite(_compute_static_gain(Bicycle(*PASSENGER_CAR.lateral), float(speed)))


@pytest.mark.parametrize("kmh", [10.0, 18.0, 25.0, 32.0, 45.0])
def test_the_feedforward_agent_brings_static_slip_to_zero(kmh: float) -> None:
    """tie-vision (24) through `predict`, on the small-angle plant: |beta| < 1e-9 at 0.001 rad."""
    scenario = {
        "base": "tie-vision-fig8", "steering": "step", "amplitude": 0.001, "hold": 100.0,
        "speed": kmh * KMH, "duration": 12.0, "half_width": 1e6, "noise": {"wheel": 0.0},
    }  # fmt: skip
    env = gym.make("sideslip/YawVision-v0", scenario=scenario)
    drive = sideslip.rollout(env, make_agent("feedforward", env))
    assert abs(drive["gamma"][-1]) > 1e-4
    # the action is a float32, 6e-8 off, of a moment that alone cancels the uncontrolled slip
    none = sideslip.rollout(env)
    assert abs(drive["beta"][-1]) < 1e-9 + 6e-8 * abs(none["beta"][-1])


@pytest.mark.parametrize("kmh", [15.0, 25.0, 40.0])
def test_closed_loop_poles_are_where_they_were_placed(kmh: float) -> None:
    model = make_bicycle_model(COMS, kmh * KMH)
    pi = design_pi(COMS, kmh * KMH)
    plant = control.StateSpace(model.A, model.B[:, 1:], [[1.0, 0.0]], 0.0)
    loop = control.feedback(control.tf(plant) * control.tf([pi.k_p, pi.k_i], [1.0, 0.0]), 1)
    slow, fast = np.sort(-np.linalg.eigvals(model.A).real)
    expected = np.roots([1.0, fast, min(POLE, fast) ** 2])
    cancelled = np.append(expected, -slow)
    # residuals of the characteristic polynomial, which stay well-conditioned at double poles
    assert np.poly(loop.poles()) == pytest.approx(np.poly(cancelled), rel=1e-9)
    assert loop.poles().real.max() < 0


@functools.cache
def _lane_change(agent: str, estimator: str, scenario: str, **options: Any) -> Any:
    env: gym.Env[Any, Any] = gym.make("sideslip/YawVision-v0", scenario=scenario, control_period=1)
    if estimator:
        env = EstimateObservation(env, estimator)
    return sideslip.rollout(env, make_agent(agent, env, **options), seed=0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "limit"), [("tie-vision-fig8", 0.40), ("tie-vision-fig8-stiff", 0.55)]
)
@pytest.mark.parametrize(
    ("estimator", "rate"), [("single-rate-kf", "camera"), ("multirate-kf", "control")]
)
def test_fig8_control_against_none(scenario: str, limit: float, estimator: str, rate: str) -> None:
    """RMS slip with control at most 0.40 (tyres 1.2 x: 0.55) of none's."""
    none = _lane_change("none", "", scenario)
    controlled = _lane_change("two-dof", estimator, scenario, rate=rate)
    ratio = np.sqrt(np.mean(controlled["beta"] ** 2) / np.mean(none["beta"] ** 2))
    assert ratio <= limit


def test_an_unknown_placement_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown placement 'both'; known: "):
        design_pi(COMS, 7.0, placement="both")


def test_the_integral_does_not_wind_up() -> None:
    """While the moment is saturated the memory stays below one full scale."""
    env = EstimateObservation(gym.make("sideslip/YawVision-v0"), "bicycle-kf")
    agent = make_agent("two-dof", env)
    state = None
    for _ in range(1000):
        action, state = agent.predict(observe(env, beta_hat=0.2), state)
    assert action == pytest.approx([1.0])
    assert state is not None and abs(state[0, 0]) < COMS.yaw_moment_limit


@pytest.mark.parametrize("kmh", [15.0, 25.0, 40.0])
def test_forward_to_the_reference_the_nominal_car_holds_it(kmh: float) -> None:
    """The moment's part without an error, in the bicycle's steady turn: its slip is beta_ref."""
    env = EstimateObservation(gym.make("sideslip/YawFusion-v0", reference="model"), "exact-kf")
    model, delta, v = make_bicycle_model(COMS, kmh * KMH), 0.01, kmh * KMH
    for beta in (0.0, 2e-3, -1e-3):
        obs = observe(env, v, steer_command=delta, beta_ref=beta, beta_hat=beta)
        share, _ = make_agent("two-dof", env).predict(obs)
        turn = np.linalg.solve(model.A, -model.B @ [delta, share[0] * COMS.yaw_moment_limit])
        assert turn[0] == pytest.approx(beta, abs=1e-8)
        papers, _ = make_agent("two-dof", env, feedforward="zero-slip").predict(obs)
        turn = np.linalg.solve(model.A, -model.B @ [delta, papers[0] * COMS.yaw_moment_limit])
        assert turn[0] == pytest.approx(0.0, abs=1e-8)
