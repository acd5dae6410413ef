"""The rows of a batch on a device: what they hold, and its way there and back."""

from typing import Any

import numpy as np

from ..backend.on_torch import torch
from ..engine.episodes import Episodes, Whole
from ..record import PACKET_WIDTH
from .packets import Most
from .state import held_of, write_states
from .step import Brought, Held

Tensor = torch.Tensor
_RECORD = Brought._fields.index("rows")  # from here on the rows are the last axis


class DeviceRows:
    """What a device holds of the rows of a episodes.

    most: the slow sensors present and what each one needs room for.
    """

    def __init__(
        self, episodes: Episodes, most: dict[int, Most], device: torch.device, dtype: torch.dtype
    ) -> None:
        self.most, self._device, self._dtype = most, device, dtype
        self._room = sum(each.under_way for each in most.values())
        self._packets = self._room + sum(each.frames * each.copies for each in most.values())
        everything = np.arange(len(episodes.params))
        self.params, self.keys, self.held, self.brought = self._of(episodes, everything)

    def take_over(self, episodes: Episodes, rows: Whole) -> None:
        """Bring rows of the episodes that were reset to the device."""
        params, keys, held, brought = self._of(episodes, rows)
        if len(rows) == len(episodes.params):
            self.params.copy_(params)  # in place: a graph reads them where they are
            self.keys.copy_(keys)
            self.held, self.brought = held, brought
            return
        place = torch.as_tensor(rows, device=self._device)

        def merged(old: Tensor, new: Tensor, axis: int = -1) -> Tensor:
            return old.index_copy(axis, place, new)

        self.params.index_copy_(-1, place, params)
        self.keys.index_copy_(-1, place, keys)
        self.held = Held(*map(merged, self.held, held))
        before = self.brought
        record = map(merged, before[_RECORD:], brought[_RECORD:])
        self.brought = Brought(merged(before.obs, brought.obs, 0), *before[1:_RECORD], *record)

    def give_back(self, episodes: Episodes) -> None:
        """Write what the device holds into the episodes."""
        write_states(self.held, episodes.states)
        brought = Brought(*(each.cpu() for each in self.brought))
        packets = brought.packets.permute(2, 0, 1)
        width = min(packets.shape[1], episodes.packets.shape[1])
        episodes.packets[:, :width] = packets[:, :width]
        episodes.rows[:] = brought.rows.permute(2, 0, 1)
        episodes.over[:] = self.held.over.cpu()
        episodes.reports[:] = self.held.report.T.cpu()
        episodes.obs[:] = brought.obs
        episodes.ticks_done[:], episodes.delivered[:] = brought.done, brought.delivered

    def _of(self, episodes: Episodes, rows: Whole) -> tuple[Tensor, Tensor, Held, Brought]:
        """(params, keys, what is held, what the last step brought) of some rows."""
        device, dtype = self._device, self._dtype

        def there(array: Any, *axes: int) -> Tensor:
            return torch.as_tensor(array.transpose(*axes).copy()).to(device, dtype)

        held, keys = held_of(
            episodes.states[rows],
            episodes.over[rows],
            episodes.reports[rows],
            self._room,
            device,
            dtype,
        )
        packets = np.zeros((len(rows), self._packets, PACKET_WIDTH))
        width = min(self._packets, episodes.packets.shape[1])
        packets[:, :width] = episodes.packets[rows, :width]
        none = torch.zeros(len(rows), dtype=torch.bool, device=device)
        brought = Brought(
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
        return there(episodes.params[rows], 1, 0), keys, held, brought
