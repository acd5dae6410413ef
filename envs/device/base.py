"""Arguments and infos of both engines on tensors, and `DeviceRows`: a batch's rows on a device.

Rows are copied from and to the packed arrays of the compiled engine.
"""

import os
import shutil
import warnings
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from ..engine.episodes import EpisodeBatch, IntArray
from ..engine.layout import Z
from ..numerics.torch_backend import DTYPES, torch
from ..record import PACKET_WIDTH, Array
from ..task import REPORT, RUNNING, StepReport
from ..validation import format_rows, parse_actions, short_repr
from .gradients import NO_TENSORS, AttachedParameters, ResetTensors, replace_motion
from .torch_outputs import PacketCapacity, read_packed, write_packed
from .torch_step import StepOutcome, TorchReset, TorchState

Tensor = torch.Tensor
_MOTION, _DRIVE, _REFS, _LEAD = (
    slice(part[0], part[-1] + 1) for part in (Z.motion, Z.drive, Z.refs, Z.nominal_motion)
)
_PACKED = _MOTION, _DRIVE, Z.driver, _REFS, _LEAD, Z.clock.tick, Z.clock.failure
"""Places of the first fields of a `TorchState` in the packed state."""


def is_compile_used(is_wanted: bool, device: torch.device) -> bool:
    """Check whether `torch.compile` is wanted and possible; warn if the CPU has no C++ compiler."""
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
    """Parse actions as a tensor (count, width) on the device, rounded to float32.

    Args:
        actions: Tensor, or anything else that the vector env takes.
        count: Number of rows.
        width: Width of an action.
        fail: Whether a wrong shape gives NaN, else ValueError.
        device: Device on which a tensor must be.
        dtype: Type of floats of the result.
        grad: Whether a tensor is not rounded and keeps its graph.

    Returns:
        The actions.
    """
    if not isinstance(actions, torch.Tensor):
        rounded: Tensor = torch.as_tensor(parse_actions(actions, count, width, fail))
        return rounded.to(device, dtype)
    if actions.device != device:
        places = f"on {actions.device}, the env on {device}"
        raise ValueError(f"actions are {places}; nothing was stepped")
    if actions.shape != (count, width):
        if not fail:
            shapes = f"({count}, {width}), got {tuple(actions.shape)}"
            raise ValueError(f"actions have shape {shapes}; nothing was stepped")
        actions = torch.full((count, width), torch.nan, device=device)
    if not grad:
        actions = actions.detach().to(torch.float32)
    commands: Tensor = actions.to(dtype)
    return commands


def refuse_actions(commands: Tensor, bad: Tensor) -> NoReturn:
    """Raise ValueError for commands (N, width) that are not finite where bad (N,) holds."""
    rows = bad.nonzero()[:, 0].tolist()
    got = f"is not finite, {commands[rows[0]].tolist()}"
    raise ValueError(f"the action of {format_rows(rows)} {got}; nothing was stepped")


def _read_states(
    states: Array, over: npt.NDArray[np.bool_], reports: Array, capacity: int, device: torch.device,
    dtype: torch.dtype,
) -> tuple[TorchState, Tensor]:  # fmt: skip
    """Read the state on the device, and the keys (2, N), of packed states (N, STATE_WIDTH)."""
    packed = torch.as_tensor(states.T.copy())
    slow_state = read_packed(packed, capacity)
    parts = [*(packed[part] for part in _PACKED), *slow_state]
    parts += [torch.as_tensor(over.copy()), torch.as_tensor(reports.T.copy())]
    tensors = [tensor.to(device, None if tensor.dtype == torch.bool else dtype) for tensor in parts]
    keys = packed[Z.clock.key_low : Z.clock.key_high + 1].to(device, torch.int64)
    return TorchState(*tensors), keys


def _write_states(state: TorchState, states: Array) -> None:
    """Write the state into packed states (N, STATE_WIDTH), where keys and redraws already are."""
    packed = torch.as_tensor(states.T.copy())
    host_state = TorchState(
        *(x.to("cpu", None if x.dtype == torch.bool else torch.float64) for x in state)
    )
    for part, values in zip(_PACKED, host_state, strict=False):
        packed[part] = values
    write_packed(host_state.slow_state, packed)
    states[:] = packed.numpy().T


def parse_device(device: Any) -> torch.device:
    """Parse a device as its tensors have it: a GPU with an index, the CPU without.

    Raises ValueError for an unknown device and one that is not there.
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
        missing = ": no CUDA driver" if torch.version.cuda else ": built without CUDA"
        finds = f"torch {torch.__version__} finds {available}{'' if count else missing}"
        raise ValueError(f"device {str(device)!r} is not there: {finds}")
    if parsed.type == "cpu":
        return torch.device("cpu")
    index = torch.cuda.current_device() if parsed.index is None else parsed.index
    return torch.device("cuda", index)


def check_arguments(arguments: Mapping[str, Any]) -> None:
    """Refuse arguments of `StabilityVectorEnv` that an env on a device has not: TypeError."""
    for name in ("max_episode_steps", "info", "render_mode"):
        if arguments.get(name) is not None:
            raise TypeError(f"an env on a device has no {name}, got {short_repr(arguments[name])}")


def parse_dtype(dtype: Any) -> torch.dtype:
    """Parse the type of floats from its name or itself; ValueError for another."""
    known = DTYPES | {torch_dtype: torch_dtype for torch_dtype in DTYPES.values()}
    if dtype not in known:
        raise ValueError(f"dtype is 'float64' or 'float32', got {dtype!r}")
    return known[dtype]


def read_infos(report: Tensor) -> dict[str, Any]:
    """Read the numbers of `info` of every row, (N,) each, from reports (len(StepReport), N)."""
    infos: dict[str, Any] = dict(zip(StepReport._fields, report[: REPORT.failure], strict=False))
    infos["failure"] = failure = report[REPORT.failure].to(torch.int64)
    infos["is_success"] = (report[REPORT.ended] == 1.0) & (failure == RUNNING)
    return infos


_RECORD = StepOutcome._fields.index("rows")  # from here on the rows are the last axis


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    Args:
        episodes: Episodes on the host.
        capacities: Capacity of each slow sensor present, by index.
        device: Device.
        dtype: Type of floats.
        start: Tick 0 on tensors, for gradients; without it parameters stay at their place.
    """

    def __init__(
        self, episodes: EpisodeBatch, capacities: dict[int, PacketCapacity], device: torch.device,
        dtype: torch.dtype, start: TorchReset | None = None,
    ) -> None:  # fmt: skip
        self.capacities, self._device, self._dtype = capacities, device, dtype
        self._start, self._attached = start, AttachedParameters()
        self._obs_dtype = dtype if start else torch.float32
        self._capacity = sum(capacity.under_way for capacity in capacities.values())
        new_packets = sum(capacity.frames * capacity.copies for capacity in capacities.values())
        self._packets = self._capacity + new_packets
        all_rows = np.arange(len(episodes.params))
        self.params, self.keys, self.state, self.outcome = self._read_rows(episodes, all_rows)
        self._packed_params = self.params

    def upload(
        self, episodes: EpisodeBatch, rows: IntArray, inputs: ResetTensors = NO_TENSORS
    ) -> None:
        """Copy rows (M,) that were reset to the device, with the reset's tensors."""
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
        """Detach state and outcome from their graph, and give the parameters a new one."""
        self.state = TorchState(*(tensor.detach() for tensor in self.state))
        self.outcome = StepOutcome(*(tensor.detach() for tensor in self.outcome))
        self.params = self._attached.insert_tensors(self._packed_params)

    def download(self, episodes: EpisodeBatch) -> None:
        """Write state, outcome and the inputs' numbers into the episodes."""
        self._attached.write(self.params, episodes.params)
        state = TorchState(*(tensor.detach() for tensor in self.state))
        _write_states(state, episodes.states)
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
        """Read (params, keys, state, the last step's outcome) of rows (M,)."""
        device, dtype = self._device, self._dtype

        def to_device(array: Any, *axes: int) -> Tensor:
            return torch.as_tensor(array.transpose(*axes).copy()).to(device, dtype)

        state, keys = _read_states(
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
