"""The algorithms of `sideslip train`, their settings, the task of a training, and distillations.

The settings in `hyperparams/`, in rl-baselines3-zoo's format, were chosen on YawVision-v0, seed 0.

Args:
    policy: Policy to train further.
    algo: Name of the algorithm, in `ALGORITHMS`.
    num_envs: Number of rows.
    seconds: Control period (s).
"""

import inspect
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from ...envs.numerics import require_extra
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.validation import check_choice, is_finite
from ..env_info import CarVectorEnv
from ..learned.policy import Policy
from ..vec_env import make_native_env
from .export import TORCH_ACTIVATIONS
from .normalise import Standardisation, Standardised

from stable_baselines3.common.base_class import BaseAlgorithm  # isort: skip
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm  # isort: skip
from stable_baselines3.common.utils import LinearSchedule  # isort: skip
from stable_baselines3.common.vec_env import VecEnv  # isort: skip

Settings = dict[str, Any]

HYPERPARAMS = Path(__file__).parent / "hyperparams"
INITIAL_ENTRY = "begun"  # the entry of training a policy further
PERIOD = 0.01  # s, control period for which the files give `gamma`

# Seeds of tests and of the calibration are below 2^63, those of `distill` beyond.
_SCALING_SEEDS, _TRAINING_SEEDS, _SEEDS_PER_TRAINING = 2**65, 2**66, 2**40
_TRAINING_SETTINGS = ("n_timesteps", "n_envs", "policy", "normalize")  # no arguments of the class
_SCHEDULED = ("learning_rate", "clip_range")  # may fall to zero, `_make_schedule`
# arguments that a file of settings may not have: the training gives them
_MANAGED_ARGUMENTS = {"env", "seed", "device", "source", "options", "verbose", "tensorboard_log",
                      "stats_window_size"}  # fmt: skip


@dataclass(frozen=True)
class Algorithm:
    """An algorithm of `sideslip train`."""

    kind: str  # class as "module:name"
    zoo: str  # name in rl-baselines3-zoo
    on_tensors: bool = False  # whether it follows gradients through cars on tensors

    def load(self) -> Callable[..., BaseAlgorithm]:
        """Import the class; ModuleNotFoundError where its package is not installed."""
        with require_extra("train", "training needs {}"):
            algorithm_class: Callable[..., BaseAlgorithm] = resolve_name(self.kind)
        return algorithm_class


ALGORITHMS = {
    "ppo": Algorithm("stable_baselines3:PPO", "ppo"),
    "sac": Algorithm("stable_baselines3:SAC", "sac"),
    "tqc": Algorithm("sb3_contrib:TQC", "tqc"),
    "recurrent-ppo": Algorithm("sb3_contrib:RecurrentPPO", "ppo_lstm"),
    "gradient": Algorithm(f"{__package__}.gradient:AnalyticPolicyGradient", "gradient", True),
}


def get_algorithm(name: str) -> Algorithm:
    """Get an algorithm.

    Args:
        name: Name in `ALGORITHMS`.
    """
    check_choice("algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def _read_settings(algo: str, env_id: str, file: str | Path | None = None) -> Settings:
    """Read an env's settings, or "default", of a YAML file, the package's own without one."""
    with require_extra("train", "settings need {}"):
        import yaml
    path = HYPERPARAMS / f"{get_algorithm(algo).zoo}.yml" if file is None else Path(file)
    try:
        entries = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path} is no YAML of settings: {text}") from None
    if not isinstance(entries, dict):
        raise ValueError(f"{path} is no YAML of settings: {{id: {{name: value}}}} is expected")
    key = env_id if env_id in entries else "default"
    if key not in entries:
        raise ValueError(f"{path} has no settings of {env_id}, and no 'default'")
    try:
        _check_settings(algo, entries[key])
    except ValueError as error:
        raise ValueError(f"{path}, {key}: {error}") from None
    return dict(entries[key])


def _check_settings(algo: str, settings: object) -> None:
    """Check that an algorithm has all settings, and that none is code instead of a value."""
    if not isinstance(settings, Mapping):
        raise ValueError(f"settings are {{name: value}}, got {settings!r}")
    arguments = inspect.signature(get_algorithm(algo).load()).parameters
    known = sorted((arguments.keys() - _MANAGED_ARGUMENTS) | set(_TRAINING_SETTINGS))
    numbers = {"n_timesteps": 0, "n_envs": 0} | {k: item.default for k, item in arguments.items()}
    for name, value in settings.items():
        if name not in known:
            raise ValueError(f"unknown option {name!r} of {algo}; known: {', '.join(known)}")
        if name.endswith("_kwargs") and not isinstance(value, Mapping):
            raise ValueError(f"{name} is {{name: value}}, which is no code to run, got {value!r}")
        if name in _SCHEDULED:
            _make_schedule(name, value)
        elif isinstance(value, str) and is_finite(numbers.get(name)):
            hint = "; YAML reads 2e6 as text, 2.0e+6 as a number" if "e" in value else ""
            raise ValueError(f"{name} is a number, got {value!r}{hint}")
    kwargs = settings.get("policy_kwargs", {})
    if replaced := [name for name in kwargs if name.startswith("features_extractor_")]:
        raise ValueError(f"{replaced[0]} is the training's own, of scaled observations")
    if "activation_fn" in kwargs and get_algorithm(algo).on_tensors:
        raise ValueError(f"the layers of {algo} are of silu: it has no activation_fn")
    check_choice("activation_fn", kwargs.get("activation_fn", "tanh"), tuple(TORCH_ACTIVATIONS))
    missing = [item for item in ("n_envs", "n_timesteps", "policy") if item not in settings]
    if missing:
        raise ValueError(f"no {', '.join(missing)}")


def _make_schedule(name: str, value: object) -> LinearSchedule | float:
    """Make a schedule that falls to zero of "lin_NUMBER", and a float of a number."""
    word, _, number = str(value).rpartition("_")
    try:
        start = float(number)
    except ValueError:
        start = math.nan
    if word not in ("", "lin") or not 0.0 < start < math.inf:
        raise ValueError(f"{name} is a positive number or lin_NUMBER, got {value!r}")
    return LinearSchedule(start, 0.0, 1.0) if word else start


@dataclass(frozen=True)
class TrainingTask:
    """The task of a training, the same when it resumes; ValueError for unknown or unfit fields."""

    env_id: str = "sideslip/YawVision-v1"  # of a native vector env
    algo: str = "ppo"  # name in `ALGORITHMS`
    estimator: str = ""  # of `EstimateObservation`, "" for none
    env_options: dict[str, Any] = field(default_factory=dict)  # of `gym.make`, in JSON types
    seed: int = 0  # of the weights, the episodes and the exploration
    num_envs: int = 0  # environments side by side; 0: the number in the settings
    scenarios: list[Any] = field(default_factory=list)  # mixture: each environment has one
    estimator_options: dict[str, Any] = field(default_factory=dict)  # of `EstimateObservation`
    settings: Settings = field(default_factory=dict)  # empty: the package's own
    n_eval_envs: int = 256  # episodes of an evaluation, side by side
    reads: list[str] = field(default_factory=list)  # entries that the network reads; empty: all

    def __post_init__(self) -> None:
        settings = self.settings or _read_settings(self.algo, self.env_id)
        _check_settings(self.algo, settings)
        object.__setattr__(self, "settings", settings)
        object.__setattr__(self, "num_envs", self.num_envs or settings["n_envs"])
        if self.seed < 0:
            raise ValueError(f"seed is at least 0, got {self.seed}")
        if self.estimator and self.algorithm.on_tensors:
            raise ValueError(f"{self.algo} reads sensors alone: no estimator runs on tensors")
        if self.estimator_options and not self.estimator:
            raise ValueError("options of an estimator need an estimator")
        for name in ("num_envs", "n_eval_envs"):
            if (count := getattr(self, name)) < 1:
                raise ValueError(f"{name} is at least 1, got {count}")
            if count < len(self.scenarios):
                wanted = f"{len(self.scenarios)} scenarios take as many environments"
                raise ValueError(f"{wanted}, got {name} {count}")
        if self.scenarios and "scenario" in self.env_options:
            text = f"and env_options have the scenario {self.env_options['scenario']!r}"
            raise ValueError(f"the scenarios of a mixture are {self.scenarios}, {text}")
        for i, scenario in enumerate(self.scenarios):
            try:
                make_scenario(scenario)
            except (TypeError, ValueError) as error:
                raise ValueError(f"scenario {i} of the mixture: {error}") from None

    @property
    def algorithm(self) -> Algorithm:
        """Algorithm of the training."""
        return get_algorithm(self.algo)

    @property
    def first_seed(self) -> int:
        """Seed of the first drive; a run's own is that plus its steps so far."""
        return _TRAINING_SEEDS + self.seed * _SEEDS_PER_TRAINING

    @property
    def scaling_seed(self) -> int:
        """Seed of the drives whose observations are scaled."""
        return _SCALING_SEEDS + self.seed

    @property
    def estimator_kwargs(self) -> dict[str, Any] | None:
        """Arguments of `EstimateObservation`, None without an estimator."""
        return self.estimator_options | {"estimator": self.estimator} if self.estimator else None

    def options(self, num_envs: int) -> dict[str, Any]:
        """Make the options of a vector env, whose rows take turns with the scenarios."""
        turns = list(itertools.islice(itertools.cycle(self.scenarios), num_envs))
        return self.env_options | ({"scenario": turns} if turns else {})

    def vector_env(self, num_envs: int) -> CarVectorEnv:
        """Make a vector env of the task with its estimator."""
        return make_native_env(self.env_id, num_envs, self.estimator_kwargs, self.options(num_envs))

    def make_model_options(self, seconds: float) -> Settings:
        """Make the arguments of the algorithm's class, in JSON types."""
        options = {k: value for k, value in self.settings.items() if k not in _TRAINING_SETTINGS}
        if "gamma" in options:  # which discounts as much in a second as in the file
            options["gamma"] = options["gamma"] ** (seconds / PERIOD)
        kind: Any = self.algorithm.load()
        rolls_out = issubclass(kind, OnPolicyAlgorithm)  # else n_steps are those of a return
        if rolls_out and "n_steps" in options and "batch_size" in options:  # it divides a rollout
            rollout = self.num_envs * options["n_steps"]
            sizes = range(1, min(options["batch_size"], rollout) + 1)
            options["batch_size"] = max(n for n in sizes if rollout % n == 0)
        return options

    def make_model(
        self, env: VecEnv, seconds: float, scaling: Standardisation, **rest: Any
    ) -> BaseAlgorithm:
        """Make an untrained model.

        Args:
            env: Environments of the training.
            seconds: Control period (s).
            scaling: Scaling of `Standardised`.
            **rest: Further arguments of the class, such as its seed.
        """
        options = self.make_model_options(seconds)
        options |= {key: _make_schedule(key, options[key]) for key in _SCHEDULED if key in options}
        kwargs = dict(options.get("policy_kwargs", {}), features_extractor_class=Standardised)
        if "activation_fn" in kwargs:
            kwargs["activation_fn"] = TORCH_ACTIVATIONS[kwargs["activation_fn"]]
        kwargs["features_extractor_kwargs"] = scaling._asdict()
        options |= {"policy_kwargs": kwargs, "stats_window_size": env.num_envs}
        return self.algorithm.load()(self.settings["policy"], env, **options, **rest)


def make_finetune_task(policy: Policy, **fields: Any) -> TrainingTask:
    """Make the task of training a policy further, from its card and its network's form.

    Args:
        policy: Policy to train further.
        fields: Fields of `TrainingTask` that replace the card's. `env_options` add to the card's, a
            scenario there replaces its mixture, and another estimator drops the card's options.
    """
    card, changes = policy.card, fields.pop("env_options", {})
    mixture = [] if "scenario" in changes else card.algorithm_options.get("scenarios", [])
    options, scenarios = card.env_options | changes, fields.pop("scenarios", mixture)
    if scenarios:
        options.pop("scenario", None)
    task_fields = dict[str, Any](env_id=card.env_id, env_options=options, scenarios=scenarios)
    if fields.get("estimator", card.estimator) == card.estimator:
        task_fields["estimator"] = card.estimator
        task_fields["estimator_options"] = dict(card.estimator_options)
    algo = fields.get("algo", "ppo")
    settings = fields.pop("settings", None) or _read_settings(algo, INITIAL_ENTRY)
    task_fields["settings"] = _add_policy_form(settings, policy, algo)
    return TrainingTask(**task_fields | fields)


def resolve_settings(file: str | Path | None, algo: str, env_id: str, initial: object) -> Settings:
    """Resolve the settings of an environment, or of training a policy further.

    Args:
        file: File of settings; None: the package's own.
        algo: Name of the algorithm.
        env_id: Id of the env.
        initial: Policy to train further, or anything else for a new training.
    """
    if not isinstance(initial, Policy):
        return _read_settings(algo, env_id, file)
    return _add_policy_form(_read_settings(algo, INITIAL_ENTRY, file), initial, algo)


def _add_policy_form(settings: Settings, policy: Policy, algo: str) -> Settings:
    """Add the form of a policy's network to settings."""
    kwargs = settings.get("policy_kwargs", {}) | get_policy_form(policy, algo)
    return settings | {"policy_kwargs": kwargs}


def get_policy_form(policy: Policy, algo: str) -> dict[str, Any]:
    """Get the `policy_kwargs` for a policy's network; ValueError where the algorithm has none."""
    network, on_tensors = policy.network, get_algorithm(algo).on_tensors
    kinds = [cell.kind for cell in network.cells]
    if algo != "ppo" and not on_tensors:
        raise ValueError(f"{algo} begins with a zip, not with policy {policy.name}")
    architecture = network.output, network.history, kinds
    if architecture != ("linear", 1, ["gru"] if on_tensors else []):
        needed = "a GRU" if on_tensors else "nothing"
        text = f"dense layers without tanh at their end, {needed} before them and no older frames"
        form = f"(output, history, cells) of {policy.name} are {architecture}"
        raise ValueError(f"{algo} goes on from {text}; {form}")
    if not on_tensors:
        return {"net_arch": list(network.hidden), "activation_fn": network.activation}
    if network.activation != "silu":
        raise ValueError(f"{algo} goes on from layers of silu, not of {network.activation}")
    return {"net_arch": list(network.hidden), "cells": network.cells[0].size}


@dataclass(frozen=True)
class DistillConfig:
    """The configuration of a student and its training.

    The auxiliary loss is that of the teacher's inputs that a student with memory does not see:
    squared errors in standard deviations, where the loss of zero actions counts 1.
    Raises ValueError for a number out of range, cells beside traces, or `told` without memory.
    """

    rounds: int = 7  # of driving and learning; in the first one the teacher drives
    epochs: int = 12  # over all drives in a round; in the last one three times as many
    cells: int = 0  # of a GRU, 0 for none
    hidden: tuple[int, ...] = (64, 64)  # sizes of the dense layers
    learning_rate: float = 3e-3  # of Adam, which falls to a fiftieth in each round
    noise: float = 0.02  # largest standard deviation of the noise on the teacher's actions
    seed: int = 0  # of weights and episodes
    batch: int = 16  # episodes of a batch, for a student with memory
    auxiliary_weight: float = 0.0  # weight of predicting the teacher's inputs it cannot see
    traces: int = 0  # SiLU units in front of the moving averages; 0: no averages

    def __post_init__(self) -> None:
        sizes = self.rounds, self.epochs, self.batch, *self.hidden
        if min(sizes) < 1 or min(self.cells, self.traces, self.seed) < 0:
            rule = "rounds, epochs and sizes are 1 at least, cells, traces and seed 0"
            raise ValueError(f"{rule}: {self}")
        if not (self.learning_rate > 0.0 and self.noise >= 0.0 and self.auxiliary_weight >= 0.0):
            raise ValueError(f"learning_rate is above zero, noise and told not below: {self}")
        if self.cells and self.traces:
            raise ValueError(f"a student has cells or traces, got {self.cells} and {self.traces}")
        if self.auxiliary_weight and not (self.cells or self.traces):
            raise ValueError("a student without memory has nothing to say: told is for those with")

    def describe(self) -> dict[str, object]:
        """Collect all numbers but the seed, in JSON types; cards call `auxiliary_weight` told."""
        numbers = asdict(self) | {"hidden": list(self.hidden)}
        numbers["told"] = numbers.pop("auxiliary_weight")
        return {name: value for name, value in numbers.items() if name != "seed"}
