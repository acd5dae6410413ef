"""Envs with an estimator in front, logged episodes, their filters and their drawn steering."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import gymnasium as gym
import numpy as np

from ...agents.rollout import iterate_steps
from ...envs.record import Array, Log, concatenate
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.assemble import assemble
from ...estimators.design.config import parse_config
from ...estimators.estimator import Estimator
from ...estimators.filters import FILTERS
from ...estimators.protocol import UnobservableWarning
from ...estimators.wrappers.estimate import EstimateObservation, make_spec

T = TypeVar("T")
SETTLED = 2.0  # s: errors of estimates count from here on


class LoggedEpisode(NamedTuple):
    """Log of an episode, with the arguments of `make_estimator` that belong to it."""

    log: Log
    facts: dict[str, Any]


def make_filter_arguments(base: Any) -> dict[str, Any]:
    """Make the arguments of `make_estimator` by name, dt (s) too, from an env's episode.

    Args:
        base: Unwrapped env.
    """
    return make_spec(base)._asdict() | {"dt": base.dt}


def record_drive(env: gym.Env[Any, Any], seed: int) -> Log:
    """Record an uncontrolled drive with its true sideslip, without `rollout`'s columns, for speed.

    Args:
        env: Env of one car.
        seed: Seed of the reset.
    """
    base: Any = env.unwrapped
    records, times, slips = [], [], []
    for step in iterate_steps(env, None, seed):
        records.append(base.record)
        times.append(step.info["t"])
        slips.append(step.info["beta"])
    record = concatenate(records)
    truth = {"beta": np.interp(record.ticks * record.dt, times, slips)}
    return Log(record, base.slow_sensors, truth)


def make_unchecked_filter(
    name: str, log: Log, vehicle: Vehicle, options: Mapping[str, object]
) -> Estimator:
    """Make a filter for a log without the check of stability, which costs ten runs.

    Args:
        name: Name of the filter.
        log: Log, of which it takes all slow sensors.
        vehicle: Car that it assumes.
        options: Options over its defaults.
    """
    known: dict[str, object] = {"slow": list(log.slow) or None}
    known |= {} if "accel_y" in log.record.present else {"fast": ("gyro",)}
    config = parse_config(name, FILTERS[name], log.slow, known | dict(options))
    return Estimator(config, log.record.dt, *assemble(config, vehicle, log.record.dt, None))


def draw_steering(rng: np.random.Generator, amplitude: float, duration: float) -> Array:
    """Draw steering angles (rad), shape (n,), every 10 ms: sines, and plateaus begun within 0.25 s.

    Args:
        rng: Generator.
        amplitude: Size of the angle (rad).
        duration: Duration (s).
    """
    time = np.arange(round(duration / 0.01)) * 0.01
    angle = np.zeros(len(time))
    for share, frequency, phase in rng.uniform((0.1, 0.08, 0.0), (0.5, 0.9, 6.28), (3, 3)):
        angle += amplitude * share * np.sin(2.0 * np.pi * frequency * time + phase)
    plateaus, start = np.zeros(len(time)), 0
    while start < len(time):
        end = start + int(rng.uniform(80, 300))
        plateaus[start:end] = amplitude * rng.choice([0.0, 0.0, rng.uniform(-0.8, 0.8)])
        start = end
    angle += np.convolve(plateaus, np.full(25, 1.0 / 25.0), "same")
    return np.asarray(angle * np.minimum(1.0, time / 0.5))


def call_quietly(make: Callable[..., T], *args: object, **options: object) -> T:
    """Call a maker of a filter, or of an env with one, without `UnobservableWarning`.

    Args:
        make: Function to call.
        args: Its positional arguments.
        options: Its other arguments.
    """
    with warnings.catch_warnings(action="ignore", category=UnobservableWarning):
        return make(*args, **options)


def make_env(
    env_id: str, estimator: str = "", estimate: Mapping[str, Any] | None = None, **options: Any
) -> gym.Env[Any, Any]:
    """Make an env whose bad actions end the episode, with an estimator in front.

    Args:
        env_id: Id of the env.
        estimator: Name of the estimator, "" for none.
        estimate: Other arguments of `EstimateObservation`.
        options: Arguments of the env.
    """
    env: gym.Env[Any, Any] = gym.make(env_id, **{"on_bad_action": "fail", **options})
    if estimator:
        env = call_quietly(EstimateObservation, env, estimator, **(estimate or {}))
    return env
