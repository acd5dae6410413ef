"""Envs with an estimator in front, and logged episodes with what their filters are made of."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import gymnasium as gym

from ...envs.record import Log
from ...estimators.protocol import UnobservableWarning
from ...estimators.wrappers.estimate import EstimateObservation, make_spec

T = TypeVar("T")
SETTLED = 2.0  # s: errors of estimates count from here on


@dataclass(frozen=True)
class LoggedEpisode:
    """Log of an episode, with the arguments of `make_estimator` that belong to it."""

    log: Log
    facts: dict[str, Any]


def make_filter_arguments(base: Any) -> dict[str, Any]:
    """Make the arguments of `make_estimator` from an env's episode.

    Args:
        base: Unwrapped env.

    Returns:
        Arguments by name, dt (s) too.
    """
    return make_spec(base)._asdict() | {"dt": base.dt}


def call_quietly(make: Callable[..., T], *args: object, **options: object) -> T:
    """Call a maker of a filter, or of an env with one, without `UnobservableWarning`.

    Args:
        make: Function to call.
        args: Its positional arguments.
        options: Its other arguments.

    Returns:
        What it returns.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnobservableWarning)
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

    Returns:
        Env, wrapped if there is an estimator.
    """
    env: gym.Env[Any, Any] = gym.make(env_id, **{"on_bad_action": "fail", **options})
    if estimator:
        env = call_quietly(EstimateObservation, env, estimator, **(estimate or {}))
    return env
