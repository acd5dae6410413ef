"""What a training is of: it stays the same when it goes on."""

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv

from ...envs.scenarios.manoeuvres import make_scenario
from ..vec_env import zoo
from ..vec_env.env import make_native_env
from .algorithms import Settings, check_settings, get_algorithm, read_settings


@dataclass(frozen=True)
class TrainingTask:
    """What is trained: it stays the same when a training goes on.

    env_id: of a native vector env. algo: a name of `ALGORITHMS`. estimator: of
    `EstimateObservation`, "" for none, and estimator_options its other arguments. env_options: of
    `gym.make`; JSON types. seed: of the weights, the episodes and the exploration. num_envs: side
    by side, 0: as many as the settings say. scenarios: a mixture, which the environments have in
    turn, each one for all its episodes. settings: of `read_settings`; empty: the package's own.
    n_eval_envs: episodes of an evaluation, side by side. reads: names of the observation's entries
    that the network reads, empty: all of them.

    Raises ValueError for an unknown algorithm, setting or scenario, a negative seed, no
    environment, fewer of them than scenarios, or an estimator where cars are driven on tensors.
    """

    env_id: str = "sideslip/YawVision-v0"
    algo: str = "ppo"
    estimator: str = ""
    env_options: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    num_envs: int = 0
    scenarios: list[Any] = field(default_factory=list)
    estimator_options: dict[str, Any] = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)
    n_eval_envs: int = 256
    reads: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings = self.settings or read_settings(self.algo, self.env_id)
        check_settings(self.algo, settings)
        object.__setattr__(self, "settings", settings)
        object.__setattr__(self, "num_envs", self.num_envs or settings["n_envs"])
        if self.seed < 0:
            raise ValueError(f"seed is at least 0, got {self.seed}")
        for name in ("num_envs", "n_eval_envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is at least 1, got {getattr(self, name)}")
        if self.estimator and get_algorithm(self.algo).on_tensors:
            raise ValueError(f"{self.algo} reads sensors alone: no estimator runs on tensors")
        if self.estimator_options and not self.estimator:
            raise ValueError("options of an estimator need an estimator")
        for name in ("num_envs", "n_eval_envs"):
            if getattr(self, name) < len(self.scenarios):
                raise ValueError(
                    f"an environment has one scenario for all its episodes: {len(self.scenarios)} "
                    f"scenarios take as many environments, got {name} {getattr(self, name)}"
                )
        for i, scenario in enumerate(self.scenarios):
            try:
                make_scenario(scenario)
            except (TypeError, ValueError) as error:
                raise ValueError(f"scenario {i} of the mixture: {error}") from None

    @property
    def estimator_kwargs(self) -> dict[str, Any] | None:
        """Arguments of `EstimateObservation`, None without an estimator."""
        return self.estimator_options | {"estimator": self.estimator} if self.estimator else None

    def options(self, num_envs: int) -> dict[str, Any]:
        """Options of a vector env of so many rows."""
        if not self.scenarios:
            return self.env_options
        turns = itertools.islice(itertools.cycle(self.scenarios), num_envs)
        return self.env_options | {"scenario": list(turns)}

    def vector_env(self, num_envs: int) -> VectorEnv[Any, Any, Any]:
        """Another vector env of the task, not the one that is trained on."""
        options = self.options(num_envs)
        return make_native_env(self.env_id, num_envs, self.estimator_kwargs, options)

    def find_zoo_folder(self, logs: Path) -> Path:
        """Where rl-baselines3-zoo would leave the next training of this kind; ValueError for an
        algorithm that it has not."""
        algorithm = get_algorithm(self.algo)
        if algorithm.on_tensors:
            raise ValueError(f"rl-baselines3-zoo has no {self.algo}: its folder is no use")
        return zoo.find_next_folder(logs, algorithm.zoo, self.env_id)

    def describe_for_zoo(self, folder: Path, steps: int, eval_freq: int) -> None:
        """Make a folder of `find_zoo_folder` with what the zoo's `enjoy` reads; of a mixture it
        drives the first."""
        first = {"scenario": self.scenarios[0]} if self.scenarios else {}
        arguments = {
            "algo": get_algorithm(self.algo).zoo,
            "env": self.env_id,
            "env_kwargs": self.env_options | first,
            "eval_freq": eval_freq,
            "n_eval_envs": self.n_eval_envs,
            "n_timesteps": steps,
            "seed": self.seed,
        }
        zoo.describe(
            folder, self.settings | {"n_envs": self.num_envs}, self.estimator_kwargs, arguments
        )
