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
from .memory import GATES, PARTS, Cell, cell_shapes
from .network import Network

FORMAT = 2
"""Counts up when an older sideslip could not read, or would misread, a newer file: since 2 a
network may have memory and more activations."""
MOST_BYTES = 2**26
"""A larger file is not opened; tensors lie in it as they are, so that it bounds their sizes too."""
ENDING = ".safetensors"
ZIP = ".zip"  # of stable-baselines3, which `agents.training.zips` reads
FOLDER = Path(__file__).resolve().with_name("policies")
_DENSE = ("hidden", "activation", "output", "clip", "action_width")
_MEMORY: dict[str, Any] = {"history": 1, "cells": []}  # as in a file of format 1, which has none


@dataclass(frozen=True)
class Policy:
    """A network and its card; name: of the file, without its ending."""

    name: str
    network: Network
    card: Card

    @property
    def reads(self) -> npt.NDArray[np.bool_]:
        """(inputs,) the entries of the card's observation that the network reads."""
        return self.network.reads

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
        history=network.history,
        cells=[[cell.kind, cell.size] for cell in network.cells],
    )
    metadata = {"format": str(FORMAT), "card": card.to_json(network=architecture)}
    write_whole(target, save(_tensors(network), metadata))


def load_policy(path: str | Path) -> Policy:
    """A policy from its file, or a shipped one by its name.

    Raises FileNotFoundError where there is none, ValueError for a file that is no policy, is cut
    short, is larger than `MOST_BYTES`, has another format, or whose card and tensors do not fit
    together.
    """
    found = _found(path)
    size = found.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"{found} has {size} bytes, a policy has at most {MOST_BYTES}")
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
    known = [str(each) for each in range(1, FORMAT + 1)]
    if metadata["format"] not in known:
        raise ValueError(
            f"the card has format {metadata['format'][:20]}, this sideslip reads "
            f"{' and '.join(known)}: another sideslip made it"
        )
    try:
        fields = json.loads(metadata["card"])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the card is no JSON: {error}") from None
    if not isinstance(fields, dict):
        raise ValueError(f"a card is a JSON object, got {type(fields).__name__}")
    if metadata["format"] == "1" and isinstance(fields.get("network"), dict):
        fields["network"] |= _MEMORY
    return fields


def _network(fields: Any, observation: Any, tensors: dict[str, npt.NDArray[Any]]) -> Network:
    """The network that the card describes, from tensors of the shapes that the card has."""
    if not isinstance(fields, dict) or set(fields) != {*_DENSE, *_MEMORY}:
        names = ", ".join((*_DENSE, *_MEMORY))
        raise ValueError(f"the card's network holds {names}, got {fields!r}")
    if not isinstance(observation, list):
        raise ValueError(f"the card's observation is a list, got {observation!r}")
    hidden, cells, clip = fields["hidden"], fields["cells"], fields["clip"]
    sizes = [*hidden, fields["action_width"]] if isinstance(hidden, list) else []
    history = fields["history"]
    if not sizes or not all(type(size) is int and size > 0 for size in (*sizes, history)):
        raise ValueError(f"the card's layer sizes are positive integers, got {fields!r}")
    if not (isinstance(cells, list) and all(map(_is_cell, cells))):
        raise ValueError(f"the card's cells are pairs of {', '.join(GATES)} and a size: {cells!r}")
    if not (clip is None or type(clip) in (int, float)):
        raise ValueError(f"clip is above zero or None, got {clip!r}")
    _check_tensors(tensors, _shapes(len(observation), history, cells, sizes))
    return Network(
        tensors["mean"],
        tensors["scale"],
        [tensors[f"weight_{i}"] for i in range(len(sizes))],
        [tensors[f"bias_{i}"] for i in range(len(sizes))],
        str(fields["activation"]),
        str(fields["output"]),
        clip,
        history,
        [
            Cell(kind, *(tensors[f"cell_{i}_{part}"] for part in PARTS))
            for i, (kind, _) in enumerate(cells)
        ],
    )


def _is_cell(pair: Any) -> bool:
    return (
        isinstance(pair, list)
        and len(pair) == 2
        and pair[0] in tuple(GATES)
        and type(pair[1]) is int
        and pair[1] > 0
    )


_Shapes = dict[str, tuple[tuple[int, ...], ...]]


def _shapes(inputs: int, history: int, cells: list[tuple[str, int]], sizes: list[int]) -> _Shapes:
    """The shapes that each tensor may have."""
    wide = inputs * history
    shapes: _Shapes = dict.fromkeys(("mean", "scale"), ((inputs,), (wide,)))
    for i, (kind, size) in enumerate(cells):
        own = cell_shapes(kind, size, wide)
        shapes |= {f"cell_{i}_{part}": (shape,) for part, shape in own.items()}
        wide = size
    for i, size in enumerate(sizes):
        shapes |= {f"weight_{i}": ((size, wide),), f"bias_{i}": ((size,),)}
        wide = size
    return shapes


def _check_tensors(tensors: dict[str, npt.NDArray[Any]], shapes: _Shapes) -> None:
    """ValueError for tensors of other names, shapes or types."""
    if shapes.keys() != tensors.keys():
        missing, more = shapes.keys() - tensors.keys(), tensors.keys() - shapes.keys()
        raise ValueError(f"missing tensors: {sorted(missing)}; unexpected ones: {sorted(more)}")
    for name, allowed in shapes.items():
        kind = np.dtype(np.float64 if name in ("mean", "scale") else np.float32)
        found = tensors[name]
        if found.shape not in allowed or found.dtype != kind:
            raise ValueError(
                f"tensor {name} has shape {found.shape} of {found.dtype}, "
                f"the card has {' or '.join(map(str, dict.fromkeys(allowed)))} of {kind}"
            )


def _tensors(network: Network) -> dict[str, npt.NDArray[Any]]:
    tensors: dict[str, npt.NDArray[Any]] = {"mean": network.mean, "scale": network.scale}
    for i, cell in enumerate(network.cells):
        for part in PARTS:
            tensors[f"cell_{i}_{part}"] = np.ascontiguousarray(getattr(cell, part), np.float32)
    for i, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"weight_{i}"] = np.ascontiguousarray(W, np.float32)
        tensors[f"bias_{i}"] = np.ascontiguousarray(b, np.float32)
    return tensors
