"""Bad input is refused at the border, names the thing, and steps nothing."""

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from sideslip.envs import FAILURES, StabilityEnv
from sideslip.envs.engine import step as kernel

from .helpers import BAD_ACTIONS, LINEAR, bits, play

pytestmark = pytest.mark.plain

Arguments = dict[str, Any]

OPTIONS: list[tuple[Arguments, type[Exception], str]] = [
    ({3: 1}, ValueError, "unknown reset option 3; known"),  # type: ignore[dict-item]
    ({"speed": 5.0}, ValueError, "unknown reset option speed; known: scenario, vehicle, friction"),
    ({"state": {"beta": 0.1}}, ValueError, "unknown state beta; known: v_x, v_y, gamma"),
    ({"state": {"v_y": math.nan}}, ValueError, "reset option state: v_y is nan"),
    ({"state": {"v_x": math.inf}}, ValueError, "reset option state: v_x is inf"),
    ({"state": {"X": 1e300}}, ValueError, "reset option state: X is 1e\\+300, not a number up to"),
    ({"scenario": "slalon"}, ValueError, "unknown scenario 'slalon'"),
    ({"vehicle": "comms"}, ValueError, "unknown vehicle 'comms'"),
    ({"friction": 0.0}, ValueError, "friction must be positive"),
    ({"friction": math.nan}, ValueError, "friction nan"),
    ({"duration": 0.0}, ValueError, "duration 0.0"),
    ({"scenario": {"camera_delays": [0.3]}}, ValueError, "under way at once"),
]


@pytest.mark.smoke
@pytest.mark.parametrize(("options", "error", "message"), OPTIONS, ids=str)
def test_a_refused_reset_leaves_the_episode_running(
    options: Arguments, error: type[Exception], message: str
) -> None:
    env, untouched = StabilityEnv(), StabilityEnv()
    for each in (env, untouched):
        each.reset(seed=0)
        play(each, [0.2] * 5)
    with pytest.raises(error, match=message):
        env.reset(seed=1, options=options)
    assert bits(env.np_random.bit_generator.state) == bits(untouched.np_random.bit_generator.state)
    assert env.scenario.name == "random-steering"
    assert bits(play(env, [0.2] * 20)) == bits(play(untouched, [0.2] * 20))


ACTIONS: list[tuple[Any, str]] = [
    (np.array([np.nan], np.float32), r"action \[nan\] is not finite; nothing was stepped"),
    (np.array([np.inf], np.float32), r"action \[inf\] is not finite; nothing was stepped"),
    *((action, rf"an action has shape \(1,\), got {text}") for action, text in BAD_ACTIONS),
]


@pytest.mark.smoke
@pytest.mark.parametrize(("action", "message"), ACTIONS, ids=lambda told: str(told)[:40])
def test_a_bad_action_steps_nothing(action: Any, message: str) -> None:
    env, untouched = StabilityEnv(), StabilityEnv()
    for each in (env, untouched):
        each.reset(seed=0)
        play(each, [0.2] * 5)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    assert bits(env.record) == bits(untouched.record)
    assert bits(env.get_state()["state"]) == bits(untouched.get_state()["state"])
    assert bits(play(env, [0.2] * 20)) == bits(play(untouched, [0.2] * 20))


FAILING = [[math.nan], [math.inf], [-math.inf], [], 0.0, "left", [None, {}]]


@pytest.mark.parametrize(
    "action", [*FAILING, *(action for action, _ in BAD_ACTIONS)], ids=lambda told: str(told)[:20]
)
def test_on_bad_action_fail_ends_the_episode_and_charges_the_rest(action: Any) -> None:
    env = StabilityEnv(scenario=LINEAR, on_bad_action="fail")
    env.reset(seed=0)
    before = play(env, [0.0] * 30)[-1]
    obs, reward, terminated, truncated, info = env.step(action)
    assert (terminated, truncated) == (True, False)
    assert FAILURES[info["failure"]] == "bad-action"
    assert not info["is_success"]
    assert reward == pytest.approx(-100.0 * (10.0 - 0.3), rel=1e-15)
    assert info["t"] == before.info["t"]  # nothing was stepped
    assert env.observation_space.contains(obs)
    assert len(env.record.fast) == len(env.record.packets) == 0
    assert all(math.isfinite(number) for number in info.values())
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))
    assert env.reset()[1]["failure"] == 0


@pytest.mark.smoke
def test_step_before_reset() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"never started: call reset\(\) first"):
        StabilityEnv().step(np.zeros(1, np.float32))


@pytest.mark.smoke
@pytest.mark.parametrize("end", ["time", "failure"])
def test_step_after_the_end(end: str) -> None:
    env = StabilityEnv()
    options: Arguments = {"duration": 0.05} if end == "time" else {"state": {"y": 60.0}}
    env.reset(seed=0, options=options)
    last = play(env, [0.0] * 10)[-1]
    assert (last.truncated, last.terminated) == (end == "time", end == "failure")
    with pytest.raises(gymnasium.error.ResetNeeded, match="the episode is over"):
        env.step(np.zeros(1, np.float32))


def test_a_snapshot_of_another_kind_of_env_is_refused_and_changes_nothing() -> None:
    env = StabilityEnv()
    env.reset(seed=0)
    before = bits(env.get_state()["state"])
    others: list[tuple[Arguments, str]] = [
        ({"control_period": 33}, "the snapshot has 33 ticks a step, this env 10"),
        # without this check the kernel would write past the end of the observation
        ({"sensors": "gps"}, "other sensors or another observation"),
        ({"fast": "all"}, "other sensors or another observation"),
    ]
    for arguments, message in others:
        other = StabilityEnv(**arguments)
        other.reset(seed=1)
        with pytest.raises(ValueError, match=message):
            env.set_state(other.get_state())
        assert bits(env.get_state()["state"]) == before


def test_an_array_that_cannot_be_written_compiles_nothing() -> None:
    """It is another type to the compiler: agents of other libraries give such."""
    env = StabilityEnv()
    env.reset(seed=0)
    action = np.array([0.1], np.float32)
    env.step(action)
    known = len(getattr(kernel.step_episode, "overloads", ()))
    action.setflags(write=False)
    env.step(action)
    env.step(np.broadcast_to(np.float32(0.1), (1,)))
    assert len(getattr(kernel.step_episode, "overloads", ())) == known
