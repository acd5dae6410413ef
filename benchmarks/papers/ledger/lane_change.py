"""tie-vision Fig. 8: the drivers of the lane change, each with a filter of its camera's noise."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from ....envs.scenarios.manoeuvres import scenario_from
from ...harness import drives

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
_OPTIONS = {"camera_psi": "psi_noise", "camera_y": "y_l_noise"}


def camera_noise(scenario: str) -> dict[str, float]:
    """The scenario's camera noise as options of an estimator: a filter knows its sensors."""
    noise = scenario_from(scenario).noise
    return {option: noise[name] for name, option in _OPTIONS.items() if name in noise}


def make_env(scenario: str, contestant: Contestant) -> gym.Env[Any, Any]:
    """The env of a contestant: 1 ms control, its estimator in front."""
    estimate = {"options": camera_noise(scenario)}
    options: dict[str, Any] = {"scenario": scenario, "control_period": 1}
    return drives.make_env(ENV_ID, contestant.estimator, estimate, **options)
