"""Lane keeping: stable, at rest on a curve only where it should be, and better with the moment."""

from typing import Any

import control
import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.lqr import LANE_MOVED, LaneKeeping, _make_lane_model
from sideslip.agents.design.sampled_model import SPEEDS
from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import observe

OUTPUTS = ["beta", "gamma", "psi", "y_l"]
LIMIT = COMS.yaw_moment_limit


def env_of(kappa: float, **changes: Any) -> Any:
    scenario = {
        "name": "curve", "curvature": kappa, "curve_start": 10.0, "curve_ramp": 10.0,
        "half_width": 2.0, "front_stiffness": (0.7, 1.3), "rear_stiffness": (0.7, 1.3),
    } | changes  # fmt: skip
    env = gym.make("sideslip/YawVisionUneven-v0", steering=True, scenario=scenario)
    return EstimateObservation(env, "uneven-delay-kf", outputs=OUTPUTS)


def drive(env: Any, agent: Any, seed: int) -> tuple[np.ndarray, int]:
    """(offset from the road's centre line in m and sideslip angle in rad, the failure code)."""
    obs, _ = env.reset(seed=seed)
    state, found, over, info = None, list[Any](), False, {"failure": 0}
    while not over:
        action, state = agent.predict(obs, state)
        obs, _, terminated, truncated, info = env.step(action)
        found.append((env.unwrapped.motion.y, info["beta"]))
        over = terminated or truncated
    return np.array(found), int(info["failure"])


@pytest.mark.parametrize("inputs", [slice(0, 2), slice(1, 2)], ids=["both", "steering"])
def test_stable_over_the_speeds_with_python_controls_gains(inputs: slice) -> None:
    d = len(LANE_MOVED)
    for speed in SPEEDS[::6]:
        model = _make_lane_model(COMS, speed, 10, LIMIT, inputs)
        G, B, K = model.G[:d, :d], model.H[:d], model.solve()[0][:, :d]
        wanted = control.dlqr(G, B, model.Q[:d, :d], model.R, model.N[:d])[0]
        assert pytest.approx(np.asarray(wanted), rel=1e-9) == K
        assert np.abs(np.linalg.eigvals(G - B @ K)).max() < 1.0


def test_a_period_longer_than_the_curvatures_filter_does_not_diverge() -> None:
    env = gym.make("sideslip/YawVisionUneven-v0", steering=True, control_period=1000)
    env = EstimateObservation(env, "uneven-delay-kf", outputs=OUTPUTS)
    agent = LaneKeeping(env)
    _, memory = agent.predict(observe(env))
    for _ in range(50):
        _, memory = agent.predict(observe(env, gamma_hat=0.1), memory)
    assert memory[0, 1] == pytest.approx(0.1 / 7.0)


def test_at_rest_on_a_curve_the_car_is_in_its_lane() -> None:
    """The integral leaves no offset; the car turns with the road."""
    d, speed, kappa = len(LANE_MOVED), 7.0, 0.02
    model = _make_lane_model(COMS, speed, 10, LIMIT, slice(0, 2))
    closed = model.G - model.H @ model.solve()[0]
    rest = np.linalg.solve(np.eye(d) - closed[:d, :d], closed[:d, d + 1] * kappa)
    assert rest[3] == pytest.approx(0.0, abs=1e-9)
    assert rest[1] == pytest.approx(speed * kappa)
    assert rest[0] + rest[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("kappa", [0.02, -0.04])
def test_it_stays_where_the_uncontrolled_car_leaves_and_the_moment_helps(kappa: float) -> None:
    """It holds the lane by steering, within centimetres; the moment takes the slip off it."""
    env, offsets = env_of(kappa), []
    both, alone = make_agent("lane-keeping", env), make_agent("lane-keeping", env, moment=False)
    for seed in range(5):
        assert drive(env, make_agent("none", env), seed)[1] != 0
        (helped, failure), (steered, other) = drive(env, both, seed), drive(env, alone, seed)
        assert failure == other == 0
        assert np.abs(helped[:, 0]).max() < 0.1 > np.abs(steered[:, 0]).max()
        offset, slip = np.sqrt(np.mean(helped**2, 0) / np.mean(steered**2, 0))
        assert slip < 0.7
        offsets.append(offset)
    assert np.exp(np.mean(np.log(offsets))) < 0.9


def test_the_integral_holds_while_an_input_is_at_its_limit() -> None:
    env = env_of(0.02)
    agent = make_agent("lane-keeping", env)
    assert isinstance(agent, LaneKeeping)
    for offset, grows in ((0.001, True), (1.9, False)):
        _, state = agent.predict(observe(env, y_l_hat=offset))
        assert (state[0, 0] > 0.0) == grows


def test_without_the_moment_it_only_steers() -> None:
    env = env_of(0.02)
    obs, _ = env.reset(seed=0)
    obs[:] += 0.01
    both = make_agent("lane-keeping", env).predict(obs)[0]
    alone = make_agent("lane-keeping", env, moment=False).predict(obs)[0]
    assert both[0] != 0.0 and alone[0] == 0.0 and alone[1] != 0.0
