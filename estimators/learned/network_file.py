"""Networks in safetensors files: tensors of the shapes that a card in the metadata has.

Reading runs no code: safetensors are numbers, the card is JSON. Policies (`agents.learned.files`)
and corrections of estimators (`files`) are such files, each with a card of its own.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open

from .memory import (
    CELL_WEIGHTS,
    GATES,
    MemoryLayer,
    MovingAverages,
    RecurrentCell,
    compute_cell_shapes,
)
from .network import Network

MAX_BYTES = 2**26
"""A larger file is not opened; tensors lie in it as they are, so that it bounds their sizes too."""
SUFFIX = ".safetensors"
NO_MEMORY: dict[str, Any] = {"history": 1, "cells": []}
"""What the card says of a network without memory."""
_DENSE = ("hidden", "activation", "output", "clip", "action_width")
Tensors = dict[str, npt.NDArray[Any]]


def read_tensors(path: Path, what: str) -> tuple[Tensors, dict[str, str]]:
    """Read the tensors and the metadata of a safetensors file.

    Args:
        path: The file.
        what: Kind of file for messages.

    Returns:
        Tensors and metadata by name.

    Raises:
        ValueError: It is no such file, is cut short or is larger than `MAX_BYTES`.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path} has {size} bytes, a {what} has at most {MAX_BYTES}")
    try:
        with safe_open(path, "numpy") as file:
            metadata = file.metadata() or {}
            return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118
    except (SafetensorError, OSError, TypeError) as error:
        raise ValueError(f"{path} is no safetensors file, or is cut short: {error}") from None


def parse_json_object(text: str) -> dict[str, Any]:
    """Parse a card's JSON object.

    Args:
        text: JSON.

    Returns:
        Its fields.

    Raises:
        ValueError: It is no JSON object.
    """
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the card is no JSON: {error}") from None
    if not isinstance(fields, dict):
        raise ValueError(f"a card is a JSON object, got {type(fields).__name__}")
    return fields


def describe_network(network: Network) -> dict[str, Any]:
    """Describe a network for its card.

    Args:
        network: The network.

    Returns:
        Sizes and kinds by name, JSON types only.
    """
    return dict(
        hidden=list(network.hidden),
        activation=network.activation,
        output=network.output,
        clip=network.clip,
        action_width=network.width,
        history=network.history,
        cells=[_describe_cell(cell) for cell in network.cells],
    )


def _describe_cell(cell: MemoryLayer) -> list[Any]:
    if isinstance(cell, MovingAverages):
        return [cell.kind, len(cell.bias_in), cell.n_silu, list(cell.times)]
    return [cell.kind, cell.size]


def build_network(fields: Any, inputs: int, tensors: Tensors) -> Network:
    """Build the network that a card describes.

    Args:
        fields: The card's description, see `describe_network`.
        inputs: Number of entries of an observation.
        tensors: Tensors by name, of the shapes that the card has.

    Returns:
        The network.

    Raises:
        ValueError: Card and tensors do not fit together.
    """
    if not isinstance(fields, dict) or set(fields) != {*_DENSE, *NO_MEMORY}:
        names = ", ".join((*_DENSE, *NO_MEMORY))
        raise ValueError(f"the card's network holds {names}, got {fields!r}")
    hidden, cells, clip = fields["hidden"], fields["cells"], fields["clip"]
    sizes = [*hidden, fields["action_width"]] if isinstance(hidden, list) else []
    history = fields["history"]
    if not sizes or not all(type(size) is int and size > 0 for size in (*sizes, history)):
        raise ValueError(f"the card's layer sizes are positive integers, got {fields!r}")
    if not (isinstance(cells, list) and all(map(_is_cell, cells))):
        raise ValueError(
            f"the card's cells are pairs of {', '.join(GATES)} and a size, or "
            f"{MovingAverages.kind} with units, how many are bent, and times: {cells!r}"
        )
    if not (clip is None or type(clip) in (int, float)):
        raise ValueError(f"clip is above zero or None, got {clip!r}")
    _check_tensors(tensors, _compute_shapes(inputs, history, cells, sizes))
    return Network(
        tensors["mean"],
        tensors["scale"],
        [tensors[f"weight_{i}"] for i in range(len(sizes))],
        [tensors[f"bias_{i}"] for i in range(len(sizes))],
        str(fields["activation"]),
        str(fields["output"]),
        clip,
        history,
        [_build_cell(f"cell_{i}_", *cell, tensors=tensors) for i, cell in enumerate(cells)],
    )


def _is_cell(cell: Any) -> bool:
    if not isinstance(cell, list) or not cell:
        return False
    kind, *numbers = cell
    if kind == MovingAverages.kind and len(numbers) == 3 and isinstance(numbers[2], list):
        times = numbers.pop()
        has_sizes = all(type(value) is int for value in numbers) and numbers[0] > 0
        return has_sizes and all(type(value) in (int, float) for value in times)
    return kind in tuple(GATES) and len(numbers) == 1 and type(numbers[0]) is int and numbers[0] > 0


def _build_cell(prefix: str, kind: str, _: int, *traces: Any, tensors: Tensors) -> MemoryLayer:
    parts = MovingAverages.parts if traces else CELL_WEIGHTS
    arrays: list[Any] = [tensors[prefix + part] for part in parts]
    return MovingAverages(*arrays, *traces) if traces else RecurrentCell(kind, *arrays)


_Shapes = dict[str, tuple[tuple[int, ...], ...]]


def _compute_shapes(inputs: int, history: int, cells: list[Any], sizes: list[int]) -> _Shapes:
    """Compute the shapes that each tensor may have."""
    width = inputs * history
    shapes: _Shapes = dict.fromkeys(("mean", "scale"), ((inputs,), (width,)))
    for i, (kind, size, *traces) in enumerate(cells):
        if traces:
            part_shapes = dict(zip(MovingAverages.parts, ((size, width), (size,)), strict=True))
        else:
            part_shapes = compute_cell_shapes(kind, size, width)
        shapes |= {f"cell_{i}_{part}": (shape,) for part, shape in part_shapes.items()}
        width = size * (1 + len(traces[1])) if traces else size
    for i, size in enumerate(sizes):
        shapes |= {f"weight_{i}": ((size, width),), f"bias_{i}": ((size,),)}
        width = size
    return shapes


def _check_tensors(tensors: Tensors, shapes: _Shapes) -> None:
    """Check the names, shapes and types of tensors; else ValueError."""
    if shapes.keys() != tensors.keys():
        missing, unexpected = shapes.keys() - tensors.keys(), tensors.keys() - shapes.keys()
        raise ValueError(
            f"missing tensors: {sorted(missing)}; unexpected ones: {sorted(unexpected)}"
        )
    for name, allowed in shapes.items():
        kind = np.dtype(np.float64 if name in ("mean", "scale") else np.float32)
        tensor = tensors[name]
        if tensor.shape not in allowed or tensor.dtype != kind:
            raise ValueError(
                f"tensor {name} has shape {tensor.shape} of {tensor.dtype}, "
                f"the card has {' or '.join(map(str, dict.fromkeys(allowed)))} of {kind}"
            )


def collect_tensors(network: Network) -> Tensors:
    """Collect the tensors of a network for its file.

    Args:
        network: The network.

    Returns:
        Tensors by name.
    """
    tensors: Tensors = {"mean": network.mean, "scale": network.scale}
    for i, cell in enumerate(network.cells):
        for part in cell.parts:
            tensors[f"cell_{i}_{part}"] = np.ascontiguousarray(getattr(cell, part), np.float32)
    for i, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"weight_{i}"] = np.ascontiguousarray(W, np.float32)
        tensors[f"bias_{i}"] = np.ascontiguousarray(b, np.float32)
    return tensors
