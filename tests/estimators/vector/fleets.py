"""Vector environments whose rows end at different times, and their comparison bit for bit."""

import functools
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv

import sideslip  # noqa: F401  registers the environments
from sideslip.envs import COMS
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.sensors.slow import CAMERA_33_30, GPS_5_HZ
from sideslip.estimators import FILTERS, make_estimator
from sideslip.estimators.core.filter import Observed, OutputTable, StepRecord
from sideslip.estimators.vector.batch import build_batch
from sideslip.estimators.vector.estimate import EstimateObservation
from sideslip.estimators.wrappers.estimate import EstimateObservation as Single
from sideslip.estimators.wrappers.estimate import EstimatorSpec
from tests.envs.batches import SHORT, actions, same

VISION, UNEVEN, GPS = (f"sideslip/Yaw{kind}-v0" for kind in ("Vision", "VisionUneven", "Gps"))
MODES = ("NextStep", "SameStep")
CLOCKS = {"camera": CAMERA_33_30, "gps": GPS_5_HZ}
BAD = np.float32(np.nan)  # fails an episode


def home(name: str) -> tuple[str, str]:
    """An id whose sensors a filter can use, and the sensor's name."""
    slow = FILTERS[name].slow
    return (GPS, "gps") if slow and "camera" not in slow else (VISION, "camera")


def make_batch(
    name: Any, count: int, vehicle: Any = COMS, sensors: Any = None, speed: Any = None,
    dt: float = TICK, **options: Any,
) -> Any:  # fmt: skip
    """Filters side by side, reset to tick 0; a list has what each one is told."""
    told = vehicle, sensors or {}, speed
    lists = [each if isinstance(each, list) else [each] * count for each in told]
    batch = build_batch(name, list(map(EstimatorSpec, *lists)), dt, options)
    batch.reset(np.ones(count, np.bool_))
    return batch


def step(batch: Any, fast: Any, packets: Any, counts: Any = None, rows: Any = None) -> None:
    """Give each filter its rows and packets, all of them or so many."""
    N, obs = len(batch), np.zeros((len(batch), 0), np.float32)
    record = [np.ascontiguousarray(each, np.float64) for each in (fast, packets)]
    told = zip((rows, counts), record, strict=True)
    numbers = [np.full(N, x.shape[1]) if each is None else np.array(each) for each, x in told]
    table = OutputTable(0, np.zeros((0, 3), np.int64), np.zeros(0))
    observed = Observed(obs, table, np.zeros(N), np.zeros(N), obs, np.zeros((N, 4)))
    batch.take(None, StepRecord(record[0], numbers[0], record[1], numbers[1]), observed)


def states(batch: Any) -> Any:
    return np.array([each.x for each in batch])


def covariances(batch: Any) -> Any:
    return np.array([each.P for each in batch])


def outputs(name: str) -> list[str]:
    """The first and the last state of a filter (of its second layer, if it has one)."""
    _, sensor = home(name)
    states = make_estimator(name, sensors={sensor: CLOCKS[sensor]}).names
    return [states[0], states[-1]]


def fleet(
    env_id: str, count: int, mode: str, wrap: Any = None,
    changes: Sequence[dict[str, Any]] | None = None, **kwargs: Any,
) -> SyncVectorEnv[Any, Any]:  # fmt: skip
    """Environments whose episodes have different lengths, up to a quarter of a second."""

    def made(i: int) -> Any:
        scenario = {"base": "random-steering", "duration": 0.09 + 0.02 * i}
        own = changes[i % len(changes)] if changes else {}
        told = {"scenario": scenario, "on_bad_action": "fail"} | kwargs | own
        env = gym.make(env_id, **told)
        return env if wrap is None else wrap(env)

    return SyncVectorEnv([functools.partial(made, i) for i in range(count)], autoreset_mode=mode)


def pair(
    env_id: str, count: int, mode: str, layers: Sequence[dict[str, Any]], **kwargs: Any
) -> tuple[Any, Any]:
    """The environments wrapped one by one, and the same ones wrapped together."""

    def wrap(env: Any, kind: Any) -> Any:
        for layer in layers:
            env = kind(env, **layer)
        return env

    alone = fleet(env_id, count, mode, functools.partial(wrap, kind=Single), **kwargs)
    return alone, wrap(fleet(env_id, count, mode, **kwargs), EstimateObservation)


def native(mode: str, count: int = 3, **arguments: Any) -> Any:
    """The vector env, whose bad actions end episodes."""
    told = {"scenario": SHORT, "on_bad_action": "fail", "autoreset_mode": mode}
    return gym.make_vec(VISION, num_envs=count, **(told | arguments))


def drive_both(alone: Any, together: Any, steps: int, start: int = 0, seed: Any = None) -> int:
    """Step both, after a reset with a seed, and compare everything; the episodes that ended."""
    ended = 0
    if seed is not None:
        same(alone.reset(seed=seed), together.reset(seed=seed))
    for step in range(start, start + steps):
        told = actions(alone, step)
        one, other = alone.step(told), together.step(told)
        same(one, other)
        ended += int(np.logical_or(one[2], one[3]).sum())
    return ended
