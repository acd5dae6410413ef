"""A learned policy as one file: weights as safetensors, whose metadata hold the card.

Reading it runs no code: safetensors are numbers, the card is JSON.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ...envs.backend.files import write_whole
from .card import Card
from .network import Network

FORMAT = 1
"""Counts up when an older sideslip could not read, or would misread, a newer file."""
ENDING = ".safetensors"
FOLDER = Path(__file__).resolve().with_name("policies")
_ARCHITECTURE = ("hidden", "activation", "output", "clip", "action_width")


@dataclass(frozen=True)
class Policy:
    """A network and its card; name: of the file, without its ending."""

    name: str
    network: Network
    card: Card

    @property
    def reads(self) -> npt.NDArray[np.bool_]:
        """(inputs,) the entries of the card's observation that the network reads."""
        return self.network.scale > 0.0

    @property
    def salt(self) -> str:
        """A hash of the network, from which its test seeds are made (hexadecimal)."""
        digest = hashlib.sha256()
        for name, values in _tensors(self.network).items():
            digest.update(name.encode() + values.tobytes())
        return digest.hexdigest()[:16]


def shipped() -> list[str]:
    """The names of the policies that come with the package."""
    return sorted(path.stem for path in FOLDER.glob(f"*{ENDING}"))


def is_policy(name: str) -> bool:
    """Whether `load_policy` would look for this: a shipped name, or a path by its ending."""
    return name.endswith(ENDING) or name in shipped()


def stamp(name: str) -> str:
    """A hash of a policy's file, "" for a name that is no policy's."""
    path = FOLDER / f"{name}{ENDING}" if name in shipped() else Path(name)
    there = is_policy(name) and path.is_file()
    return hashlib.sha256(path.read_bytes()).hexdigest() if there else ""


def save_policy(path: str | Path, network: Network, card: Card) -> None:
    """Write the whole file or none; a save that is stopped leaves an older file as it was.

    path: ends in `.safetensors`. Raises ValueError for another ending, or a card whose observation
    is not as wide as the network's input.
    """
    target = Path(path)
    if target.suffix != ENDING:
        raise ValueError(f"a policy's file is NAME{ENDING}, got {target}")
    if len(card.observation) != network.inputs:
        raise ValueError(
            f"the card's observation has {len(card.observation)} entries, "
            f"the network takes {network.inputs}"
        )
    architecture = dict(
        hidden=list(network.hidden),
        activation=network.activation,
        output=network.output,
        clip=network.clip,
        action_width=network.width,
    )
    metadata = {"format": str(FORMAT), "card": card.to_json(network=architecture)}
    write_whole(target, save(_tensors(network), metadata))


def load_policy(path: str | Path) -> Policy:
    """A policy from its file, or a shipped one by its name.

    Raises FileNotFoundError where there is none, ValueError for a file that is no policy, is cut
    short, was made by a newer format, or whose card and tensors do not fit together.
    """
    found = _found(path)
    try:
        with safe_open(found, "numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, TypeError) as error:
        raise ValueError(f"{found} is no safetensors file, or is cut short: {error}") from None
    try:
        fields = _card_fields(metadata)
        network = _network(fields.pop("network", None), fields.get("observation"), tensors)
        return Policy(found.stem, network, Card.from_mapping(fields))
    except ValueError as error:
        raise ValueError(f"{found}: {error}") from None


def _found(path: str | Path) -> Path:
    name = str(path)
    if name in shipped():
        return FOLDER / f"{name}{ENDING}"
    file = Path(path)
    if not file.is_file():
        what = "is a folder" if file.is_dir() else "does not exist"
        names = ", ".join(shipped()) or "none"
        raise FileNotFoundError(f"policy {name} {what}; shipped policies: {names}")
    return file


def _card_fields(metadata: dict[str, str]) -> dict[str, Any]:
    """The card's JSON object with the architecture, checked as far as the format goes."""
    if not {"format", "card"} <= metadata.keys():
        raise ValueError("safetensors without a card: this is not a policy of sideslip")
    if not metadata["format"].isdecimal() or int(metadata["format"]) > FORMAT:
        raise ValueError(
            f"the card has format {metadata['format']}, this sideslip reads up to {FORMAT}: "
            "a newer sideslip made it"
        )
    try:
        fields = json.loads(metadata["card"])
    except json.JSONDecodeError as error:
        raise ValueError(f"the card is no JSON: {error}") from None
    if not isinstance(fields, dict):
        raise ValueError(f"a card is a JSON object, got {type(fields).__name__}")
    return fields


def _network(fields: Any, observation: Any, tensors: dict[str, npt.NDArray[Any]]) -> Network:
    """The network that the card describes, from tensors of the shapes that it says."""
    if not isinstance(fields, dict) or set(fields) != set(_ARCHITECTURE):
        raise ValueError(f"the card's network holds {', '.join(_ARCHITECTURE)}, got {fields!r}")
    if not isinstance(observation, list):
        raise ValueError(f"the card's observation is a list, got {observation!r}")
    hidden, clip = fields["hidden"], fields["clip"]
    sizes = [*hidden, fields["action_width"]] if isinstance(hidden, list) else []
    if not sizes or not all(type(size) is int and size > 0 for size in sizes):
        raise ValueError(f"the card's layer sizes are positive integers, got {fields!r}")
    if not (clip is None or type(clip) in (int, float)):
        raise ValueError(f"clip is above zero or None, got {clip!r}")
    _check_tensors(tensors, len(observation), sizes)
    return Network(
        tensors["mean"],
        tensors["scale"],
        [tensors[f"weight_{i}"] for i in range(len(sizes))],
        [tensors[f"bias_{i}"] for i in range(len(sizes))],
        str(fields["activation"]),
        str(fields["output"]),
        clip,
    )


def _check_tensors(tensors: dict[str, npt.NDArray[Any]], inputs: int, sizes: list[int]) -> None:
    """ValueError for tensors that are not those of layers of these sizes."""
    shapes: dict[str, tuple[int, ...]] = {"mean": (inputs,), "scale": (inputs,)}
    wide = inputs
    for i, size in enumerate(sizes):
        shapes |= {f"weight_{i}": (size, wide), f"bias_{i}": (size,)}
        wide = size
    if shapes.keys() != tensors.keys():
        missing, more = shapes.keys() - tensors.keys(), tensors.keys() - shapes.keys()
        raise ValueError(f"missing tensors: {sorted(missing)}; unexpected ones: {sorted(more)}")
    for name, shape in shapes.items():
        kind = np.dtype(np.float64 if name in ("mean", "scale") else np.float32)
        found = tensors[name]
        if found.shape != shape or found.dtype != kind:
            raise ValueError(
                f"tensor {name} has shape {found.shape} of {found.dtype}, "
                f"the card says {shape} of {kind}"
            )


def _tensors(network: Network) -> dict[str, npt.NDArray[Any]]:
    tensors: dict[str, npt.NDArray[Any]] = {"mean": network.mean, "scale": network.scale}
    for i, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"weight_{i}"] = np.ascontiguousarray(W, np.float32)
        tensors[f"bias_{i}"] = np.ascontiguousarray(b, np.float32)
    return tensors
