"""dakf-stability Fig. 7: do steering and yaw moment make the car follow its reference model?"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ....agents import make_agent
from ....agents.rollout import Rollout, rollout
from ....envs.scenarios.scenario import Scenario
from ...harness.drives import make_env
from .filters import get_paper_tuning
from .simulations import rms

Manoeuvre = str | Mapping[str, Any] | Scenario

ENV_ID = "sideslip/AfsYawFusion-v0"
STATES = ("beta", "gamma", "d1", "d2")


@dataclass(frozen=True)
class Tracking:
    """The errors of an episode from its reference.

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


def run_episode(
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
    tuned = dict(get_paper_tuning(estimator))
    estimate = {"outputs": STATES, "options": {"slow": "gps"} | tuned}
    env = make_env(ENV_ID, estimator, estimate, scenario=scenario, control_period=1)
    return rollout(env, make_agent(agent, env, **options), seed)


def measure_tracking(episode: Rollout) -> Tracking:
    """The numbers of an episode of `run_episode`."""
    moment, steering = np.abs(episode["action_0"]), np.abs(episode["action_1"])
    return Tracking(
        rms_beta=rms(episode["beta"] - episode["beta_ref"]),
        rms_gamma=rms(episode["gamma"] - episode["gamma_ref"]),
        peak_beta=float(np.abs(episode["beta"]).max()),
        saturated=float(np.mean(moment >= 1.0)),
        steered=float(steering.max()),
        failed=episode.failed,
    )
