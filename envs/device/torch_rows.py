"""`DeviceRows`: rows of a batch on a device, from and to the compiled engine's packed arrays.

With gradients, a user's tensors stand in place of packed numbers.
"""

import copy
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..engine.batch import BatchArrays, IntArray
from ..engine.config import EpisodeConfig, make_car, make_task_params
from ..engine.layout import P, Z
from ..numerics.torch_backend import torch
from ..record import PACKET_WIDTH, Array
from ..validation import check_mapping, check_number, describe_unknown
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import Vehicle
from .torch_sensors import PacketCapacity, read_packed, write_packed
from .torch_step import StepOutcome, TorchReset, TorchState

Tensor = torch.Tensor
_FIELDS = [field.name for field in dataclasses.fields(Vehicle) if field.name != "name"]
_RECORD = StepOutcome._fields.index("rows")  # from here on the rows are the last axis
_MOTION, _DRIVE, _REFS, _LEAD, _ERRORS, _EFFORTS = (
    slice(part[0], part[-1] + 1)
    for part in (Z.motion, Z.drive, Z.refs, Z.nominal_motion, Z.errors, Z.past_efforts)
)
_PACKED = (
    _MOTION, _DRIVE, Z.driver, _REFS, _LEAD, _ERRORS, _EFFORTS, Z.clock.tick, Z.clock.failure,
)  # fmt: skip
"""Places of the first fields of a `TorchState` in the packed state."""


class ResetTensors(NamedTuple):
    """Tensors in a reset's options in place of numbers, by name."""

    parameters: dict[str, Any]  # of `Vehicle`, as they came: they may change
    state: dict[str, Tensor]  # (N,), of `Motion`


NO_TENSORS = ResetTensors({}, {})


def split_inputs(
    options: Mapping[str, Any], base: EpisodeConfig, count: int, template: Tensor
) -> tuple[dict[str, Any], ResetTensors]:
    """Split options of reset into those without tensors, and the tensors.

    Args:
        options: Options of reset.
        base: Config of an episode without options.
        count: Number of rows.
        template: Tensor with the device and the type of floats.

    Returns:
        Options without tensors, and the tensors; ValueError for a parameter that the plant does not
        take from a vehicle, an impossible value, another shape or another device.
    """
    remaining = dict(options)
    parameters = dict(check_mapping("reset option parameters", remaining.pop("parameters", {})))
    known = [name for name in _FIELDS if _find_places([name], base)]
    if unknown := [name for name in parameters if name not in known]:
        raise ValueError(describe_unknown("parameter", unknown, known))
    for name, value in parameters.items():
        low, high = _expand_rows(name, value, count, template).detach().aminmax()
        base.vehicle.replace(**{name: low.item()}).replace(**{name: high.item()})
    if parameters and base.scenario.roll:  # which they make together
        expanded = (_expand_rows(k, value, count, template) for k, value in parameters.items())
        for row in set(zip(*(tensor.detach().tolist() for tensor in expanded), strict=True)):
            base.vehicle.replace(**dict(zip(parameters, row, strict=True))).check_roll()
    state = remaining.get("state")
    state_values = dict(state) if isinstance(state, Mapping) else {}
    tensors = {
        name: _expand_rows(name, value, count, template)
        for name, value in state_values.items()
        if isinstance(value, torch.Tensor)
    }
    if tensors:
        rows = torch.stack(list(tensors.values())).detach().T.tolist()
        remaining["state"] = [state_values | dict(zip(tensors, row, strict=True)) for row in rows]
    return remaining, ResetTensors(parameters, tensors)


def _expand_rows(name: str, value: Any, count: int, template: Tensor) -> Tensor:
    """Expand a tensor () or (count,), or a number, to (count,)."""
    if not isinstance(value, torch.Tensor):
        value = template.new_tensor(check_number(name, value))
    if value.shape not in ((), (count,)):
        raise ValueError(f"{name}: a tensor () or ({count},), got {tuple(value.shape)}")
    if value.device != template.device:
        raise ValueError(f"{name} is on {value.device}, the env on {template.device}")
    expanded: Tensor = value.to(template.dtype).expand(count)
    return expanded


def _pack_vehicle(vehicle: Vehicle, config: EpisodeConfig) -> dict[int, Any]:
    """Pack the parameters that follow from a vehicle, by place."""
    task = make_task_params(vehicle, config.scenario, True)
    return dict(zip((*P.car, *P.task), (*make_car(vehicle), *task), strict=True))


def _replace_values(vehicle: Vehicle, values: Mapping[str, Any]) -> Vehicle:
    """Copy the vehicle with these values, unchecked."""
    changed = copy.copy(vehicle)
    vars(changed).update(values)
    return changed


def _find_places(names: Iterable[str], config: EpisodeConfig) -> list[int]:
    """Find the places of the packed parameters that depend on these of a vehicle."""
    changed = _replace_values(config.vehicle, dict.fromkeys(names, np.nan))
    # the friction under the right wheels is the vehicle's where the scenario has none of its own
    excluded = () if config.scenario.friction_right is None else (P.car.mu_r,)
    packed = _pack_vehicle(changed, config).items()
    return [place for place, value in packed if value != value and place not in excluded]


def _replace_motion(motion: Tensor, state: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """Replace the motion (len(Motion), M) of some rows (M,) by a reset's tensors (N,)."""
    numbers = dict(zip(Motion._fields, motion.unbind(0), strict=True))
    return torch.stack([state[name][rows] if name in state else numbers[name] for name in numbers])


class _AttachedParameters:
    """Tensors in the packed parameters of some rows."""

    def __init__(self) -> None:
        # rows of one scenario, its config, the configs of all rows, and the parameters
        self._held: list[tuple[Tensor, EpisodeConfig, list[EpisodeConfig], dict[str, Any]]] = []

    def put(
        self, rows: Tensor, configs: Sequence[EpisodeConfig], parameters: dict[str, Any]
    ) -> None:
        """Put parameters, () or (N,), of some rows (M,) in place of those that they had."""
        selected = torch.zeros(len(configs), dtype=torch.bool, device=rows.device)
        selected[rows] = True
        held = [(mask & ~selected, base, old, x) for mask, base, old, x in self._held]
        self._held = [entry for entry in held if entry[0].any()]
        texts, groups = dict[int, str](), dict[str, list[int]]()  # most rows share one scenario
        for row in rows.tolist() if parameters else ():
            scenario = configs[row].scenario
            text = texts.get(id(scenario)) or texts.setdefault(id(scenario), repr(scenario))
            groups.setdefault(text, []).append(row)
        for members in groups.values():
            mask = torch.zeros_like(selected)
            mask[members] = True
            self._held.append((mask, configs[members[0]], list(configs), parameters))

    def insert_tensors(self, params: Tensor) -> Tensor:
        """Insert the tensors into packed parameters (PARAMS_WIDTH, N)."""
        columns, count = list(params.unbind(0)), params.shape[1]
        for mask, base, configs, parameters in self._held:
            values = {
                name: params.new_tensor([getattr(config.vehicle, name) for config in configs])
                for name in _FIELDS
            }
            for name, tensor in parameters.items():
                values[name] = _expand_rows(name, tensor, count, params)
            packed = _pack_vehicle(_replace_values(base.vehicle, values), base)
            for place in _find_places(parameters, base):
                columns[place] = torch.where(mask, packed[place], columns[place])
        return torch.stack(columns) if self._held else params

    def write(self, params: Tensor, packed: Array) -> None:
        """Write the tensors' numbers into parameters (N, PARAMS_WIDTH) on the host."""
        for mask, base, _, parameters in self._held:
            places = _find_places(parameters, base)
            where = np.ix_(mask.cpu().numpy(), np.array(places))
            packed[where] = params.detach()[places].T[mask].cpu()


class DeviceRows:
    """Parameters, keys, state and last outcome of episodes, as tensors on a device.

    Args:
        episodes: Arrays of the episodes on the host.
        capacities: Capacity of each slow sensor present, by index.
        device: Device of the tensors.
        dtype: Type of floats.
        start: Tick 0 on tensors, for gradients; without it parameters stay at their place.
    """

    def __init__(
        self, episodes: BatchArrays, capacities: dict[int, PacketCapacity], device: torch.device,
        dtype: torch.dtype, start: TorchReset | None = None,
    ) -> None:  # fmt: skip
        self.capacities, self._device, self._dtype = capacities, device, dtype
        self._start, self._attached = start, _AttachedParameters()
        self._obs_dtype = dtype if start else torch.float32
        self._capacity = sum(capacity.under_way for capacity in capacities.values())
        new_packets = sum(capacity.frames * capacity.copies for capacity in capacities.values())
        self._packets = self._capacity + new_packets
        all_rows = np.arange(len(episodes.params))
        self._packed_params, self.keys, self.state = self._read_states(episodes, all_rows)
        self.params, self.outcome = self._packed_params, self._read_outcome(episodes, all_rows)

    def upload(
        self, episodes: BatchArrays, rows: IntArray, configs: Sequence[EpisodeConfig],
        inputs: ResetTensors = NO_TENSORS,
    ) -> None:  # fmt: skip
        """Copy rows that were reset to the device.

        Args:
            episodes: Arrays of the episodes on the host.
            rows: Rows that were reset, shape (M,).
            configs: Configs of all N rows.
            inputs: Tensors of the reset.
        """
        params, keys, state = self._read_states(episodes, rows)
        outcome = self._read_outcome(episodes, rows)
        row_index = torch.as_tensor(rows, device=self._device)
        if self._start is None:
            self.params.index_copy_(-1, row_index, params)
        else:
            self._packed_params = self._packed_params.index_copy(-1, row_index, params)
            self._attached.put(row_index, configs, inputs.parameters)
            self.params = self._attached.insert_tensors(self._packed_params)
            state = state._replace(motion=_replace_motion(state.motion, inputs.state, row_index))
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

    def download(self, episodes: BatchArrays) -> None:
        """Write state, outcome and the inputs' numbers into the episodes.

        Args:
            episodes: Arrays of the episodes on the host.
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
        self, episodes: BatchArrays, rows: IntArray
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

    def _read_outcome(self, episodes: BatchArrays, rows: IntArray) -> StepOutcome:
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
