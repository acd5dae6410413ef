"""Agents of a user's own: by a registered name, an entry point, a factory or as an object."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import CliRunner

from sideslip.agents import AGENTS, Agent, Controller, make_agent, register_agent
from sideslip.agents.rollout import evaluate_episodes, rollout
from sideslip.benchmarks.cli.main import app
from sideslip.benchmarks.control.entries import Entry
from sideslip.benchmarks.control.tasks import ControlTask
from sideslip.estimators import register_estimator
from sideslip.estimators.make import ESTIMATORS
from tests.envs.helpers import bits

VISION = "sideslip/YawVision-v0"
YAW_DAMPER = "tests.agents.test_foreign:YawDamper"
CONSTANT = "tests.estimators.wrappers.constant:Constant"


class YawDamper(Controller):
    """A controller of ten lines: a yaw moment against the error of the yaw rate."""

    needs = ("gyro", "gamma_ref")

    def __init__(self, env: Any, gain: float = 5.0) -> None:
        super().__init__(env)
        self.gain = gain

    def _law(self, inputs: Any, state: Any, action: Any) -> None:
        action[:, 0] = self.gain * (inputs[:, 1] - inputs[:, 0])


def test_a_controller_without_a_law_cannot_be_built() -> None:
    with pytest.raises(TypeError, match="Lawless has no law: give it `law` or `_law`"):
        type("Lawless", (Controller,), {})(gym.make(VISION))


class Still:
    """No more than `predict`."""

    def __init__(self, env: Any = None, width: int = 1) -> None:
        self.width = width

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: Any = 1
    ) -> tuple[Any, Any]:
        return np.zeros((*observation.shape[:-1], self.width), np.float32), state


@pytest.fixture(autouse=True)
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    for registry in (ESTIMATORS, AGENTS):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))


@pytest.mark.parametrize("factory", [YawDamper, YAW_DAMPER])
def test_a_registered_controller_drives_single_and_vector_alike(factory: Any) -> None:
    register_agent("yaw-damper", factory)
    assert list(AGENTS)[-1] == "yaw-damper"
    seeds = [4, 5, 6]
    options: dict[str, Any] = {"scenario": {"base": "sine-with-dwell", "duration": 1.5}}
    single, rows = gym.make(VISION, **options), gym.make_vec(VISION, num_envs=3, **options)
    costs = evaluate_episodes(rows, make_agent("yaw-damper", rows, gain=2.0), seeds)[0]
    alone = [rollout(single, make_agent("yaw-damper", single, gain=2.0), s).cost for s in seeds]
    assert costs == pytest.approx(alone, rel=1e-12)
    assert (costs != evaluate_episodes(rows, make_agent("none", rows), seeds)[0]).all()


def test_whatever_predicts_is_an_agent() -> None:
    """An object is taken as it is; a class, a function and an entry point build one."""
    env = gym.make(VISION)
    own = Still()
    assert make_agent(own, env) is own
    made = [make_agent(each, env) for each in (Still, lambda env: Still(), f"{__name__}:Still")]
    still = rollout(env, None, 3, {"duration": 0.2}).cost
    agents: list[Agent] = [own, *made]
    assert {rollout(env, each, 3, {"duration": 0.2}).cost for each in agents} == {still}


def test_a_matrix_cell_of_foreign_parts() -> None:
    register_agent("yaw-damper", YAW_DAMPER)
    register_estimator("constant", CONSTANT)
    for estimator, controller in (("constant", "yaw-damper"), (CONSTANT, YAW_DAMPER)):
        env, agent = Entry(controller, estimator).make(ControlTask(scenario="step-steer"), 2)
        obs, _ = env.reset(seed=1)
        actions, _ = agent.predict(obs)
        assert actions.shape == (2, 1) and actions.any()  # `none` gives zeros
        again = env.step(actions)[0]
        assert bits(again[:, -2:]) == bits(np.array([[0.1, 0.2]] * 2, np.float32))


def test_the_command_line_takes_entry_points_and_lists_names() -> None:
    register_agent("yaw-damper", YAW_DAMPER)
    register_estimator("constant", CONSTANT)
    runner = CliRunner(env={"COLUMNS": "1000"})
    listed = runner.invoke(app, ["list"])
    assert "yaw-damper" in listed.output and "constant" in listed.output
    words = ["run", VISION, "--agent", YAW_DAMPER, "--estimator", CONSTANT, "--scenario", "gust"]
    done = runner.invoke(app, words)
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize(
    ("agent", "error", "message"),
    [
        ("yaw-dumper", ValueError, "unknown agent 'yaw-dumper'; did you mean 'yaw-damper'"),
        ("distill-car-yav", ValueError, "did you mean 'distill-car-yaw'"),
        ("nowhere:Thing", ValueError, "there is no module 'nowhere'"),
        (3, TypeError, "3 is no agent: int has no predict"),
        (lambda env: None, TypeError, "is no agent: NoneType has no predict"),
        (f"{__name__}:bits", TypeError, "has no predict"),
    ],
)
def test_what_is_no_agent(agent: Any, error: Any, message: str) -> None:
    register_agent("yaw-damper", YawDamper)
    with pytest.raises(error, match=message):
        make_agent(agent, gym.make(VISION))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: make_agent(Still(), env, width=2), "Still is built already, got width"),
        (lambda env: make_agent(Still, env, depth=2), "unexpected keyword argument 'depth'"),
        (lambda env: rollout(env, "none"), "stable-baselines3's predict, got str; make_a"),
    ],
)
def test_bad_arguments(call: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        call(gym.make(VISION))


def test_a_policys_card_names_no_code() -> None:
    """It comes with a file from elsewhere."""
    from sideslip.agents.learned.policy import Card

    layout = (("gyro", "rad/s"),)
    for name in ("os:system", "evil.py", "folder/evil.py:Filter"):
        with pytest.raises(ValueError, match="estimator is a name, got the entry point"):
            Card(VISION, layout, 10, "zero-slip", estimator=name)
    with pytest.raises(ValueError, match="env_id is that of a registered env, got 'evil:Car-v0'"):
        Card("evil:Car-v0", layout, 10, "zero-slip")
    with pytest.raises(ValueError, match="estimator_options holds an estimator"):
        Card(VISION, layout, 10, "zero-slip", {}, "dakf", {"estimator": "evil.py"})
