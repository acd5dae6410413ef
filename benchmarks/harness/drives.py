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
    """What `make_estimator` takes of an env's running episode: `EstimatorSpec`, and dt in s."""
    return make_spec(base)._asdict() | {"dt": base.dt}


def call_quietly(make: Callable[..., T], *args: Any, **options: Any) -> T:
    """The filter, or env with a filter, that `make` returns, without `UnobservableWarning`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnobservableWarning)
        return make(*args, **options)


def make_env(
    env_id: str, estimator: str = "", estimate: Mapping[str, Any] | None = None, **options: Any
) -> gym.Env[Any, Any]:
    """An env whose bad actions end the episode, with an estimator in front ("" for none).

    estimate: options of `EstimateObservation`. options: of the env.
    """
    env: gym.Env[Any, Any] = gym.make(env_id, **{"on_bad_action": "fail", **options})
    return (
        call_quietly(EstimateObservation, env, estimator, **(estimate or {})) if estimator else env
    )
