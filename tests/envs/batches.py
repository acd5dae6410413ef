"""The vector env beside a `SyncVectorEnv` of single ones, and their comparison bit for bit."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv

from sideslip.envs import StabilityEnv, StabilityVectorEnv

from .helpers import bits

MODES = ("NextStep", "SameStep")
SHORT: dict[str, Any] = {"base": "random-steering", "duration": 0.25}


def batch(env_id: str, count: int, **arguments: Any) -> StabilityVectorEnv:
    """The vector env of an id."""
    env = gymnasium.make_vec(env_id, num_envs=count, **arguments)
    assert isinstance(env, StabilityVectorEnv)
    return env


def sync(env_id: str, count: int, mode: str, **arguments: Any) -> SyncVectorEnv[Any, Any]:
    """The same of single environments."""
    how: dict[str, Any] = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    env = gymnasium.make_vec(env_id, num_envs=count, **how, **arguments)
    assert isinstance(env, SyncVectorEnv)
    return env


def pair(
    env_id: str, count: int, mode: str = "NextStep", **arguments: Any
) -> tuple[SyncVectorEnv[Any, Any], StabilityVectorEnv]:
    """Both; their bad actions end episodes."""
    told = {"scenario": SHORT, "on_bad_action": "fail"} | arguments
    return sync(env_id, count, mode, **told), batch(env_id, count, autoreset_mode=mode, **told)


def plain(value: Any) -> Any:
    """Bits, with the objects of `final_obs` taken out of their array."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, tuple):
        return tuple(map(plain, value))
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        return bits(value.tolist())
    return bits(value)


def same(one: Any, other: Any) -> None:
    """What a reset or a step returned is the same."""
    for first, second in zip(one[:-1], other[:-1], strict=True):
        assert bits(first) == bits(second)
    assert one[-1].keys() == other[-1].keys()
    for key in one[-1]:
        assert plain(one[-1][key]) == plain(other[-1][key]), key


def same_cars(alone: SyncVectorEnv[Any, Any], together: StabilityVectorEnv) -> None:
    """The records, vehicles, sensors, motions and scenarios are the same, row by row."""
    for i, env in enumerate(alone.envs):
        car = env.unwrapped
        assert isinstance(car, StabilityEnv)
        assert bits(car.record) == bits(together.record[i])
        assert bits(np.array(car.motion)) == bits(together.motion[i])
        for name in ("vehicle", "nominal", "held_speed", "slow_sensors", "scenario"):
            assert getattr(car, name) == getattr(together, name)[i], name
        states = [each.bit_generator.state for each in (car.np_random, together.np_random[i])]
        assert states[0] == states[1]


def actions(env: Any, step: int) -> Any:
    """Any actions, now and then a bad one, which ends a row's episode at once."""
    shape = env.action_space.shape
    drawn = np.random.default_rng(step).uniform(-1.2, 1.2, shape).astype(np.float32)
    if step % 7 == 6:
        drawn[step % len(drawn), -1] = np.nan
    return drawn


def drive(alone: Any, together: Any, steps: int, start: int = 0) -> int:
    """Step both and compare everything; how many episodes ended."""
    ended = 0
    for step in range(start, start + steps):
        told = actions(alone, step)
        one, other = alone.step(told), together.step(told)
        same(one, other)
        ended += int(np.logical_or(one[2], one[3]).sum())
        if step % 16 == 0:
            same_cars(alone, together)
    return ended
