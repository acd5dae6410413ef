"""The task of a training, which stays the same when the training resumes."""

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
    """The task of a training, which stays the same when the training resumes.

    Attributes:
        env_id: Id of a native vector env.
        algo: Name in `ALGORITHMS`.
        estimator: Estimator of `EstimateObservation`, "" for none.
        env_options: Arguments of `gym.make`, in JSON types.
        seed: Seed of the weights, the episodes and the exploration.
        num_envs: Environments side by side; 0: the number in the settings.
        scenarios: Mixture, of which each environment has one scenario for all its episodes.
        estimator_options: Other arguments of `EstimateObservation`.
        settings: Settings of `read_settings`; empty: the package's own.
        n_eval_envs: Episodes of an evaluation, side by side.
        reads: Entries of the observation that the network reads; empty: all.

    Raises:
        ValueError: An algorithm, setting or scenario is unknown, the seed is negative, there is no
            environment or fewer than scenarios, or an estimator is set with cars on tensors.
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
        """Make the options of a vector env.

        Args:
            num_envs: Number of rows.

        Returns:
            Options by name; the rows take turns with the scenarios.
        """
        if not self.scenarios:
            return self.env_options
        turns = itertools.islice(itertools.cycle(self.scenarios), num_envs)
        return self.env_options | {"scenario": list(turns)}

    def vector_env(self, num_envs: int) -> VectorEnv[Any, Any, Any]:
        """Make a vector env of the task, apart from the one of the training.

        Args:
            num_envs: Number of rows.

        Returns:
            Vector env with the task's estimator.
        """
        options = self.options(num_envs)
        return make_native_env(self.env_id, num_envs, self.estimator_kwargs, options)

    def find_zoo_folder(self, logs: Path) -> Path:
        """Find the folder that rl-baselines3-zoo would use for the next training of this kind.

        Args:
            logs: Folder of all trainings.

        Returns:
            Path of the folder.

        Raises:
            ValueError: The zoo does not have the algorithm.
        """
        algorithm = get_algorithm(self.algo)
        if algorithm.on_tensors:
            raise ValueError(f"rl-baselines3-zoo has no {self.algo}: its folder is no use")
        return zoo.find_next_folder(logs, algorithm.zoo, self.env_id)

    def describe_for_zoo(self, folder: Path, steps: int, eval_freq: int) -> None:
        """Make a folder of `find_zoo_folder` with the files of the zoo's `enjoy`.

        Args:
            folder: Folder to make.
            steps: Steps of the training.
            eval_freq: Steps between two evaluations.
        """
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
