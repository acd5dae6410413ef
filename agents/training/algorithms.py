"""The algorithms of `sideslip train`: stable-baselines3's, with settings that learn here.

The settings were chosen on YawVision-v0 (seed 0, 600,000 steps, about 20 CPU-s; mean cost over
none's on 256 drives). With a step size of 1e-3: rewards as they come and a horizon of 0.5 s 0.22,
times ten 0.18, with 0.2 s 0.16, rewards per second (times a hundred) 0.13. A step size of 2e-3
0.125; then 0.12 after three times the steps. Worse were a horizon of 0.1 s, 16 steps a rollout, a
first deviation of 0.14; running normalisation was no better and costs 0.2 ms a step of 256.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from stable_baselines3 import PPO  # isort: skip
from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.utils import LinearSchedule  # isort: skip
from stable_baselines3.common.vec_env import VecEnv  # isort: skip
from torch import nn  # isort: skip

from .normalise import Standardised  # first: it says which extra is missing

HORIZON = 0.2
"""s, in which a reward's weight falls to 1/e: the car answers a yaw moment within a tenth."""


@dataclass(frozen=True)
class Algorithm:
    """A class of stable-baselines3, the step size it begins with, and its other settings.

    batch: at most so many samples of a rollout at once. hidden: sizes of the layers. log_std: of
    the first actions' deviation.
    """

    kind: Callable[..., BaseAlgorithm]
    learning_rate: float
    batch: int
    settings: dict[str, Any] = field(default_factory=dict)
    hidden: tuple[int, ...] = (64, 64)
    log_std: float = -1.0

    def options(self, seconds: float, num_envs: int) -> dict[str, Any]:
        """Further arguments of the class, from a control period and a number of environments."""
        rollout = num_envs * self.settings["n_steps"]
        return {
            **self.settings,
            "gamma": math.exp(-seconds / HORIZON),
            "batch_size": max(n for n in range(1, self.batch + 1) if rollout % n == 0),
        }

    def described(self, seconds: float, num_envs: int) -> dict[str, Any]:
        """All settings, in JSON types, for a card."""
        return {
            **self.options(seconds, num_envs),
            "num_envs": num_envs,
            "learning_rate": f"{self.learning_rate} to 0",
            "hidden": list(self.hidden),
            "log_std_init": self.log_std,
        }

    def make(
        self, env: VecEnv, seconds: float, scaling: tuple[list[float], list[float]], seed: int
    ) -> BaseAlgorithm:
        """An untrained model. seconds: of a control period. scaling: mean and scale of entries."""
        mean, scale = scaling
        return self.kind(
            "MlpPolicy",
            env,
            learning_rate=LinearSchedule(self.learning_rate, 0.0, 1.0),
            policy_kwargs={
                "net_arch": list(self.hidden),
                "activation_fn": nn.Tanh,
                "log_std_init": self.log_std,
                "features_extractor_class": Standardised,
                "features_extractor_kwargs": {"mean": mean, "scale": scale},
            },
            stats_window_size=env.num_envs,
            seed=seed,
            device="cpu",
            **self.options(seconds, env.num_envs),
        )


ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(PPO, 2e-3, 1024, {"n_steps": 32, "n_epochs": 4}),
}


def algorithm_of(name: str) -> Algorithm:
    """An algorithm by its name; ValueError for another."""
    if name not in ALGORITHMS:
        raise ValueError(f"unknown algorithm {name!r}; known: {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]
