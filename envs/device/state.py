"""Arguments of the device engine, checked: the device, the floats, the actions; and the rows' state
in the packed form of the other engines."""

import os
import shutil
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arguments import parse_actions
from ..backend.on_torch import torch
from ..engine.layout import Z
from ..record import Array
from .packets import read_packed, write_packed
from .step import TorchState

Tensor = torch.Tensor
_MOTION, _DRIVE, _REFS, _LEAD = (
    slice(part[0], part[-1] + 1) for part in (Z.motion, Z.drive, Z.refs, Z.nominal_motion)
)
_PACKED = _MOTION, _DRIVE, Z.driver, _REFS, _LEAD, Z.clock.tick, Z.clock.failure
"""Where the first fields of a `TorchState` lie in the packed state."""


def is_compile_used(is_wanted: bool, device: torch.device) -> bool:
    """Whether `torch.compile` is used: where it is wanted, and a C++ compiler is there for the
    CPU; without one a warning says so."""
    compiler = os.environ.get("CXX", "g++")  # where torch looks for it
    if is_wanted and device.type == "cpu" and shutil.which(compiler) is None:
        warnings.warn(
            f"compile=True needs a C++ compiler on the CPU, and there is no {compiler!r}: "
            "ticks are not compiled",
            RuntimeWarning,
            stacklevel=3,
        )
        return False
    return is_wanted


def parse_device_actions(
    actions: Any,
    count: int,
    width: int,
    fail: bool,
    device: torch.device,
    dtype: torch.dtype,
    grad: bool,
) -> Tensor:
    """Actions (count, width) rounded to float32 as the other engines take them; with `grad` a
    tensor's are not rounded, and have their graph.

    Of a tensor the shape and the device must be right, else ValueError; with `fail` a wrong shape
    is NaN. Anything else is brought to the device as the vector env takes it.
    """
    if not isinstance(actions, torch.Tensor):
        rounded: Tensor = torch.as_tensor(parse_actions(actions, count, width, fail))
        return rounded.to(device, dtype)
    if actions.device != device:
        raise ValueError(
            f"actions are on {actions.device}, the env on {device}; nothing was stepped"
        )
    if actions.shape != (count, width):
        if not fail:
            raise ValueError(
                f"actions have shape ({count}, {width}), got {tuple(actions.shape)}; "
                "nothing was stepped"
            )
        actions = torch.full((count, width), torch.nan, device=device)
    if not grad:
        actions = actions.detach().to(torch.float32)
    commands: Tensor = actions.to(dtype)
    return commands


def read_states(
    states: Array,
    over: npt.NDArray[np.bool_],
    reports: Array,
    capacity: int,
    device: torch.device,
    dtype: torch.dtype,
) -> tuple[TorchState, Tensor]:
    """The state on the device, and the keys (2, N), of packed states (N, STATE_WIDTH)."""
    packed = torch.as_tensor(states.T.copy())
    slow_state = read_packed(packed, capacity)
    parts = [*(packed[part] for part in _PACKED), *slow_state]
    parts += [torch.as_tensor(over.copy()), torch.as_tensor(reports.T.copy())]
    tensors = [tensor.to(device, None if tensor.dtype == torch.bool else dtype) for tensor in parts]
    return TorchState(*tensors), packed[Z.clock.key_low : Z.clock.key_high + 1].to(
        device, torch.int64
    )


def write_states(state: TorchState, states: Array) -> None:
    """Write the state into packed states (N, STATE_WIDTH), where keys and redraws already are."""
    packed = torch.as_tensor(states.T.copy())
    types = [None if tensor.dtype == torch.bool else torch.float64 for tensor in state]
    host_state = TorchState(
        *(tensor.to("cpu", target_dtype) for tensor, target_dtype in zip(state, types, strict=True))
    )
    for part, values in zip(_PACKED, host_state, strict=False):
        packed[part] = values
    write_packed(host_state.slow_state, packed)
    states[:] = packed.numpy().T
