"""Arguments of the device engine, checked: the device, the floats, the actions; and the rows' state
in the packed form of the other engines.

What both engines on tensors share: arguments, checked, and infos.

The rows of a batch on a device, and their way there and back.
"""

import os
import shutil
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..engine.episodes import EpisodeBatch, IntArray
from ..engine.layout import Z
from ..numerics.torch_backend import DTYPES, torch
from ..record import PACKET_WIDTH, Array
from ..task import REPORT, RUNNING, StepReport
from ..validation import parse_actions, short_repr
from .gradients import NO_TENSORS, AttachedParameters, ResetTensors, replace_motion
from .torch_outputs import PacketCapacity, read_packed, write_packed
from .torch_step import StepOutcome, TorchReset, TorchState

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
    actions: Any, count: int, width: int, fail: bool, device: torch.device, dtype: torch.dtype,
    grad: bool,
) -> Tensor:  # fmt: skip
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
    states: Array, over: npt.NDArray[np.bool_], reports: Array, capacity: int, device: torch.device,
    dtype: torch.dtype,
) -> tuple[TorchState, Tensor]:  # fmt: skip
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


def parse_device(device: Any) -> torch.device:
    """The device of a name or itself, as its tensors have it: a GPU with an index, the CPU without.

    ValueError for an unknown one and one that is not there.
    """
    try:
        parsed = torch.device(device)
    except (RuntimeError, TypeError):
        parsed = None
    if parsed is None or parsed.type not in ("cpu", "cuda"):
        raise ValueError(f"unknown device {device!r}; known: 'cpu', 'cuda', 'cuda:0', ...")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if parsed.type == "cuda" and (parsed.index or 0) >= count:
        available = ", ".join(["cpu", *(f"cuda:{i}" for i in range(count))])
        reason = (
            "" if count else ": no CUDA driver" if torch.version.cuda else ": built without CUDA"
        )
        raise ValueError(
            f"device {str(device)!r} is not there: torch {torch.__version__} finds "
            f"{available}{reason}"
        )
    if parsed.type == "cpu":
        return torch.device("cpu")
    return torch.device(
        "cuda", torch.cuda.current_device() if parsed.index is None else parsed.index
    )


def check_arguments(arguments: Mapping[str, Any]) -> None:
    """TypeError for an argument of `StabilityVectorEnv` that no engine on a device heeds."""
    for name in ("max_episode_steps", "info", "render_mode"):
        if arguments.get(name) is not None:
            raise TypeError(f"an env on a device has no {name}, got {short_repr(arguments[name])}")


def parse_dtype(dtype: Any) -> torch.dtype:
    """The type of floats of a name or itself; ValueError for another."""
    known = DTYPES | {torch_dtype: torch_dtype for torch_dtype in DTYPES.values()}
    if dtype not in known:
        raise ValueError(f"dtype is 'float64' or 'float32', got {dtype!r}")
    return known[dtype]


def read_infos(report: Tensor) -> dict[str, Any]:
    """The numbers of `info` of every row, (N,) each, from a report (len(Report), N)."""
    infos: dict[str, Any] = dict(zip(StepReport._fields, report[: REPORT.failure], strict=False))
    infos["failure"] = failure = report[REPORT.failure].to(torch.int64)
    infos["is_success"] = (report[REPORT.ended] == 1.0) & (failure == RUNNING)
    return infos


_RECORD = StepOutcome._fields.index("rows")  # from here on the rows are the last axis


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    capacities: the slow sensors present and each one's capacity. start: tick 0 on tensors, for
    gradients; without one parameters stay where they are, for a graph that reads them there.
    """

    def __init__(
        self, episodes: EpisodeBatch, capacities: dict[int, PacketCapacity], device: torch.device,
        dtype: torch.dtype, start: TorchReset | None = None,
    ) -> None:  # fmt: skip
        self.capacities, self._device, self._dtype = capacities, device, dtype
        self._start, self._attached = start, AttachedParameters()
        self._obs_dtype = dtype if start else torch.float32
        self._capacity = sum(capacity.under_way for capacity in capacities.values())
        self._packets = self._capacity + sum(
            capacity.frames * capacity.copies for capacity in capacities.values()
        )
        all_rows = np.arange(len(episodes.params))
        self._packed_params, self.keys, self.state, self.outcome = self._read_rows(
            episodes, all_rows
        )
        self.params = self._packed_params

    def upload(
        self, episodes: EpisodeBatch, rows: IntArray, inputs: ResetTensors = NO_TENSORS
    ) -> None:
        """Bring rows of the episodes that were reset to the device, and with them the inputs."""
        params, keys, state, outcome = self._read_rows(episodes, rows)
        row_index = torch.as_tensor(rows, device=self._device)
        if self._start is None:
            self.params.index_copy_(-1, row_index, params)
        else:
            self._packed_params = self._packed_params.index_copy(-1, row_index, params)
            self._attached.put(row_index, episodes.configs, inputs.parameters)
            self.params = self._attached.insert_tensors(self._packed_params)
            state = state._replace(motion=replace_motion(state.motion, inputs.state, row_index))
            state, outcome = self._start(self.params[:, row_index], keys, state)
        if len(rows) == len(episodes.params):
            self.keys.copy_(keys)
            self.state, self.outcome = state, outcome
            return

        def merge(old: Tensor, new: Tensor, axis: int = -1) -> Tensor:
            return old.index_copy(axis, row_index, new)

        self.keys.index_copy_(-1, row_index, keys)
        self.state = TorchState(*map(merge, self.state, state))
        before = self.outcome
        record = map(merge, before[_RECORD:], outcome[_RECORD:])
        self.outcome = StepOutcome(merge(before.obs, outcome.obs, 0), *before[1:_RECORD], *record)

    def detach(self) -> None:
        """State and outcome without their graph, and the parameters with a new one."""
        self.state = TorchState(*(tensor.detach() for tensor in self.state))
        self.outcome = StepOutcome(*(tensor.detach() for tensor in self.outcome))
        self.params = self._attached.insert_tensors(self._packed_params)

    def download(self, episodes: EpisodeBatch) -> None:
        """Write state, outcome and the inputs' numbers into the episodes."""
        self._attached.write(self.params, episodes.params)
        state = TorchState(*(tensor.detach() for tensor in self.state))
        write_states(state, episodes.states)
        outcome = StepOutcome(*(tensor.detach().cpu() for tensor in self.outcome))
        packets = outcome.packets.permute(2, 0, 1)
        width = min(packets.shape[1], episodes.packets.shape[1])
        episodes.packets[:, :width] = packets[:, :width]
        episodes.rows[:] = outcome.rows.permute(2, 0, 1)
        episodes.over[:] = state.over.cpu()
        episodes.reports[:] = state.report.T.cpu()
        episodes.obs[:] = outcome.obs
        episodes.ticks_done[:], episodes.delivered[:] = outcome.done, outcome.delivered

    def _read_rows(
        self, episodes: EpisodeBatch, rows: IntArray
    ) -> tuple[Tensor, Tensor, TorchState, StepOutcome]:
        """(params, keys, state, the last step's outcome) of some rows."""
        device, dtype = self._device, self._dtype

        def to_device(array: Any, *axes: int) -> Tensor:
            return torch.as_tensor(array.transpose(*axes).copy()).to(device, dtype)

        state, keys = read_states(
            episodes.states[rows], episodes.over[rows], episodes.reports[rows], self._capacity,
            device, dtype,
        )  # fmt: skip
        packets = np.zeros((len(rows), self._packets, PACKET_WIDTH))
        width = min(self._packets, episodes.packets.shape[1])
        packets[:, :width] = episodes.packets[rows, :width]
        no_rows = torch.zeros(len(rows), dtype=torch.bool, device=device)
        outcome = StepOutcome(
            torch.as_tensor(episodes.obs[rows]).to(device, self._obs_dtype),
            torch.zeros(len(rows), dtype=dtype, device=device), no_rows, no_rows, no_rows,
            to_device(episodes.rows[rows], 1, 2, 0), to_device(packets, 1, 2, 0),
            torch.as_tensor(episodes.ticks_done[rows]).to(device),
            torch.as_tensor(episodes.delivered[rows]).to(device),
        )  # fmt: skip
        return to_device(episodes.params[rows], 1, 0), keys, state, outcome
