"""tie-vision Fig. 8: who drives the lane change, each with an estimator told its camera's noise."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from ....envs.scenarios.manoeuvres import scenario_from
from ....estimators.wrappers.estimate import EstimateObservation

ENV_ID = "sideslip/YawVision-v0"


@dataclass(frozen=True)
class Contestant:
    """A controller with the estimator it reads ("" where it reads none)."""

    label: str
    agent: str
    estimator: str = ""
    rate: str | None = None


CONTESTANTS = (
    Contestant("none", "none"),
    Contestant("feedforward", "feedforward"),
    Contestant("single-rate", "two-dof", "single-rate-kf", "camera"),
    Contestant("multirate", "two-dof", "multirate-kf", "control"),
    Contestant("multirate-residual", "two-dof", "multirate-residual-kf", "control"),
)
_TOLD = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}


def told_noise(scenario: str) -> dict[str, float]:
    """The scenario's camera noise as options of an estimator: a filter knows its sensors."""
    noise = scenario_from(scenario).noise
    return {told: noise[name] for name, told in _TOLD.items() if name in noise}


def make_env(scenario: str, contestant: Contestant) -> gym.Env[Any, Any]:
    """The env of a contestant: 1 ms control, its estimator in front."""
    env: gym.Env[Any, Any] = gym.make(
        ENV_ID, scenario=scenario, control_period=1, on_bad_action="fail"
    )
    if contestant.estimator:
        env = EstimateObservation(env, contestant.estimator, options=told_noise(scenario))
    return env
