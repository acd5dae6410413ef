"""MPC: the LQR where no limit is met, within limits elsewhere, and no action without a solution."""

import copy
import pickle
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents import make_agent
from sideslip.agents.controllers.lqr import Lqr
from sideslip.agents.controllers.mpc import NOT_FINITE, STATUSES, Mpc
from sideslip.agents.design.sampled_model import SPEEDS
from sideslip.envs import COMS
from sideslip.estimators import EstimateObservation
from tests.agents.helpers import compute_gains, observe
from tests.envs.helpers import bits

V = SPEEDS[18]


def env_of(steers: bool, **options: Any) -> Any:
    env = gym.make(f"sideslip/{'Afs' if steers else ''}YawFusion-v0", **options)
    return EstimateObservation(env, "exact-kf", outputs=["beta", "gamma"])


def agent_of(env: Any, **options: Any) -> Mpc:
    agent = make_agent("mpc", env, **options)
    assert isinstance(agent, Mpc)
    return agent


@pytest.mark.parametrize("steers", [False, True])
@pytest.mark.parametrize(
    "told", [{"beta_hat": 3e-4}, {"gamma_hat": 1e-3}, {"steer_command": 1e-4, "steer": 1e-4}]
)
@pytest.mark.parametrize("horizon", [5, 30])
def test_without_a_limit_it_is_the_lqr(steers: bool, told: dict[str, float], horizon: int) -> None:
    """Bellman: any horizon, when the rest costs what the regulator's rest costs."""
    env = env_of(steers)
    agent = agent_of(env, horizon=horizon)
    lqr = Lqr(env)
    obs = observe(env, V, **told)
    program, _ = agent._get_solver(V)
    K = compute_gains(lqr, V) / np.array([1.0, COMS.steering_authority])[: agent.width, None]
    x = np.zeros(len(agent.design_spec.states))
    for name, value in told.items():
        at = {"beta_hat": 0, "gamma_hat": 1, "steer": 3, "steer_command": 4}[name]
        x[at] = value
    plan = -np.linalg.solve(program.P, program.F @ x)
    assert np.abs(program.A @ plan).max() < 1.0
    assert plan[: agent.width] == pytest.approx(-K @ x, rel=1e-6, abs=1e-9)
    if not steers:  # the solver's own tolerance; with steering its rate is limited as well
        assert agent.predict(obs)[0] == pytest.approx(lqr.predict(obs)[0], abs=2e-3)


def test_where_the_moment_saturates_it_is_at_its_limit() -> None:
    env = env_of(False)
    action, _ = agent_of(env).predict(observe(env, V, beta_hat=0.05))
    assert action == pytest.approx([1.0], abs=1e-3)


def test_steering_is_asked_for_no_faster_than_it_moves() -> None:
    """By more than the solver's tolerance, from decision to decision."""
    env = env_of(True, scenario={"base": "step-steer", "duration": 2.0, "onset": 0.2})
    agent, state, before = agent_of(env), None, 0.0
    obs, _ = env.reset(seed=1)
    most = COMS.steering_rate * 0.01 / COMS.steering_authority
    changes = []
    for _ in range(150):
        action, state = agent.predict(obs, state)
        changes.append(abs(float(action[1]) - before))
        before = float(action[1])
        obs, *_ = env.step(action)
    assert max(changes) <= most + 2e-3 and max(changes) > 0.9 * most
    assert set(agent.status) == {"solved"}


def test_no_solution_is_no_action_and_the_episode_says_so() -> None:
    env = env_of(False, on_bad_action="fail")
    agent = agent_of(env, iterations=1)
    obs = np.stack([observe(env, V, beta_hat=0.01), observe(env, V)])
    obs[1, 0] = 0.0
    action, state = agent.predict(obs)
    assert np.isnan(action[0]).all() and agent.status[0] == "maximum iterations reached"
    assert np.isfinite(state).all()
    env.reset(seed=0)
    *_, terminated, _, info = env.step(action[0])
    assert terminated and info["failure"] != 0


def test_a_row_that_is_not_finite_leaves_its_neighbours_alone() -> None:
    env = env_of(True)
    agent = agent_of(env)
    obs = np.stack([observe(env, V, beta_hat=0.002)] * 3)
    whole, _ = agent.predict(obs)
    obs[1] = np.nan
    action, _ = agent.predict(obs)
    assert bits(action[[0, 2]]) == bits(whole[[0, 2]]) and np.isnan(action[1]).all()
    assert agent.status == ["solved", STATUSES[NOT_FINITE], "solved"]


def test_what_was_solved_before_does_not_matter() -> None:
    """The warm start is in the memory, not in the solver; copies and pickles act alike."""
    env = env_of(True)
    agent = agent_of(env)
    first = agent.predict(observe(env, V, beta_hat=0.002))
    agent.predict(observe(env, V, beta_hat=-0.3, gamma_hat=2.0))
    for other in (agent, copy.deepcopy(agent), pickle.loads(pickle.dumps(agent))):
        again = other.predict(observe(env, V, beta_hat=0.002))
        assert bits(again[0]) == bits(first[0]) and bits(again[1]) == bits(first[1])


def test_without_its_solver_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "osqp", None)
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[mpc\]"):
        make_agent("mpc", env_of(False))
