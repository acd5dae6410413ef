"""The clairvoyant knows the plant exactly, and no other run of an episode is better."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.envs.engine.layout import P, Z
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.numerics.packed import read
from sideslip.envs.scenarios.driver import Wind, compute_wind
from sideslip.estimators import EstimateObservation

ca = pytest.importorskip("casadi")
pytest.importorskip("osqp")
from sideslip.agents import make_agent  # noqa: E402
from sideslip.agents.clairvoyant import plan as clairvoyant  # noqa: E402
from sideslip.agents.clairvoyant.forecast import (  # noqa: E402
    SYMBOLS,
    PlanState,
    PreviewStep,
    _advance,
    make_forecast,
)
from sideslip.agents.clairvoyant.plan import (  # noqa: E402
    _simulate_run,
    _solve_ilqr,
    compute_clairvoyant,
    record_actions,
)

assert sideslip.__version__
ID = "sideslip/YawFusion-v0"


def make(name: str, duration: float = 2.0, period: int = 10, **changes: Any) -> gym.Env[Any, Any]:
    """The fusion env on a shorter, changed scenario."""
    scenario = {"base": name, "duration": duration} | changes
    return gym.make(ID, scenario=scenario, control_period=period)


ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 1))
HARD = {
    f"{name}, {small_angle=}, {lags=}": {
        **{"base": name, "small_angle": small_angle, "lags": lags, "onset": 0.0},
        "wind_start": 0.05,
    }
    for name in ("lane-change", "gust")
    for small_angle in (False, True)
    for lags in (False, True)
}
ACTING: dict[str, dict[str, Any]] = {
    "changing tyres": {"base": "stiffness-step", "tyre_change_time": 0.1},
    "split friction": {"base": "random-steering", "friction_right": 0.3, "friction": 0.8},
    "driver": {"base": "double-lane-change", "onset": 0.05},
    "Dugoff tyres": {"base": "random-steering", "friction": 0.3, "tyres": "dugoff"},
    "tyres that relax": {
        **{"base": "random-steering", "friction": 0.3, "tyres": "magic-formula"},
        "vehicle": {"relaxation": 0.3},
    },
    "motor power, loads": {"base": "coms-brake-in-turn", "change_start": 0.05, "friction": 0.4},
    "a world that errs": {"base": "coms-slalom", "onset": 0.0, "amplitude": 0.1, "world": "v1"},
    "a road that winds and leans": {
        **{"base": "coms-slalom", "onset": 0.02, "amplitude": 0.1, "bank": 0.03, "grade": 0.02}
    },
}


@pytest.mark.parametrize("case", [*HARD, *ACTING])
def test_a_symbolic_tick_is_the_envs(case: str) -> None:
    """From each state of a hard run in the env, one step of the plan's plant, by a rule of one
    order more, is the env's tick. A driver steers as in the run of the actions."""
    scenario = (HARD | ACTING)[case] | {"duration": 0.2}
    world = scenario.pop("world", "ideal")
    # the rate of the motors' commands is drawn: a fiftieth of their torque a tick at least
    actions = ACTIONS if world == "ideal" else 0.005 * ACTIONS
    env = gym.make(ID, scenario=scenario, control_period=1, world=world)
    env.reset(seed=2)
    forecast = make_forecast(env.unwrapped, actions if case in ACTING else None)
    w = ca.SX.sym("w", len(PlanState._fields))
    u, known = ca.SX.sym("u"), ca.SX.sym("known", len(PreviewStep._fields))
    inputs = [u], PreviewStep(*ca.vertsplit(known))
    state, _ = _advance(forecast.fixed, PlanState(*ca.vertsplit(w)), *inputs)
    tick = ca.Function("tick", [w, u, known], [ca.vertcat(*state)])
    run = _simulate_run(env, 2, actions)
    for k in range(200):
        after = tick(run.states[k], run.actions[k], forecast.known[:, k]).full()[:, 0]
        np.testing.assert_allclose(after, run.states[k + 1], rtol=1e-9, atol=2e-8)


def test_the_forecast_is_what_the_car_meets() -> None:
    """The disturbances of a run with other actions are those that were listed."""
    env = make("gust", 0.5, 1)
    env.reset(seed=5)
    forecast = make_forecast(env.unwrapped)
    state: Any = env.unwrapped
    snapshot = state.get_state()
    wind = read(snapshot["params"], P.wind)
    for k in range(500):
        z = state.get_state()["state"]
        force = z[Z.drive.F_d] + compute_wind(float(k), wind)[0]
        assert forecast.known[PreviewStep._fields.index("F_d"), k] == force
        env.step(np.array([0.7], np.float32))


def test_a_lagged_reference_is_the_envs() -> None:
    """It hangs on the measured speed alone, which other actions change by little."""
    slalom = {"base": "coms-slalom", "duration": 3.0}
    env = gym.make(ID, scenario=slalom, control_period=1, reference="lagged")
    env.reset(seed=5)
    names = ("beta_ref", "gamma_ref")
    forecast = make_forecast(env.unwrapped, np.zeros((3000, 1)))
    known = forecast.known[[PreviewStep._fields.index(name) for name in names]]
    assert np.ptp(known, axis=1).min() > 0.002
    for k in range(1, 3000):
        *_, info = env.step(np.full(1, 0.1, np.float32))
        assert [info[name] for name in names] == pytest.approx(known[:, k].tolist(), abs=2e-3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "world"),
    [
        *(("random-steering", "ideal"), ("lane-change", "ideal"), ("gust", "ideal")),
        *(("gust", "v1"), ("random-steering", "v1")),
    ],
)
def test_no_run_is_better(scenario: str, world: str) -> None:
    """Neither the uncontrolled car, nor a controller, nor the plan a little changed.

    The plan's steps are ten times the env's, hence the thousandth.
    """
    env = gym.make(ID, scenario={"base": scenario, "duration": 3.0}, world=world)
    sensed = EstimateObservation(env, "exact-kf")
    agent = make_agent("two-dof", sensed)
    rng = np.random.default_rng(1)
    for seed in range(2):
        best = compute_clairvoyant(env, seed, {"two-dof": record_actions(sensed, agent, seed)})
        assert best.winner.startswith("from ")
        assert best.cost == _simulate_run(env, seed, best.actions).cost
        assert best.cost <= min(best.costs["none"], best.costs["two-dof"])
        for size in (0.01, 0.05):
            for _ in range(4):
                held = np.repeat(rng.normal(0.0, size, (30, 1)), 10, axis=0)
                other = np.clip(best.actions + held, -1.0, 1.0)
                assert _simulate_run(env, seed, other).cost > (1.0 - 1e-3) * best.cost


@pytest.mark.long
def test_a_car_that_is_lost_is_saved() -> None:
    """The uncontrolled car leaves the lane; the plan that starts from that run does not."""
    env = make("lane-change", 6.0)
    none = np.zeros((600, 1))
    lost = _simulate_run(env, 2, none)
    found, _ = _solve_ilqr(env, 2)
    assert found.cost < 0.3 * lost.cost
    assert found.cost == _simulate_run(env, 2, found.actions).cost


@pytest.mark.long
def test_steering_too() -> None:
    """Two actions do better than one, and the steering that is found was within its rate."""
    alone, _ = _solve_ilqr(make("lane-change"), 0)
    env = gym.make("sideslip/AfsYawFusion-v0", scenario={"base": "lane-change", "duration": 2.0})
    both, _ = _solve_ilqr(env, 0)
    assert both.actions.shape == (200, 2)
    assert both.cost < 0.5 * alone.cost
    run = _simulate_run(env, 0, both.actions)
    stands = run.states[:, PlanState._fields.index("slewing")] / 0.1  # rad of full scale
    assert np.abs(np.diff(stands)).max() == pytest.approx(0.08)  # 0.8 rad/s, 10 ms: it binds
    beyond = np.abs(both.actions[:, 1] - stands[1:]) > 1e-6
    assert beyond.mean() < 0.1  # hardly any action asks for more than the rate gives


@pytest.mark.long
def test_an_unfinished_plan_says_so_and_a_better_run_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clairvoyant, "MAX_ITERATIONS", 1)
    env = make("sine", 0.4, small_angle=True, tyres="linear", roll=False)
    found = compute_clairvoyant(env, 0, {"other": np.full((40, 1), 0.1)})
    assert found.statuses == {"other": "stopped"}
    assert found.cost == min(found.costs.values()) == found.costs[found.winner]
    monkeypatch.setattr(clairvoyant, "STEP_LENGTHS", (0.0,))  # steps that go nowhere
    stuck, status = _solve_ilqr(env, 0)
    assert status == "stuck" and stuck.cost == _simulate_run(env, 0, np.zeros((40, 1))).cost


def test_a_plan_begins_where_the_lead_in_ends() -> None:
    """Its cost is that of the whole episode, in which the lead-in costs nothing but a loss."""
    scenario = {"base": "coms-slalom", "duration": 0.3, "onset": 0.0, "amplitude": 0.1}
    env = gym.make(ID, scenario=scenario, world="v1", lead_in=0.5)
    result = compute_clairvoyant(env, 1)
    assert result.actions.shape == (30, 1) and result.winner == "from none"
    whole = _simulate_run(env, 1, np.vstack([np.ones((50, 1)), result.actions]))
    assert whole.cost == result.cost < 0.9 * result.costs["none"]
    policy: Any = SimpleNamespace(predict=lambda obs, *_, **__: (np.full(1, obs[0]), None))
    assert record_actions(env, policy, 1).shape == (30, 1)
    scenario |= {"half_width": 0.01}
    narrow = gym.make(ID, scenario=scenario, world="v1", lead_in=2.0)
    lost = compute_clairvoyant(narrow, 1)
    assert lost.costs == {"none": lost.cost} and lost.cost > 30.0


def test_bad_input() -> None:
    env = make("sine", 0.2)
    with pytest.raises(ValueError, match=r"shape \(20, 1\), got \(3, 1\)"):
        _solve_ilqr(env, 0, np.zeros((3, 1)))
    env.step(np.zeros(1, np.float32))
    with pytest.raises(ValueError, match="call reset"):
        make_forecast(env.unwrapped)

    joined = as_python(compute_wind, SYMBOLS)
    with pytest.raises(TypeError, match="&"):
        joined(ca.SX.sym("tick"), Wind(1.0, 0.0, 0.0, 1.0))
