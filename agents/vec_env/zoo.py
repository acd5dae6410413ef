"""The folder in which rl-baselines3-zoo leaves a training, and where its `enjoy` looks for one.

`LOGS/ALGO/ENV_N/` holds `best_model.zip`, `ENV.zip` (the last model), `evaluations.npz` (as
stable-baselines3's `EvalCallback` writes it) and `ENV/` with `config.yml` and `args.yml`; in ENV a
dash stands for the id's slash.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...envs.backend.extras import require_extra
from ...envs.backend.files import atomic_file, write_atomic
from ...envs.record import Array

EVALUATIONS = "evaluations.npz"
WRAPPER = "sideslip.estimators.EstimateObservation"


def make_file_name(env_id: str) -> str:
    """The id as a file's name."""
    return env_id.replace("/", "-")


def find_next_folder(logs: Path, algo: str, env_id: str) -> Path:
    """Where the next training belongs; algo: as the zoo calls it."""
    numbered = re.compile(re.escape(make_file_name(env_id)) + r"_(\d+)")
    entries = (logs / algo).iterdir() if (logs / algo).is_dir() else ()
    taken = [int(match[1]) for path in entries if (match := numbered.fullmatch(path.name))]
    return logs / algo / f"{make_file_name(env_id)}_{max(taken, default=0) + 1}"


def describe(
    folder: Path, settings: Mapping[str, Any], estimator_kwargs: Any, arguments: Mapping[str, Any]
) -> None:
    """Make the folder, with all that `enjoy` asks for before it loads a model.

    settings: in the zoo's format; `normalize` is none of the model's, whose scales are its own.
    estimator_kwargs: arguments of `EstimateObservation`, or None. arguments: of the command line,
    "env" and "env_kwargs" among them. All in JSON types.
    """
    with require_extra("train", "a folder of the zoo's needs {}"):
        import yaml
    config = dict(settings) | {"normalize": False}
    if estimator_kwargs is not None:
        config["env_wrapper"] = [{WRAPPER: estimator_kwargs}]
    place = folder / make_file_name(arguments["env"])
    place.mkdir(parents=True)
    for name, content in (("config.yml", config), ("args.yml", dict(arguments))):
        write_atomic(place / name, yaml.safe_dump(content).encode())


def write_evaluation(folder: Path, env_id: str, model: Any, costs: Array, lengths: Array) -> None:
    """Keep an evaluation's model and its episodes' costs and steps, where the folder is the zoo's.

    A later evaluation than this one, of a training that was stopped before its checkpoint, goes.
    """
    if not (folder / make_file_name(env_id)).is_dir():
        return
    with atomic_file(folder / f"{make_file_name(env_id)}.zip") as file:
        model.save(file)
    evaluation: dict[str, Any] = {
        "timesteps": np.array([model.num_timesteps]),
        "results": -costs[None],
        "ep_lengths": lengths[None].astype(np.int64),
    }
    path = folder / EVALUATIONS
    if path.exists():
        with np.load(path, allow_pickle=False) as saved:
            before = saved["timesteps"] < model.num_timesteps
            evaluation = {
                name: np.concatenate([saved[name][before], evaluation[name]]) for name in evaluation
            }
    with atomic_file(path) as file:
        np.savez(file, **evaluation)
