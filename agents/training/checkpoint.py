"""A training's checkpoint in one file: tensors as safetensors, the rest as JSON beside them.

Reading it runs no code, and a save that is stopped leaves the older file as it was.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from ...envs.backend.files import write_whole

FORMAT = 1


def save_checkpoint(path: Path, model: Any, told: dict[str, Any]) -> None:
    """A stable-baselines3 model's parameters and optimisers, and what is told; JSON types."""
    tensors: dict[str, torch.Tensor] = {}
    groups: dict[str, Any] = {}
    for part, state in model.get_parameters().items():
        if "param_groups" in state:  # an optimiser's
            groups[part] = state["param_groups"]
            for i, values in state["state"].items():
                tensors |= {f"{part}/{i}/{key}": value for key, value in values.items()}
        else:
            tensors |= {f"{part}/{name}": value for name, value in state.items()}
    plain = {name: value.detach().cpu().clone() for name, value in tensors.items()}
    content = json.dumps({"format": FORMAT, "groups": groups, **told}, allow_nan=False)
    write_whole(path, save(plain, {"checkpoint": content}))


def read_told(path: Path) -> dict[str, Any]:
    """What was told when it was saved; ValueError for a file that is no checkpoint of ours."""
    try:
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get("checkpoint")
    except SafetensorError as error:
        raise ValueError(f"{path} is no checkpoint, or is cut short: {error}") from None
    told: dict[str, Any] = {} if text is None else json.loads(text)
    if told.get("format") != FORMAT:
        raise ValueError(f"{path} is no checkpoint of this format ({FORMAT})")
    return told


def load_parameters(path: Path, model: Any) -> None:
    """Give a model the parameters and the state of the optimisers of a checkpoint."""
    groups = read_told(path)["groups"]
    parts: dict[str, dict[str, Any]] = {part: {} for part in model.get_parameters()}
    for part, told in groups.items():
        parts[part] = {"param_groups": told, "state": {}}
    with safe_open(path, "pt") as file:
        for name in file.keys():  # noqa: SIM118  it is no mapping
            part, key = name.split("/", 1)
            if part in groups:
                i, key = key.split("/", 1)
                parts[part]["state"].setdefault(int(i), {})[key] = file.get_tensor(name)
            else:
                parts[part][key] = file.get_tensor(name)
    model.set_parameters(parts, device="cpu")
