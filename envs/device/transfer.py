"""The rows of a batch on a device, and their way there and back."""

from typing import Any

import numpy as np

from ..backend.on_torch import torch
from ..engine.episodes import Episodes, Whole
from ..record import PACKET_WIDTH
from .packets import Capacity
from .state import state_of, write_states
from .step import Outcome, State

Tensor = torch.Tensor
_RECORD = Outcome._fields.index("rows")  # from here on the rows are the last axis


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    most: the slow sensors present and each one's capacity.
    """

    def __init__(
        self,
        episodes: Episodes,
        most: dict[int, Capacity],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.most, self._device, self._dtype = most, device, dtype
        self._capacity = sum(each.under_way for each in most.values())
        self._packets = self._capacity + sum(each.frames * each.copies for each in most.values())
        everything = np.arange(len(episodes.params))
        self.params, self.keys, self.state, self.outcome = self._of(episodes, everything)

    def take_over(self, episodes: Episodes, rows: Whole) -> None:
        """Bring rows of the episodes that were reset to the device."""
        params, keys, state, outcome = self._of(episodes, rows)
        if len(rows) == len(episodes.params):
            self.params.copy_(params)  # in place: a graph reads them where they are
            self.keys.copy_(keys)
            self.state, self.outcome = state, outcome
            return
        place = torch.as_tensor(rows, device=self._device)

        def merged(old: Tensor, new: Tensor, axis: int = -1) -> Tensor:
            return old.index_copy(axis, place, new)

        self.params.index_copy_(-1, place, params)
        self.keys.index_copy_(-1, place, keys)
        self.state = State(*map(merged, self.state, state))
        before = self.outcome
        record = map(merged, before[_RECORD:], outcome[_RECORD:])
        self.outcome = Outcome(merged(before.obs, outcome.obs, 0), *before[1:_RECORD], *record)

    def give_back(self, episodes: Episodes) -> None:
        """Write state and outcome into the episodes."""
        write_states(self.state, episodes.states)
        outcome = Outcome(*(each.cpu() for each in self.outcome))
        packets = outcome.packets.permute(2, 0, 1)
        width = min(packets.shape[1], episodes.packets.shape[1])
        episodes.packets[:, :width] = packets[:, :width]
        episodes.rows[:] = outcome.rows.permute(2, 0, 1)
        episodes.over[:] = self.state.over.cpu()
        episodes.reports[:] = self.state.report.T.cpu()
        episodes.obs[:] = outcome.obs
        episodes.ticks_done[:], episodes.delivered[:] = outcome.done, outcome.delivered

    def _of(self, episodes: Episodes, rows: Whole) -> tuple[Tensor, Tensor, State, Outcome]:
        """(params, keys, state, the last step's outcome) of some rows."""
        device, dtype = self._device, self._dtype

        def there(array: Any, *axes: int) -> Tensor:
            return torch.as_tensor(array.transpose(*axes).copy()).to(device, dtype)

        state, keys = state_of(
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
        none = torch.zeros(len(rows), dtype=torch.bool, device=device)
        outcome = Outcome(
            torch.as_tensor(episodes.obs[rows]).to(device),
            torch.zeros(len(rows), dtype=dtype, device=device),
            none,
            none,
            none,
            there(episodes.rows[rows], 1, 2, 0),
            there(packets, 1, 2, 0),
            torch.as_tensor(episodes.ticks_done[rows]).to(device),
            torch.as_tensor(episodes.delivered[rows]).to(device),
        )
        return there(episodes.params[rows], 1, 0), keys, state, outcome
