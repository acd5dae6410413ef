"""The rows of a batch on a device: what they hold, and its way there and back."""

from typing import Any

import numpy as np

from ..backend.on_torch import torch
from ..engine.episodes import Fleet, Whole
from ..record import PACKET_WIDTH
from .packets import Most
from .state import held_of, write_states
from .step import Brought, Held

Tensor = torch.Tensor
_RECORD = Brought._fields.index("rows")  # from here on the rows are the last axis


class Rows:
    """What a device holds of the rows of a fleet.

    most: the slow sensors present and what each one needs room for.
    """

    def __init__(
        self, fleet: Fleet, most: dict[int, Most], device: torch.device, dtype: torch.dtype
    ) -> None:
        self.most, self._device, self._dtype = most, device, dtype
        self._room = sum(each.under_way for each in most.values())
        self._packets = self._room + sum(each.frames * each.copies for each in most.values())
        everything = np.arange(len(fleet.params))
        self.params, self.keys, self.held, self.brought = self._of(fleet, everything)

    def take_over(self, fleet: Fleet, rows: Whole) -> None:
        """Bring rows of the fleet that were reset to the device."""
        params, keys, held, brought = self._of(fleet, rows)
        if len(rows) == len(fleet.params):
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

    def give_back(self, fleet: Fleet) -> None:
        """Write what the device holds into the fleet."""
        write_states(self.held, fleet.states)
        brought = Brought(*(each.cpu() for each in self.brought))
        packets = brought.packets.permute(2, 0, 1)
        width = min(packets.shape[1], fleet.packets.shape[1])
        fleet.packets[:, :width] = packets[:, :width]
        fleet.rows[:] = brought.rows.permute(2, 0, 1)
        fleet.over[:] = self.held.over.cpu()
        fleet.reports[:] = self.held.report.T.cpu()
        fleet.obs[:] = brought.obs
        fleet.ticks_done[:], fleet.delivered[:] = brought.done, brought.delivered

    def _of(self, fleet: Fleet, rows: Whole) -> tuple[Tensor, Tensor, Held, Brought]:
        """(params, keys, what is held, what the last step brought) of rows of the fleet."""
        device, dtype = self._device, self._dtype

        def there(array: Any, *axes: int) -> Tensor:
            return torch.as_tensor(array.transpose(*axes).copy()).to(device, dtype)

        held, keys = held_of(
            fleet.states[rows], fleet.over[rows], fleet.reports[rows], self._room, device, dtype
        )
        packets = np.zeros((len(rows), self._packets, PACKET_WIDTH))
        width = min(self._packets, fleet.packets.shape[1])
        packets[:, :width] = fleet.packets[rows, :width]
        none = torch.zeros(len(rows), dtype=torch.bool, device=device)
        brought = Brought(
            torch.as_tensor(fleet.obs[rows]).to(device),
            torch.zeros(len(rows), dtype=dtype, device=device),
            none,
            none,
            none,
            there(fleet.rows[rows], 1, 2, 0),
            there(packets, 1, 2, 0),
            torch.as_tensor(fleet.ticks_done[rows]).to(device),
            torch.as_tensor(fleet.delivered[rows]).to(device),
        )
        return there(fleet.params[rows], 1, 0), keys, held, brought
