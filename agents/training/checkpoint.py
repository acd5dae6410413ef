"""A training's checkpoint in one file: tensors as safetensors, the rest as JSON beside them.

Reading it runs no code, and a save that is stopped leaves the older file as it was.
"""

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from ...envs.io import write_atomic
from ...envs.numerics import require_extra

with require_extra("train", "training needs {}"):
    import torch
    from safetensors.torch import save

FORMAT = 3
_VARIABLES = "variables"  # tensors of no module, such as the logarithm of an entropy's weight
STATE = {"groups", "sideslip", "task", "steps", "aim", "scaling", "evaluations"}
"""Keys of a resumed training's state, besides the tensors."""


def save_checkpoint(path: Path, model: Any, rest: dict[str, Any]) -> None:
    """Save a model's parameters and optimisers, and the rest of the training's state.

    Args:
        path: File to write.
        model: Model of stable-baselines3.
        rest: Rest of the state, in JSON types.
    """
    tensors: dict[str, torch.Tensor] = {}
    groups: dict[str, Any] = {}
    for part, state in model.get_parameters().items():
        if "param_groups" in state:  # an optimiser's
            groups[part] = state["param_groups"]
            for i, values in state["state"].items():
                tensors |= {f"{part}/{i}/{key}": value for key, value in values.items()}
        else:
            tensors |= {f"{part}/{name}": value for name, value in state.items()}
    tensors |= {f"{_VARIABLES}/{name}": value for name, value in _get_variables(model).items()}
    plain = {name: value.detach().cpu().clone() for name, value in tensors.items()}
    content = json.dumps({"format": FORMAT, "groups": groups, **rest}, allow_nan=False)
    write_atomic(path, save(plain, {"checkpoint": content}))


def read_state(path: Path) -> dict[str, Any]:
    """Read a training's state without the tensors.

    Args:
        path: Checkpoint.

    Returns:
        State in JSON types.

    Raises:
        ValueError: The file is no checkpoint of this format, or is cut short.
    """
    try:
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get("checkpoint")
    except SafetensorError as error:
        raise ValueError(f"{path} is no checkpoint, or is cut short: {error}") from None
    try:
        state: Any = {} if text is None else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no checkpoint: its state is no JSON ({error})") from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise ValueError(f"{path} is no checkpoint of this format ({FORMAT})")
    missing = sorted(STATE - state.keys())
    if missing:
        raise ValueError(f"{path}: the checkpoint's state lacks {', '.join(missing)}")
    return state


def _get_variables(model: Any) -> dict[str, torch.Tensor]:
    """Get the tensors that `get_parameters` leaves out, though a model's zip has them."""
    return {name: getattr(model, name) for name in model._get_torch_save_params()[1]}


def load_parameters(path: Path, model: Any) -> None:
    """Load a checkpoint's parameters and optimisers into a model.

    Args:
        path: Checkpoint.
        model: Model of stable-baselines3.
    """
    groups = read_state(path)["groups"]
    parts: dict[str, dict[str, Any]] = {part: {} for part in model.get_parameters()}
    variables = _get_variables(model)
    for part, group in groups.items():
        parts[part] = {"param_groups": group, "state": {}}
    with safe_open(path, "pt") as file:
        for name in file.keys():  # noqa: SIM118  it is no mapping
            part, key = name.split("/", 1)
            if part == _VARIABLES:
                variables[key].data.copy_(file.get_tensor(name))
            elif part in groups:
                i, key = key.split("/", 1)
                parts[part]["state"].setdefault(int(i), {})[key] = file.get_tensor(name)
            else:
                parts[part][key] = file.get_tensor(name)
    model.set_parameters(parts, device=model.device)
