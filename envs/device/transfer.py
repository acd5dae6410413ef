"""The rows of a batch on a device, and their way there and back."""

from typing import Any

import numpy as np

from ..backend.on_torch import torch
from ..engine.episodes import Episodes, Whole
from ..record import PACKET_WIDTH
from .gradient import NOTHING, Attached, Inputs, with_motion
from .packets import Capacity
from .start import Start
from .state import state_of, write_states
from .step import Outcome, State

Tensor = torch.Tensor
_RECORD = Outcome._fields.index("rows")  # from here on the rows are the last axis


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    most: the slow sensors present and each one's capacity. start: tick 0 on tensors, for
    gradients; without one parameters stay where they are, for a graph that reads them there.
    """

    def __init__(
        self,
        episodes: Episodes,
        most: dict[int, Capacity],
        device: torch.device,
        dtype: torch.dtype,
        start: Start | None = None,
    ) -> None:
        self.most, self._device, self._dtype = most, device, dtype
        self._start, self._attached = start, Attached()
        self._obs_dtype = dtype if start else torch.float32
        self._capacity = sum(each.under_way for each in most.values())
        self._packets = self._capacity + sum(each.frames * each.copies for each in most.values())
        everything = np.arange(len(episodes.params))
        self._numbers, self.keys, self.state, self.outcome = self._of(episodes, everything)
        self.params = self._numbers

    def take_over(self, episodes: Episodes, rows: Whole, inputs: Inputs = NOTHING) -> None:
        """Bring rows of the episodes that were reset to the device, and with them the inputs."""
        params, keys, state, outcome = self._of(episodes, rows)
        place = torch.as_tensor(rows, device=self._device)
        if self._start is None:
            self.params.index_copy_(-1, place, params)
        else:
            self._numbers = self._numbers.index_copy(-1, place, params)
            self._attached.put(place, episodes.configs, inputs.parameters)
            self.params = self._attached.into(self._numbers)
            state = state._replace(motion=with_motion(state.motion, inputs.state, place))
            state, outcome = self._start(self.params[:, place], keys, state)
        if len(rows) == len(episodes.params):
            self.keys.copy_(keys)
            self.state, self.outcome = state, outcome
            return

        def merged(old: Tensor, new: Tensor, axis: int = -1) -> Tensor:
            return old.index_copy(axis, place, new)

        self.keys.index_copy_(-1, place, keys)
        self.state = State(*map(merged, self.state, state))
        before = self.outcome
        record = map(merged, before[_RECORD:], outcome[_RECORD:])
        self.outcome = Outcome(merged(before.obs, outcome.obs, 0), *before[1:_RECORD], *record)

    def detach(self) -> None:
        """State and outcome without their graph, and the parameters with a new one."""
        self.state = State(*(each.detach() for each in self.state))
        self.outcome = Outcome(*(each.detach() for each in self.outcome))
        self.params = self._attached.into(self._numbers)

    def give_back(self, episodes: Episodes) -> None:
        """Write state, outcome and the inputs' numbers into the episodes."""
        self._attached.write(self.params, episodes.params)
        state = State(*(each.detach() for each in self.state))
        write_states(state, episodes.states)
        outcome = Outcome(*(each.detach().cpu() for each in self.outcome))
        packets = outcome.packets.permute(2, 0, 1)
        width = min(packets.shape[1], episodes.packets.shape[1])
        episodes.packets[:, :width] = packets[:, :width]
        episodes.rows[:] = outcome.rows.permute(2, 0, 1)
        episodes.over[:] = state.over.cpu()
        episodes.reports[:] = state.report.T.cpu()
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
            torch.as_tensor(episodes.obs[rows]).to(device, self._obs_dtype),
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
