"""The rows of a batch on a device, and their way there and back."""

from typing import Any

import numpy as np

from ..backend.on_torch import torch
from ..engine.episodes import EpisodeBatch, IntArray
from ..record import PACKET_WIDTH
from .gradient import NO_TENSORS, AttachedParameters, ResetTensors, replace_motion
from .packets import PacketCapacity
from .start import TorchReset
from .state import read_states, write_states
from .step import StepOutcome, TorchState

Tensor = torch.Tensor
_RECORD = StepOutcome._fields.index("rows")  # from here on the rows are the last axis


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    capacities: the slow sensors present and each one's capacity. start: tick 0 on tensors, for
    gradients; without one parameters stay where they are, for a graph that reads them there.
    """

    def __init__(
        self,
        episodes: EpisodeBatch,
        capacities: dict[int, PacketCapacity],
        device: torch.device,
        dtype: torch.dtype,
        start: TorchReset | None = None,
    ) -> None:
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
            episodes.states[rows],
            episodes.over[rows],
            episodes.reports[rows],
            self._capacity,
            device,
            dtype,
        )
        packets = np.zeros((len(rows), self._packets, PACKET_WIDTH))
        width = min(self._packets, episodes.packets.shape[1])
        packets[:, :width] = episodes.packets[rows, :width]
        no_rows = torch.zeros(len(rows), dtype=torch.bool, device=device)
        outcome = StepOutcome(
            torch.as_tensor(episodes.obs[rows]).to(device, self._obs_dtype),
            torch.zeros(len(rows), dtype=dtype, device=device),
            no_rows,
            no_rows,
            no_rows,
            to_device(episodes.rows[rows], 1, 2, 0),
            to_device(packets, 1, 2, 0),
            torch.as_tensor(episodes.ticks_done[rows]).to(device),
            torch.as_tensor(episodes.delivered[rows]).to(device),
        )
        return to_device(episodes.params[rows], 1, 0), keys, state, outcome
