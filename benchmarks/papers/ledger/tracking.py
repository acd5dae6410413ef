"""dakf-stability Fig. 7: do steering and yaw moment make the car follow its reference model?"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ....agents import make_agent
from ....agents.rollout import Rollout, rollout
from ....envs.scenarios.scenario import Scenario
from ....estimators.estimates import UnobservableWarning
from ....estimators.wrappers.estimate import EstimateObservation

Array = npt.NDArray[np.float64]
Manoeuvre = str | Mapping[str, Any] | Scenario

ENV_ID = "sideslip/AfsYawFusion-v0"
STATES = ("beta", "gamma", "d1", "d2")


@dataclass(frozen=True)
class Tracking:
    """How closely an episode followed its reference.

    rms_beta (rad), rms_gamma (rad/s): of the error, over all ticks. peak_beta (rad): of the slip
    itself. saturated: share of the ticks that ask for the whole yaw moment. steered: the largest
    share of the steering's authority that was asked for.
    """

    rms_beta: float
    rms_gamma: float
    peak_beta: float
    saturated: float
    steered: float
    failed: bool


def drive(
    seed: int,
    scenario: Manoeuvre = "dakf-fig7",
    agent: str = "model-following",
    estimator: str = "dakf",
    **options: Any,
) -> Rollout:
    """An episode at 1 ms with GPS, gyro and camera on board; the estimator uses the GPS.

    agent: "none" is the steer-by-wire car without control. options: of the agent (`bandwidth`,
    `rejection`).
    """
    env: gym.Env[Any, Any] = gym.make(
        ENV_ID, scenario=scenario, control_period=1, on_bad_action="fail"
    )
    with warnings.catch_warnings():  # what dakf cannot see is a claim of its own
        warnings.simplefilter("ignore", UnobservableWarning)
        env = EstimateObservation(env, estimator, outputs=STATES, options={"slow": "gps"})
    return rollout(env, make_agent(agent, env, **options), seed)


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def tracking(episode: Rollout) -> Tracking:
    """The numbers of an episode of `drive`."""
    moment, steering = np.abs(episode["action_0"]), np.abs(episode["action_1"])
    return Tracking(
        rms_beta=_rms(episode["beta"] - episode["beta_ref"]),
        rms_gamma=_rms(episode["gamma"] - episode["gamma_ref"]),
        peak_beta=float(np.abs(episode["beta"]).max()),
        saturated=float(np.mean(moment >= 1.0)),
        steered=float(steering.max()),
        failed=episode.failed,
    )
