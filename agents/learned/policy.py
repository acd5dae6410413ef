"""A learned policy: its card, its file, and the controller that runs its network by NumPy.

The file holds weights as safetensors, whose metadata hold the card as JSON; reading it runs no
code. The card says what the policy was trained on, how, and what it costs against others.

Args:
    name: Shipped name or path.
    path: Path, or shipped name to read; FileNotFoundError without its file.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ... import __version__
from ...envs.io import check_types, from_json, write_atomic
from ...envs.record import Array
from ...envs.scenarios.world import WORLD_VERSION
from ...envs.validation import check_choice, describe_unknown
from ...estimators.make import is_user_file
from ...estimators.wrappers.estimate import EstimateObservation
from ..controllers.base import Controller
from ..env_info import AnyEnv, get_env_facts, make_env
from .layers import MEMORY_LAYERS, MemoryLayer
from .network import SUFFIX as SUFFIX
from .network import Network, Tensors

FORMAT = 2  # rises when an older sideslip could not read, or would misread, a newer file
MAX_BYTES = 2**26  # a larger file is not opened, which bounds the tensors' sizes too
ZIP = ".zip"  # of stable-baselines3, which `agents.training.export` reads
FOLDER = Path(__file__).resolve().with_name("policies")

JsonMap = dict[str, Any]


@dataclass(frozen=True)
class Card:
    """The card of a policy: training and evaluation in JSON types; ValueError for a wrong type."""

    env_id: str  # id of the env
    observation: tuple[tuple[str, str], ...]  # (name, unit) of each entry that the network takes
    control_period: int  # ticks between two decisions
    reference: str  # name in `envs.task.REFERENCES`, by which the policy was judged
    env_options: JsonMap = field(default_factory=dict)  # of `gym.make`
    estimator: str = ""  # of `EstimateObservation` around the env, "" for none
    estimator_options: JsonMap = field(default_factory=dict)  # of `EstimateObservation`
    algorithm: str = ""  # name of the training's algorithm
    algorithm_options: JsonMap = field(default_factory=dict)  # of the training
    command: str = ""  # line of the training
    seeds: JsonMap = field(default_factory=dict)  # by purpose ("training", ...)
    steps: int = 0  # of the environment
    cpu_seconds: float = 0.0  # of the training
    sideslip: str = __version__  # version of the package
    world_version: int = 0  # of the world it was trained in, 0 where nothing errs
    # The salt of the test seeds, their number ("episodes"), and "cost": mean and 95 % interval of
    # the policy and of each controller beside it. Of a class of tasks also its costs by scenario.
    evaluation: JsonMap = field(default_factory=dict)

    def __post_init__(self) -> None:
        pairs: Any = self.observation
        rows: Any = pairs if isinstance(pairs, list | tuple) else [None]
        is_table = all(isinstance(row, list | tuple) and len(row) == 2 for row in rows)
        if not (is_table and all(isinstance(word, str) for row in rows for word in row)):
            raise ValueError(f"observation is a list of (name, unit), got {pairs!r}")
        object.__setattr__(self, "observation", tuple((name, unit) for name, unit in pairs))
        if len({name for name, _ in pairs}) != len(pairs):
            raise ValueError("observation names an entry twice")
        check_types(Card, vars(self), "the card")
        check_names_no_code(self.env_id, self.estimator, self.estimator_options)
        self._to_json()

    @property
    def world_id(self) -> str:
        """Id of the env in the world of the training: version 1 is version 0 with its errors."""
        return self.env_id.replace("-v0", f"-v{self.world_version}")

    @classmethod
    def from_env_id(
        cls, env_id: str, env_options: Mapping[str, Any] | None = None, estimator: str = "",
        estimator_options: Mapping[str, Any] | None = None, **rest: Any,
    ) -> "Card":  # fmt: skip
        """Make a card with the observation of an env and its estimator.

        Args:
            env_id: Id of the env.
            env_options: Arguments of `gym.make`.
            estimator: Estimator around the env, "" for none.
            estimator_options: Other arguments of `EstimateObservation`.
            rest: Other fields of the card.
        """
        rest["env_options"], further = dict(env_options or {}), dict(estimator_options or {})
        env = make_env(env_id, rest["env_options"])
        if estimator:
            env = EstimateObservation(env, estimator, **further)
        rest |= {"env_id": env_id, "estimator": estimator, "estimator_options": further}
        card = cls.from_env(env, **rest)
        env.close()
        return card

    @classmethod
    def from_env(cls, env: AnyEnv, **rest: Any) -> "Card":
        """Make a card with the observation, control period and reference of an env.

        Args:
            env: Env, single or vector.
            rest: Other fields of the card.
        """
        facts = get_env_facts(env)
        rest["observation"] = tuple((entry.name, entry.unit) for entry in facts.layout)
        rest["world_version"] = WORLD_VERSION if facts.moment_rate > 0.0 else 0
        return cls(control_period=int(facts.control_period), reference=facts.reference, **rest)

    def _to_json(self, **extra: Any) -> str:
        """Convert the card, with further fields, to a JSON object; ValueError for other types."""
        try:
            return json.dumps(asdict(self) | extra, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the card holds what JSON has not: {error}") from None


def check_names_no_code(env_id: str, estimator: str, estimator_options: JsonMap) -> None:
    """Check that a foreign file names no code to import; ValueError where it does.

    Args:
        env_id: Id of a registered env.
        estimator: Name of an estimator, or "".
        estimator_options: Arguments of `EstimateObservation`, without an estimator.
    """
    if "estimator" in estimator_options:
        raise ValueError("estimator_options holds an estimator, which is none of its options")
    if ":" in env_id:
        text = f"env_id is that of a registered env, got {env_id!r}, which names a module"
        raise ValueError(f"{text}: import it first and give the id alone")
    if ":" in estimator or is_user_file(estimator):
        text = f"estimator is a name, got the entry point {estimator!r}"
        raise ValueError(f"{text}: sideslip.register_estimator gives it one")


@dataclass(frozen=True)
class Policy:
    """A network and its card."""

    name: str  # name of the file without its ending
    network: Network  # network that computes the action
    card: Card  # card of its training

    @property
    def salt(self) -> str:
        """Hexadecimal hash of the network, from which its test seeds are made."""
        digest = hashlib.sha256()
        for name, values in self.network.tensors.items():
            digest.update(name.encode() + values.tobytes())
        return digest.hexdigest()[:16]


def list_shipped() -> list[str]:
    """List the names of the policies that come with the package."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def is_policy(name: str) -> bool:
    """Return whether a name is a shipped policy's, or a path with a policy's ending."""
    return name.endswith(SUFFIX) or name in list_shipped()


def _make_path(name: str | Path) -> Path:
    return FOLDER / f"{name}{SUFFIX}" if str(name) in list_shipped() else Path(name)


def hash_policy(name: str) -> str:
    """Compute the SHA-256 of a policy's file in hexadecimal digits, "" for no policy's name."""
    path = _make_path(name)
    exists = is_policy(name) and path.is_file()
    return hashlib.sha256(path.read_bytes()).hexdigest() if exists else ""


def save_policy(path: str | Path, network: Network, card: Card) -> None:
    """Write a policy's file; a save that is stopped leaves an older file unchanged.

    Args:
        path: Path that ends in `.safetensors`.
        network: Network to write.
        card: Card of its training.
    """
    target = Path(path)
    if target.suffix != SUFFIX:
        raise ValueError(f"a policy's file is NAME{SUFFIX}, got {target}")
    _check_width(card, network)
    metadata = {"format": str(FORMAT), "card": card._to_json(network=network.description)}
    write_atomic(target, save(network.tensors, metadata))


def _check_width(card: Card, network: Network) -> None:
    if (count := len(card.observation)) != network.inputs:
        raise ValueError(f"the card has {count} entries, the network takes {network.inputs}")


def load_policy(path: str | Path) -> Policy:
    """Load a policy's file or a shipped one; ValueError for an unknown format or unfit tensors."""
    file = _make_path(path)
    if file.is_dir():
        raise FileNotFoundError(f"policy {path} is a folder")
    if not file.is_file():
        unknown = describe_unknown("policy", [str(path)], list_shipped())
        raise FileNotFoundError(f"there is no such file and {unknown}")
    tensors, metadata = _read_tensors(file)
    try:
        fields = _read_card_fields(metadata)
        network = _build_network(fields.pop("network", None), tensors)
        card = from_json(Card, fields, "the card")
        _check_width(card, network)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    return Policy(file.stem, network, card)


def _read_tensors(path: Path) -> tuple[Tensors, dict[str, str]]:
    """Read tensors and metadata; ValueError for another file, or one larger than `MAX_BYTES`."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{path} has {size} bytes, a policy has at most {MAX_BYTES}")
    try:
        with safe_open(path, "numpy") as file:
            metadata = file.metadata() or {}
            return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118
    except (SafetensorError, OSError, TypeError) as error:
        raise ValueError(f"{path} is no safetensors file, or is cut short: {error}") from None


def _read_card_fields(metadata: dict[str, str]) -> dict[str, Any]:
    """Read the card's JSON object with the architecture, checked as far as the format goes."""
    if not {"format", "card"} <= metadata.keys():
        raise ValueError("safetensors without a card: this is not a policy of sideslip")
    known = [str(version) for version in range(1, FORMAT + 1)]
    if metadata["format"] not in known:
        text = f"the card has format {metadata['format'][:20]}, this sideslip reads"
        raise ValueError(f"{text} {' and '.join(known)}: another sideslip made it")
    try:
        fields = json.loads(metadata["card"])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the card is no JSON: {error}") from None
    if not isinstance(fields, dict):
        raise ValueError(f"a card is a JSON object, got {type(fields).__name__}")
    if metadata["format"] == "1" and isinstance(fields.get("network"), dict):
        fields["network"] |= {"history": 1, "cells": []}  # it has no memory
    return fields


_NETWORK = {"hidden", "activation", "output", "clip", "action_width", "history", "cells"}


def _build_network(fields: Any, tensors: Tensors) -> Network:
    """Build the network that a card describes; ValueError where card and tensors do not fit."""
    is_table = isinstance(fields, dict) and set(fields) == _NETWORK
    if not is_table or type(fields["history"]) is not int:
        raise ValueError(f"the card's network holds {', '.join(sorted(_NETWORK))}, got {fields!r}")
    for name, tensor in tensors.items():
        kind = np.dtype(np.float64 if name in ("mean", "scale") else np.float32)
        if tensor.dtype != kind or not tensor.size:  # an empty one would fit any size in the card
            text = f"{tensor.size} numbers of {tensor.dtype}"
            raise ValueError(f"tensor {name} holds {text}, not one or more of {kind}")
    unused = dict(tensors)
    try:
        numbered = enumerate(fields["cells"])
        cells = [_build_cell(f"cell_{i}_", *cell, unused=unused) for i, cell in numbered]
        layers = range(len(fields["hidden"]) + 1)
        weights = [unused.pop(f"weight_{i}") for i in layers]
        biases = [unused.pop(f"bias_{i}") for i in layers]
        form = {name: fields[name] for name in ("activation", "output", "clip", "history")}
        arrays = unused.pop("mean"), unused.pop("scale"), weights, biases
        network = Network(*arrays, **form, cells=cells)
    except KeyError as error:
        raise ValueError(f"the tensor {error} is missing") from None
    except (TypeError, IndexError):
        raise ValueError(f"the card's network has values of another kind: {fields!r}") from None
    if unused:
        raise ValueError(f"unexpected tensors: {', '.join(sorted(unused))}")
    if network.description != fields:
        raise ValueError(f"the card's network is {fields!r}, the tensors are of another one")
    return network


def _build_cell(prefix: str, kind: str, _: int, *fields: Any, unused: Tensors) -> MemoryLayer:
    """Build a memory layer of its tensors, which are taken out of `unused`."""
    check_choice("cell", kind, MEMORY_LAYERS)
    layer: Any = MEMORY_LAYERS[kind]
    built: MemoryLayer = layer(*(unused.pop(prefix + name) for name in layer.arrays), *fields)
    return built


class PolicyController(Controller):
    """The deterministic action of a policy's network, clipped; ValueError for an unfit env.

    It reads the entries of its training by name, so a wider observation serves as well. Entries
    that never varied in training are not read. Where the env steers and the policy does not, the
    added steering is zero. Single and batch agree to rounding in double precision.

    Args:
        env: Env of the controller.
        policy: Shipped name, file's path, or `Policy`.
    """

    def __init__(self, env: AnyEnv, policy: str | Path | Policy) -> None:
        self.policy = policy if isinstance(policy, Policy) else load_policy(policy)
        name, card, facts = self.policy.name, self.policy.card, get_env_facts(env)
        reads = self.policy.network.reads
        entries = [entry for entry, read in zip(card.observation, reads, strict=True) if read]
        units = {entry.name: entry.unit for entry in facts.layout}
        odd = [(label, unit) for label, unit in entries if units.get(label, unit) != unit]
        trained = f"policy {name} was trained"
        if odd:
            wrong = [f"{label} in {unit} (here {units[label]})" for label, unit in odd]
            raise ValueError(f"{trained} on {', '.join(wrong)}")
        if facts.control_period != card.control_period:
            text = f"{trained} with a control period of {card.control_period} ticks"
            raise ValueError(f"{text}, this env has {facts.control_period}")
        if facts.moment_rate > 0.0 and card.world_version != WORLD_VERSION:
            text = f"this env is of world {WORLD_VERSION}, whose sensors err: train it there"
            raise ValueError(f"{trained} in world {card.world_version}, {text}")
        if facts.width < self.policy.network.width:
            text = f"policy {name} gives {self.policy.network.width} numbers"
            raise ValueError(f"{text}, the env's action has {facts.width}")
        self.needs = tuple(label for label, _ in entries)
        try:
            super().__init__(env)
        except ValueError as error:
            text, here = (", ".join(names) for names in (dict(card.observation), units))
            raise ValueError(f"{error}. {name} was trained on {text}; here are {here}") from None
        self.network = self.policy.network.select_inputs(reads)
        self.memory = self.network.memory

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        action[:, : self.network.width] = self.network(inputs, state)
