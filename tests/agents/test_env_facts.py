"""Agents read by name: every wrapper leaves numbers and actions as they are, or is refused."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import vector

import sideslip
from sideslip.agents import make_agent
from sideslip.agents.env_info import get_env_facts, get_layout
from sideslip.estimators import EstimateObservation
from sideslip.estimators.vector import EstimateObservation as BatchEstimate
from sideslip.estimators.vector.estimate import TruthObservation as BatchTruth
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.policies import VISION

ID = "sideslip/YawVision-v0"
SCENARIO = {"base": "slalom", "duration": 0.3, "onset": 0.0}
Wrap = Callable[[Any], Any]


def single(render_mode: str | None = None) -> Any:
    env = gym.make(ID, scenario=SCENARIO, render_mode=render_mode)
    return EstimateObservation(env, "exact-kf")


def batch() -> Any:
    return BatchEstimate(gym.make_vec(ID, 2, scenario=SCENARIO), "exact-kf")


def driven(env: Any) -> bytes:
    """The actions and costs of 20 steps by LQR."""
    agent, state = make_agent("lqr", env), None
    obs, _ = env.reset(seed=1)
    drive = []
    for _ in range(20):
        action, state = agent.predict(obs, state)
        obs, *_, info = env.step(action)
        drive += [action.tobytes(), np.asarray(info["cost"]).tobytes()]
    env.close()
    return b"".join(drive)


class Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Has a step of its own, and says that it changes nothing."""

    transparent = True

    def step(self, action: Any) -> Any:
        return super().step(action)


class Heavier(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return 2.0 * reward


SINGLE: dict[str, Wrap] = {
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 1000),
    "Autoreset": wrappers.Autoreset,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "NormalizeReward": wrappers.NormalizeReward,
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.1, 0.0),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda r: -float(r)),
    "TruthObservation": TruthObservation,
    "Wrapper": gym.Wrapper,
    "RewardWrapper": Heavier,
    "transparent": Counted,
    "several": lambda env: Counted(wrappers.NormalizeReward(wrappers.Autoreset(env))),
}


@pytest.mark.parametrize("wrap", SINGLE.values(), ids=SINGLE)
def test_an_agent_behind_a_transparent_wrapper_acts_as_without(wrap: Wrap) -> None:
    env, bare = wrap(single()), single()
    layout = get_env_facts(bare).layout
    assert get_env_facts(env).layout[: len(layout)] == layout  # entries of ours stand behind
    assert driven(env) == driven(bare)


@pytest.mark.parametrize("name", ["HumanRendering", "RecordVideo", "RenderCollection",
                                  "AddWhiteNoise", "ObstructView"])  # fmt: skip
def test_an_agent_behind_a_wrapper_that_draws_acts_as_without(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    arguments: dict[str, Any] = {
        "RecordVideo": {"video_folder": str(tmp_path), "episode_trigger": lambda _: False},
        "AddWhiteNoise": {"probability_of_noise_per_pixel": 0.1},
        "ObstructView": {"obstructed_pixels_ratio": 0.1, "obstruction_width": 2},
    }
    wrapper = getattr(wrappers, name)
    env = wrapper(single("rgb_array"), **arguments.get(name, {}))
    assert driven(env) == driven(single())


class Doubled(gym.ObservationWrapper[Any, Any, Any]):
    def observation(self, observation: Any) -> Any:
        return 2.0 * observation


class Late(wrappers.TimeLimit):
    """No longer what its parent is known for."""

    def step(self, action: Any) -> Any:
        obs, *rest = super().step(action)
        return 2.0 * obs, *rest


class Halved(Counted):
    """No longer what its parent says."""

    def step(self, action: Any) -> Any:
        return super().step(0.5 * action)


REFUSED: dict[str, Wrap] = {
    "NormalizeObservation": wrappers.NormalizeObservation,
    "RescaleObservation": lambda env: wrappers.RescaleObservation(
        wrappers.TransformObservation(env, lambda o: o, gym.spaces.Box(-9.0, 9.0, (30,))),
        np.float32(-1),
        np.float32(1),
    ),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, np.tanh, None),
    "TimeAwareObservation": lambda env: wrappers.TimeAwareObservation(wrappers.TimeLimit(env, 99)),
    "FlattenObservation": wrappers.FlattenObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 2),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float64),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 2),
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32(-9), np.float32(9)),
    "ClipAction": wrappers.ClipAction,
    "TransformAction": lambda env: wrappers.TransformAction(env, np.negative, env.action_space),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "Doubled": Doubled,
    "Late": lambda env: Late(env, 1000),
    "Halved": Halved,
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("outside", ["Wrapper", "TimeLimit", "TruthObservation"])
def test_another_wrapper_is_refused_by_name(name: str, outside: str) -> None:
    """Also within one that extends the layout."""
    env = SINGLE[outside](REFUSED[name](single()))
    with pytest.raises(ValueError, match=rf"^{name} may change observations or actions.*on the env "
                       "inside of it; .* transparent = True"):  # fmt: skip
        make_agent("lqr", env)
    with pytest.raises(ValueError, match=name):
        make_agent("learned", env, policy=VISION)


def test_a_wrapper_itself_may_be_declared_transparent() -> None:
    env: Any = wrappers.FlattenObservation(single())
    env.transparent = True
    assert driven(env) == driven(single())
    env = Counted(single())
    env.transparent = False
    with pytest.raises(ValueError, match="Counted"):
        get_env_facts(env)


BATCH: dict[str, Wrap] = {
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "NormalizeReward": vector.NormalizeReward,
    "ClipReward": lambda env: vector.ClipReward(env, -0.1, 0.0),
    "TransformReward": lambda env: vector.TransformReward(env, np.negative),
    "TruthObservation": BatchTruth,
    "VectorWrapper": gym.vector.VectorWrapper,
}


@pytest.mark.parametrize("wrap", BATCH.values(), ids=BATCH)
def test_an_agent_behind_a_transparent_vector_wrapper_acts_as_without(wrap: Wrap) -> None:
    assert driven(wrap(batch())) == driven(batch())


def test_infos_as_a_list_change_no_action() -> None:
    env = vector.DictInfoToList(batch())
    assert get_env_facts(env) == get_env_facts(batch())


VECTOR_REFUSED: dict[str, Wrap] = {
    "NormalizeObservation": vector.NormalizeObservation,
    "TransformObservation": lambda env: vector.TransformObservation(env, np.tanh),
    "DtypeObservation": lambda env: vector.DtypeObservation(env, np.float64),
    "RescaleAction": lambda env: vector.RescaleAction(env, -9.0, 9.0),
    "ClipAction": vector.ClipAction,
    "TransformAction": lambda env: vector.TransformAction(env, np.negative),
}


@pytest.mark.parametrize("name", VECTOR_REFUSED)
def test_another_vector_wrapper_is_refused_by_name(name: str) -> None:
    env = vector.RecordEpisodeStatistics(VECTOR_REFUSED[name](batch()))
    for read in (get_env_facts, get_layout):
        with pytest.raises(ValueError, match=f"^{name} may change"):
            read(env)


def test_wrappers_of_the_rows_are_looked_at_too() -> None:
    def make(wrap: Wrap) -> Any:
        return wrap(gym.make(ID, scenario=SCENARIO))

    rows = {wrap: functools.partial(make, wrap) for wrap in (wrappers.Autoreset, Doubled)}
    same, other = rows.values()
    assert get_env_facts(SyncVectorEnv([same])) == get_env_facts(make(lambda env: env))
    with pytest.raises(ValueError, match="Doubled may change"):
        get_env_facts(SyncVectorEnv([same, other]))


@pytest.mark.parametrize("name", ["Autoreset", "NormalizeObservation", "ClipAction"])
def test_rows_in_other_processes_show_it_by_their_spaces(name: str) -> None:
    env: Any = AsyncVectorEnv([functools.partial(_wrapped, name)] * 2)
    try:
        if name == "Autoreset":
            assert get_env_facts(env) == get_env_facts(gym.make(ID))
        else:
            with pytest.raises(ValueError, match="a wrapper within AsyncVectorEnv may change"):
                get_env_facts(env)
    finally:
        env.close()


def _wrapped(name: str) -> Any:
    assert sideslip.__version__  # registers the ids in the other process
    return getattr(wrappers, name)(gym.make(ID))


def test_what_is_no_env_of_ours_is_refused_in_one_line() -> None:
    other = gym.make("CartPole-v1")
    for env in (other, gym.make_vec("CartPole-v1", 2), SyncVectorEnv([lambda: other]), ID, 5):
        for name in ("lqr", VISION, "none"):
            with pytest.raises(TypeError, match=r"gym\.make\('sideslip/YawVision-v0'\)") as caught:
                make_agent(name, env)  # type: ignore[arg-type]
            assert "\n" not in str(caught.value)


def test_rows_of_a_native_env_show_each_plant() -> None:
    rows = [{"base": "slalom", "tyres": tyres} for tyres in ("linear", "fiala")]
    env = gym.make_vec("sideslip/YawFusion-v0", num_envs=2, scenario=rows)
    assert {kind.tyres for kind in get_env_facts(env).plants} == {"linear", "fiala"}
