"""The folder in which rl-baselines3-zoo leaves a training, and where its `enjoy` looks for one.

`LOGS/ALGO/ENV_N/` holds `best_model.zip`, `ENV.zip` (the last model), `evaluations.npz` (as of
stable-baselines3's `EvalCallback`) and `ENV/` with `config.yml` and `args.yml`."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..envs.io import atomic_file, write_atomic
from ..envs.numerics import require_extra
from ..envs.record import Array

EVALUATIONS = "evaluations.npz"
_WRAPPER = "sideslip.estimators.EstimateObservation"


def _make_file_name(env_id: str) -> str:
    """Make a file's name from an env's id: a dash stands for the slash."""
    return env_id.replace("/", "-")


def find_next_folder(logs: Path, algo: str, env_id: str) -> Path:
    """Find the folder of the next training.

    Args:
        logs: Folder of all trainings.
        algo: Algorithm's name in the zoo.
        env_id: Id of the env.

    Returns:
        Path LOGS/ALGO/ID_N with N above all that exist.
    """
    numbered = re.compile(re.escape(_make_file_name(env_id)) + r"_(\d+)")
    entries = (logs / algo).iterdir() if (logs / algo).is_dir() else ()
    taken = [int(match[1]) for path in entries if (match := numbered.fullmatch(path.name))]
    return logs / algo / f"{_make_file_name(env_id)}_{max(taken, default=0) + 1}"


def describe(
    folder: Path, settings: Mapping[str, object], estimator_kwargs: Mapping[str, object] | None,
    arguments: Mapping[str, Any],
) -> None:  # fmt: skip
    """Make a training's folder with the files that `enjoy` reads before it loads a model.

    Args:
        folder: Folder to make.
        settings: Settings in the zoo's format; `normalize` becomes False: the model has scales.
        estimator_kwargs: Arguments of `EstimateObservation`, or None.
        arguments: Arguments of the command line, "env" and "env_kwargs" among them.
    """
    with require_extra("train", "a folder of the zoo's needs {}"):
        import yaml
    config = dict(settings) | {"normalize": False}
    if estimator_kwargs is not None:
        config["env_wrapper"] = [{_WRAPPER: estimator_kwargs}]
    place = folder / _make_file_name(arguments["env"])
    place.mkdir(parents=True)
    for name, content in (("config.yml", config), ("args.yml", dict(arguments))):
        write_atomic(place / name, yaml.safe_dump(content).encode())


def write_evaluation(folder: Path, env_id: str, model: Any, costs: Array, lengths: Array) -> None:
    """Write an evaluation's model, costs and lengths, where the folder is the zoo's.

    Later evaluations in the file, of a training stopped before its checkpoint, are removed.

    Args:
        folder: Folder of the training.
        env_id: Id of the env.
        model: Model of stable-baselines3.
        costs: Costs J of the episodes, shape (N,).
        lengths: Steps of the episodes, shape (N,).
    """
    if not (folder / _make_file_name(env_id)).is_dir():
        return
    with atomic_file(folder / f"{_make_file_name(env_id)}.zip") as file:
        model.save(file)
    evaluation: dict[str, Any] = {"timesteps": np.array([model.num_timesteps])}
    evaluation |= {"results": -costs[None], "ep_lengths": lengths[None].astype(np.int64)}
    path = folder / EVALUATIONS
    if path.exists():
        with np.load(path, allow_pickle=False) as saved:
            before = saved["timesteps"] < model.num_timesteps
            for name, values in evaluation.items():
                evaluation[name] = np.concatenate([saved[name][before], values])
    with atomic_file(path) as file:
        np.savez(file, **evaluation)
