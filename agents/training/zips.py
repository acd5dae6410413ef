"""Zips of stable-baselines3 and sb3-contrib as policies; reading one can run code.

A zip holds pickles, and unpickling runs the code in them. So nothing is read without `trust`, and
`export_zip` writes a file that is read without it.
"""

import json
import pickle
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import gymnasium as gym

from ...envs.task.observation import ObservationEntry, make_space
from ...estimators.wrappers.estimate import EstimateObservation
from ..env_facts import AnyEnv, get_env_facts
from ..learned.card import Card
from ..learned.files import SUFFIX, Policy, save_policy
from .export import convert_sb3_policy, find_actor_reader

_NEEDED = ("policy_class", "policy_kwargs", "observation_space", "action_space")
_MEMBERS = {"data", "policy.pth"}
_NORMALISER = "vecnormalize.pkl"


def policy_from_zip(
    path: str | Path,
    env: AnyEnv,
    *,
    trust: bool = False,
    normalise: str | Path | None = None,
    **about: Any,
) -> Policy:
    """Read the deterministic actor of a stable-baselines3 zip, for the env of its training.

    A policy trained on a VecFrameStack around the env has that many frames of history.

    Args:
        path: Path of the zip.
        env: Env, single or vector, whose observation names the zip's numbered entries.
        trust: Whether code in the zip may run.
        normalise: Pickle of the training's VecNormalize; None: NAME.pkl or vecnormalize.pkl beside
            the zip, if there is one.
        about: Fields of the policy's `Card`.

    Returns:
        Policy of the actor.

    Raises:
        FileNotFoundError: There is no such file.
        PermissionError: `trust` is False.
        ValueError: The file is no such zip, its policy has another observation, or
            `convert_sb3_policy` refuses it.
        ModuleNotFoundError: stable-baselines3 is not installed.
    """
    file = Path(path)
    check_trusted(file, trust)
    content, weights = _read(file)
    policy = _build_policy(file, content, weights)
    frames = _count_frames(file, policy.observation_space, get_env_facts(env).layout)
    normaliser_file = find_normaliser(file, normalise)
    normaliser = None if normaliser_file is None else load_normaliser(normaliser_file)
    network = convert_sb3_policy(policy, normaliser, frames)
    described = {
        "algorithm": f"stable-baselines3's {type(policy).__name__}",
        "steps": int(content.get("num_timesteps", 0)),
    }
    return Policy(file.stem, network, Card.from_env(env, **{"env_id": "", **described, **about}))


def export_zip(
    path: str | Path,
    target: str | Path,
    env_id: str,
    env_options: Mapping[str, Any] | None = None,
    estimator: str = "",
    *,
    trust: bool = False,
    normalise: str | Path | None = None,
    command: str = "",
) -> Policy:
    """Export a zip's actor to a policy's file, which runs no code where it is read.

    Args:
        path: Path of the zip.
        target: Path of the policy's file.
        env_id: Id of the training's env.
        env_options: Arguments of `gym.make` for that env.
        estimator: Estimator of the training, "" for none.
        trust: Whether code in the zip may run.
        normalise: Pickle of VecNormalize, as for `policy_from_zip`.
        command: Command line, for the card.

    Returns:
        Policy as it is in the file.

    Raises:
        ValueError: The target has another ending; or as `policy_from_zip` and `save_policy`.
        PermissionError: `trust` is False.
    """
    check_trusted(Path(path), trust)
    if Path(target).suffix != SUFFIX:
        raise ValueError(f"a policy's file is NAME{SUFFIX}, got {target}")
    options = dict(env_options or {})
    env: gym.Env[Any, Any] = gym.make(env_id, **options)
    if estimator:
        env = EstimateObservation(env, estimator)
    about = {"env_id": env_id, "env_options": options, "estimator": estimator, "command": command}
    policy = policy_from_zip(path, env, trust=trust, normalise=normalise, **about)
    env.close()
    save_policy(target, policy.network, policy.card)
    return replace(policy, name=Path(target).stem)


def find_normaliser(path: Path, normalise: str | Path | None = None) -> Path | None:
    """Find the pickle of a zip's VecNormalize: the argument, else one beside the zip, else None.

    Args:
        path: Path of the zip.
        normalise: Path of the pickle, None to look for it.

    Returns:
        Path of the pickle.
    """
    if normalise is not None:
        return Path(normalise)
    candidates = (
        path.with_suffix(".pkl"),
        path.with_name(_NORMALISER),
        path.with_suffix("") / _NORMALISER,  # where rl-baselines3-zoo puts it
    )
    return next((file for file in candidates if file.is_file()), None)


def check_trusted(file: Path, trust: bool) -> None:
    """Check that a zip may be unpickled.

    Args:
        file: Path of the zip.
        trust: Whether code in the zip may run.

    Raises:
        PermissionError: `trust` is False.
        ValueError: As `check_zip`.
    """
    check_zip(file)
    if not trust:
        raise PermissionError(
            f"{file} holds pickles: reading them runs whatever code its maker put there. If you "
            f"trust it, say --trust (trust=True); `sideslip export {file} --trust` makes a file "
            "of it that cannot run code"
        )


def check_zip(file: Path) -> None:
    """Check a zip by its list of members, before anything in it is read.

    Args:
        file: Path of the zip.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no zip of stable-baselines3.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{file}: {'a folder' if file.is_dir() else 'no such file'}")
    try:
        with ZipFile(file) as archive:
            missing = _MEMBERS - set(archive.namelist())
    except BadZipFile as error:
        raise ValueError(f"{file} is no zip, or is cut short: {error}") from None
    if missing:
        names = " and ".join(sorted(missing))
        raise ValueError(
            f"{file} is no zip of stable-baselines3, or is cut short: it holds no {names}"
        )


def _read(file: Path) -> tuple[dict[str, Any], Any]:
    """Read the model's data and the policy's weights; nothing else is unpickled."""
    from .normalise import Standardised  # noqa: F401  first: it says which extra is missing

    from stable_baselines3.common.save_util import load_from_zip_file  # isort: skip

    try:
        with ZipFile(file) as archive:
            names = json.loads(archive.read("data"))
        skipped = {name: None for name, value in names.items()
                   if name not in _NEEDED and isinstance(value, dict)}  # fmt: skip
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Could not deserialize")
            content, weights, _ = load_from_zip_file(file, device="cpu", custom_objects=skipped)
    except Exception as error:  # a pickle raises what its maker wrote
        text = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{file} cannot be read: {text}") from error
    lacking = [name for name in _NEEDED if name not in (content or {})]
    if lacking:
        raise ValueError(f"{file} is no zip of stable-baselines3: no {', '.join(lacking)} in it")
    return content or {}, (weights or {})["policy"]


def _build_policy(file: Path, content: dict[str, Any], weights: Any) -> Any:
    """Build the policy with its weights, without the algorithm and its environments."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    kind = content["policy_class"]
    options = {**content["policy_kwargs"]}
    options.pop("device", None)
    if not isinstance(kind, type):
        raise ValueError(f"{file}: its policy is of no class, but {kind!r}")
    find_actor_reader(kind)
    if issubclass(kind, ActorCriticPolicy):
        options.setdefault("use_sde", bool(content.get("use_sde", False)))
    spaces = content["observation_space"], content["action_space"]
    try:
        policy = kind(*spaces, lambda _: 0.0, **options)
        policy.load_state_dict(weights)
    except Exception as error:
        raise ValueError(
            f"{file}: its weights are not those of its {kind.__name__}: {error}"
        ) from error
    return policy


def load_normaliser(file: Path) -> Any:
    """Load a VecNormalize from its pickle, which can run code.

    Args:
        file: Path of the pickle.

    Returns:
        The VecNormalize.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file holds no VecNormalize.
    """
    from stable_baselines3.common.vec_env import VecNormalize

    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file")
    try:
        normaliser = pickle.loads(file.read_bytes())
    except Exception as error:  # a pickle raises what its maker wrote
        raise ValueError(f"{file} cannot be read as a VecNormalize: {error}") from error
    if not isinstance(normaliser, VecNormalize):
        raise ValueError(f"{file} holds a {type(normaliser).__name__}, not a VecNormalize")
    return normaliser


def _count_frames(file: Path, space: Any, layout: Sequence[ObservationEntry]) -> int:
    """Count the layout's frames in the policy's observation; ValueError for another observation."""
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"{file} was trained on {space}, not on an observation of one dimension")
    frames, rest = divmod(space.shape[0], len(layout))
    if frames > 0 and rest == 0 and space == make_space(layout, frames):
        return frames
    names = ", ".join(entry.name for entry in layout)
    raise ValueError(
        f"{file} was trained on {space.shape[0]} numbers{_describe_matching_env(space)}; the "
        "observation here has "
        f"{len(layout)}: {names}. An export (`sideslip export`) reads its entries by name and "
        "drives a wider observation too"
    )


def _describe_matching_env(space: Any) -> str:
    """Describe the registered env that has this observation, if there is one."""
    for env_id in [name for name in gym.registry if name.startswith("sideslip/")]:
        try:
            layout = get_env_facts(gym.make(env_id)).layout
        except ModuleNotFoundError:  # of an extra
            continue
        if space == make_space(layout):
            return f", those of {env_id}: {', '.join(entry.name for entry in layout)}"
    return " that no environment here has by itself (with an estimator, say which)"
