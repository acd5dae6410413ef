"""The contract of every registered id."""

import copy
import json
import pickle
import re
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sideslip.envs import FAILURES, StabilityEnv

from .helpers import IDS, V1, bits, play, unwrapped

pytestmark = [pytest.mark.plain, pytest.mark.parametrize("name", IDS + V1)]
COMPILED = pytest.mark.compiled

NUMBERS = ("t", "beta", "gamma", "psi", "beta_ref", "gamma_ref", "steer", "yaw_moment", "cost")
INFO: dict[str, type] = dict.fromkeys(NUMBERS, float) | {"failure": int, "is_success": bool}


@pytest.mark.smoke
def test_gymnasiums_checker_is_content(name: str) -> None:
    env = gymnasium.make(name).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


def test_stable_baselines_checker_is_content(name: str) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.make(name).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)


@pytest.mark.smoke
def test_an_episode_ends_by_time_and_only_then_succeeds(name: str) -> None:
    env = unwrapped(name)
    env.reset(seed=0, options={"duration": 0.25})
    moments = play(env, [0.0] * 1000)
    assert len(moments) == 25
    for moment in moments[:-1]:
        assert (moment.terminated, moment.truncated, moment.info["is_success"]) == (False,) * 3
    last = moments[-1]
    assert (last.terminated, last.truncated, last.info["is_success"]) == (False, True, True)
    assert last.info["t"] == pytest.approx(0.25, rel=1e-15)
    assert gymnasium.spec(name).max_episode_steps is None


def test_info_has_fixed_names_and_types_and_no_nan(name: str) -> None:
    env = unwrapped(name, reference="limited")
    infos = [env.reset(seed=1)[1], env.reset()[1]]
    infos += [moment.info for moment in play(env, [0.5, -1.0, 2.0, 0.0])]
    for info in infos:
        assert list(info) == list(INFO)
        assert {key: type(value) for key, value in info.items()} == INFO
        assert all(np.isfinite(value) for value in info.values())
        assert 0 <= info["failure"] < len(FAILURES)
    assert [info["t"] for info in infos] == pytest.approx([0.0, 0.0, 0.01, 0.02, 0.03, 0.04])
    assert [info["is_success"] for info in infos] == [False] * 6


@pytest.mark.smoke
def test_the_seed_determines_everything(name: str) -> None:
    def episode(env: StabilityEnv, seed: int) -> Any:
        return bits((env.reset(seed=seed), play(env, [0.3] * 50)))

    one, other = unwrapped(name), unwrapped(name)
    first = episode(one, 5)
    assert episode(other, 5) == first
    assert episode(one, 6) != first
    assert episode(one, 5) == first  # whatever happened before


def test_episodes_without_a_seed_go_on_from_the_generator(name: str) -> None:
    one, other = unwrapped(name), unwrapped(name)
    for env in (one, other):
        env.reset(seed=5)
    assert bits(one.reset()) == bits(other.reset())
    assert bits(one.reset()) != bits(one.reset())


def test_observations_are_fresh_arrays_inside_the_space(name: str) -> None:
    env = unwrapped(name, scenario="slalom")
    obs, _ = env.reset(seed=2)
    shape = 300, *(env.action_space.shape or ())
    moments = play(env, np.random.default_rng(0).uniform(-1.0, 1.0, shape))
    every = [obs, *[moment.obs for moment in moments]]
    assert all(env.observation_space.contains(each) for each in every)
    assert len({each.ctypes.data for each in every}) == len(every)
    assert all(type(moment.reward) is float and moment.reward <= 0.0 for moment in moments)
    assert all(type(moment.terminated) is type(moment.truncated) is bool for moment in moments)


def test_actions_outside_the_box_are_clipped(name: str) -> None:
    one, other = unwrapped(name), unwrapped(name)
    for env in (one, other):
        env.reset(seed=3)
    assert bits(play(one, [7.0, -3.0] * 5)) == bits(play(other, [1.0, -1.0] * 5))


@pytest.mark.smoke
@pytest.mark.parametrize(
    "way",
    ["state", *(pytest.param(way, marks=COMPILED) for way in ("deepcopy", "pickle", "wrapped"))],
)
def test_a_snapshot_continues_bit_for_bit(name: str, way: str) -> None:
    env = unwrapped(name, scenario="slalom")
    env.reset(seed=4, options={"friction": 0.8})
    play(env, [0.5] * 37)
    if way == "state":
        twin = unwrapped(name, scenario="slalom")
        twin.set_state(env.get_state())
    elif way == "wrapped":
        wrapped = gymnasium.make(name, scenario="slalom")
        wrapped.reset()
        inner = wrapped.unwrapped
        assert isinstance(inner, StabilityEnv)
        inner.set_state(env.get_state())
        copied = copy.deepcopy(wrapped).unwrapped
        assert isinstance(copied, StabilityEnv)
        twin = copied
    else:
        twin = copy.deepcopy(env) if way == "deepcopy" else pickle.loads(pickle.dumps(env))
    assert bits(twin.record) == bits(env.record)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (100, *(env.action_space.shape or ())))
    expected = bits((play(env, actions), env.reset(), play(env, actions)))
    assert bits((play(twin, actions), twin.reset(), play(twin, actions))) == expected


def test_a_snapshot_is_not_changed_by_what_follows(name: str) -> None:
    env = unwrapped(name)
    env.reset(seed=4)
    play(env, [0.5] * 10)
    snapshot = env.get_state()
    futures = []
    for _ in range(3):  # a tree search goes back again and again
        futures.append(bits((play(env, [0.1] * 50), env.reset(), play(env, [0.2] * 10))))
        env.set_state(snapshot)
    assert futures[0] == futures[1] == futures[2]


def test_a_snapshot_of_a_finished_episode_is_finished(name: str) -> None:
    env = unwrapped(name)
    env.reset(seed=0, options={"duration": 0.05})
    play(env, [0.0] * 5)
    twin = unwrapped(name)
    twin.reset(seed=1)
    twin.set_state(env.get_state())
    with pytest.raises(gymnasium.error.ResetNeeded):
        twin.step(np.zeros(twin.action_space.shape, np.float32))


@pytest.mark.smoke
def test_spec_goes_through_json(name: str) -> None:
    arguments: dict[str, Any] = {
        "scenario": {"base": "sine", "speed": [6.0, 7.0], "noise": {"gyro": 0.01}},
        "vehicle": {"base": "coms", "mass": 400.0},
        "nominal": "coms",
        "control_period": 5,
        "reference": "model",
        "fast": "all",
    }
    env = gymnasium.make(name, **arguments)
    assert env.spec is not None
    text = env.spec.to_json()
    json.loads(text)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert again.spec is not None
    assert again.spec.to_json() == text
    one, other = env.unwrapped, again.unwrapped
    assert isinstance(one, StabilityEnv)
    assert isinstance(other, StabilityEnv)
    assert bits(one.reset(seed=1)) == bits(other.reset(seed=1))
    assert bits(play(one, [0.2] * 20)) == bits(play(other, [0.2] * 20))
    assert other.nominal.mass == 380.0


def test_docstring_tells_arguments_options_info_and_states(name: str) -> None:
    text = StabilityEnv.__doc__ or ""
    words = set(re.findall(r"\w+", text))
    parameters = StabilityEnv.__init__.__annotations__.keys() - {"return"}
    assert parameters - words == set()
    assert set(INFO) <= words
    assert {"scenario", "vehicle", "friction", "state", "duration"} <= words
    assert {"v_x", "v_y", "gamma", "psi", "X", "Y", "s", "y", "theta"} <= words
    for section in ("Action", "Observation", "Record", "Reward", "Episode end", "Info", "Options"):
        assert f"## {section}" in text
