"""`DeviceRows`: rows of a batch on a device, from and to the compiled engine's packed arrays."""

import numpy as np
from numpy.typing import NDArray

from ..engine.episodes import EpisodeBatch, IntArray
from ..engine.layout import Z
from ..numerics.torch_backend import torch
from ..record import PACKET_WIDTH
from .gradients import NO_TENSORS, AttachedParameters, ResetTensors, replace_motion
from .torch_sensors import PacketCapacity, read_packed, write_packed
from .torch_step import StepOutcome, TorchReset, TorchState

Tensor = torch.Tensor
_RECORD = StepOutcome._fields.index("rows")  # from here on the rows are the last axis
_MOTION, _DRIVE, _REFS, _LEAD = (
    slice(part[0], part[-1] + 1) for part in (Z.motion, Z.drive, Z.refs, Z.nominal_motion)
)
_PACKED = _MOTION, _DRIVE, Z.driver, _REFS, _LEAD, Z.clock.tick, Z.clock.failure
"""Places of the first fields of a `TorchState` in the packed state."""


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    Args:
        episodes: Episodes on the host.
        capacities: Capacity of each slow sensor present, by index.
        device: Device of the tensors.
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
        self._packed_params, self.keys, self.state = self._read_states(episodes, all_rows)
        self.params, self.outcome = self._packed_params, self._read_outcome(episodes, all_rows)

    def upload(
        self, episodes: EpisodeBatch, rows: IntArray, inputs: ResetTensors = NO_TENSORS
    ) -> None:
        """Copy rows that were reset to the device.

        Args:
            episodes: Episodes on the host.
            rows: Rows that were reset, shape (M,).
            inputs: Tensors of the reset.
        """
        params, keys, state = self._read_states(episodes, rows)
        outcome = self._read_outcome(episodes, rows)
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
        """Write state, outcome and the inputs' numbers into the episodes.

        Args:
            episodes: Episodes on the host.
        """
        self._attached.write(self.params, episodes.params)
        # keys and redraws are in the packed states already
        packed = torch.as_tensor(episodes.states.T.copy())
        host_state = [tensor.detach().to(packed) for tensor in self.state]
        for part, values in zip(_PACKED, host_state, strict=False):
            packed[part] = values
        state = TorchState(*host_state)
        write_packed(state.slow_state, packed)
        episodes.states[:] = packed.numpy().T
        outcome = StepOutcome(*(tensor.detach().cpu() for tensor in self.outcome))
        packets = outcome.packets.permute(2, 0, 1)
        width = min(packets.shape[1], episodes.packets.shape[1])
        episodes.packets[:, :width] = packets[:, :width]
        episodes.rows[:] = outcome.rows.permute(2, 0, 1)
        episodes.over[:], episodes.reports[:] = state.over, state.report.T
        episodes.obs[:] = outcome.obs
        episodes.ticks_done[:], episodes.delivered[:] = outcome.done, outcome.delivered

    def _move(self, array: NDArray[np.float64], *axes: int) -> Tensor:
        """Copy an array to the device, its axes in this order."""
        return torch.as_tensor(array.transpose(axes).copy()).to(self._device, self._dtype)

    def _read_states(
        self, episodes: EpisodeBatch, rows: IntArray
    ) -> tuple[Tensor, Tensor, TorchState]:
        """Read parameters, keys and state of rows (M,)."""
        packed = torch.as_tensor(episodes.states[rows].T.copy())
        slow_state = read_packed(packed, self._capacity)
        parts = [*(packed[part] for part in _PACKED), *slow_state]
        parts = [part.to(self._device, self._dtype) for part in parts]
        parts.append(torch.as_tensor(episodes.over[rows].copy()).to(self._device))
        parts.append(self._move(episodes.reports[rows], 1, 0))
        state = TorchState(*parts)
        keys = packed[Z.clock.key_low : Z.clock.key_high + 1].to(self._device, torch.int64)
        return self._move(episodes.params[rows], 1, 0), keys, state

    def _read_outcome(self, episodes: EpisodeBatch, rows: IntArray) -> StepOutcome:
        """Read the last step's outcome of rows (M,)."""
        device = self._device
        packets = np.zeros((len(rows), self._packets, PACKET_WIDTH))
        width = min(self._packets, episodes.packets.shape[1])
        packets[:, :width] = episodes.packets[rows, :width]
        no_rows = torch.zeros(len(rows), dtype=torch.bool, device=device)
        return StepOutcome(
            torch.as_tensor(episodes.obs[rows]).to(device, self._obs_dtype),
            torch.zeros(len(rows), dtype=self._dtype, device=device), no_rows, no_rows, no_rows,
            self._move(episodes.rows[rows], 1, 2, 0), self._move(packets, 1, 2, 0),
            torch.as_tensor(episodes.ticks_done[rows]).to(device),
            torch.as_tensor(episodes.delivered[rows]).to(device),
        )  # fmt: skip
