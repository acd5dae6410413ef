"""Envs with an estimator in front, and recorded episodes for estimators."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import gymnasium as gym

from ...envs.record import Log
from ...estimators.estimates import UnobservableWarning
from ...estimators.wrappers.arguments import make_spec
from ...estimators.wrappers.estimate import EstimateObservation

T = TypeVar("T")

SETTLED = 2.0  # s: errors of estimates count from here on


@dataclass(frozen=True)
class LoggedEpisode:
    """An episode's log, and the arguments of `make_estimator` that belong to it."""

    log: Log
    facts: dict[str, Any]


def make_filter_arguments(base: Any) -> dict[str, Any]:
    """Make the arguments of `make_estimator` from an env's running episode.

    Args:
        base: Unwrapped env.

    Returns:
        Fields of `EstimatorSpec`, and dt (s).
    """
    return make_spec(base)._asdict() | {"dt": base.dt}


def call_quietly(make: Callable[..., T], *args: Any, **options: Any) -> T:
    """Call a maker of a filter, or of an env with one, without `UnobservableWarning`.

    Args:
        make: Function to call.
        args: Positional arguments.
        options: Keyword arguments.

    Returns:
        What the maker returns.
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
    return (
        call_quietly(EstimateObservation, env, estimator, **(estimate or {})) if estimator else env
    )
