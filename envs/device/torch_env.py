"""`DeviceVectorEnv`: many cars on torch tensors, with gradients; results stay on the device.

Its rows come from and go to the compiled engine's packed arrays. With gradients, a user's tensors
stand in place of packed numbers.
"""

import copy
import dataclasses
import os
import shutil
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from ..engine.batch import BatchArrays, IntArray, NumbaEngine
from ..engine.batch_env import BatchEnv
from ..engine.config import make_car, make_task_params
from ..engine.layout import EpisodeConfig, P, Z
from ..numerics.packed import read
from ..numerics.torch_backend import torch
from ..record import PACKET_WIDTH, Array
from ..sensors.slow import SLOW_NAMES
from ..validation import check_mapping, check_number, describe_unknown
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import Vehicle
from .base import StepEnds, Tensor, TensorVectorEnv
from .torch_sensors import Capacities, PacketCapacity, read_packed, write_packed
from .torch_step import StepOutcome, TorchReset, TorchState, TorchStep

_FIELDS = [field.name for field in dataclasses.fields(Vehicle) if field.name != "name"]
_RECORD = StepOutcome._fields.index("rows")  # from here on the rows are the last axis
_PACKED = [
    slice(part[0], part[-1] + 1) if isinstance(part, tuple) else part
    for part in (Z.motion, Z.drive, Z.driver, Z.refs, Z.nominal_motion, Z.errors, Z.past_efforts,
                 Z.clock.tick, Z.clock.failure)
]  # fmt: skip
"""Places of the first fields of a `TorchState` in the packed state."""


class _ResetTensors(NamedTuple):
    """Tensors in a reset's options in place of numbers, by name."""

    parameters: dict[str, Any]  # of `Vehicle`, as they came: they may change
    state: dict[str, Tensor]  # (N,), of `Motion`


_NO_TENSORS = _ResetTensors({}, {})


def _split_inputs(
    options: Mapping[str, Any], base: EpisodeConfig, count: int, template: Tensor
) -> tuple[dict[str, Any], _ResetTensors]:
    """Split options of reset into those without tensors, and the tensors (N,).

    ValueError for a parameter that the plant does not take from a vehicle, an impossible value,
    another shape or another device.
    """
    remaining = dict(options)
    parameters = dict(check_mapping("reset option parameters", remaining.pop("parameters", {})))
    known = [name for name in _FIELDS if _find_places([name], base)]
    if unknown := [name for name in parameters if name not in known]:
        raise ValueError(describe_unknown("parameter", unknown, known))
    columns = {k: _expand_rows(k, x, count, template).detach() for k, x in parameters.items()}
    for name, column in columns.items():
        for number in column.aminmax():
            base.vehicle.replace(**{name: number.item()})
    if columns and base.scenario.roll:  # which they make together
        for row in set(zip(*(column.tolist() for column in columns.values()), strict=True)):
            base.vehicle.replace(**dict(zip(columns, row, strict=True))).check_roll()
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
    return remaining, _ResetTensors(parameters, tensors)


def _expand_rows(name: str, value: Any, count: int, template: Tensor) -> Tensor:
    """Expand a tensor () or (count,), or a number, to (count,)."""
    if not isinstance(value, torch.Tensor):
        value = template.new_tensor(check_number(name, value))
    if value.shape not in ((), (count,)):
        raise ValueError(f"{name}: a tensor () or ({count},), got {tuple(value.shape)}")
    if value.device != template.device:
        raise ValueError(f"{name} is on {value.device}, the env on {template.device}")
    return value.to(template.dtype).expand(count)  # type: ignore[no-any-return]


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
    return [place for place, value in _pack_vehicle(changed, config).items() if value != value]


class _AttachedParameters:
    """Tensors in the packed parameters of some rows."""

    def __init__(self) -> None:
        # rows by the place that they replace, the configs of all rows, and the parameters
        self._held: list[tuple[dict[int, Tensor], list[EpisodeConfig], dict[str, Any]]] = []

    def put(self, rows: Tensor, configs: list[EpisodeConfig], parameters: dict[str, Any]) -> None:
        """Put parameters, () or (N,), of some rows (M,) in place of those that they had."""
        selected = torch.zeros(len(configs), dtype=torch.bool, device=rows.device)
        selected[rows] = True
        for masks, *_ in self._held:
            masks.update({place: mask & ~selected for place, mask in masks.items()})
        masks = dict.fromkeys(_find_places(parameters, configs[0]), selected)
        if P.car.mu_r in masks:  # it is the vehicle's where the scenario has none of its own
            is_single = [config.scenario.friction_right is None for config in configs]
            masks[P.car.mu_r] = selected & torch.tensor(is_single, device=rows.device)
        held = [*self._held, (masks, list(configs), parameters)]
        self._held = [entry for entry in held if any(mask.any() for mask in entry[0].values())]

    def insert_tensors(self, params: Tensor) -> Tensor:
        """Insert the tensors into packed parameters (PARAMS_WIDTH, N)."""
        columns, count = list(params.unbind(0)), params.shape[1]
        for masks, configs, parameters in self._held:
            values = {
                name: params.new_tensor([getattr(config.vehicle, name) for config in configs])
                for name in _FIELDS
            }
            for name, tensor in parameters.items():
                values[name] = _expand_rows(name, tensor, count, params)
            packed = _pack_vehicle(_replace_values(configs[0].vehicle, values), configs[0])
            for place, mask in masks.items():
                columns[place] = torch.where(mask, packed[place], columns[place])
        return torch.stack(columns) if self._held else params

    def write(self, params: Tensor, packed: Array) -> None:
        """Write the tensors' numbers into parameters (N, PARAMS_WIDTH) on the host."""
        for masks, *_ in self._held:
            for place, mask in masks.items():
                packed[mask.cpu().numpy(), place] = params.detach()[place, mask].cpu()


class _DeviceRows:
    """Parameters, keys, state and last outcome of episodes as tensors; `start` is for gradients."""

    def __init__(
        self, episodes: BatchArrays, capacities: Capacities, device: torch.device,
        dtype: torch.dtype, start: TorchReset | None,
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
        self, episodes: BatchArrays, rows: IntArray, configs: list[EpisodeConfig],
        inputs: _ResetTensors,
    ) -> None:  # fmt: skip
        """Copy rows (M,) that were reset to the device; configs of all N, tensors of the reset."""
        params, keys, state = self._read_states(episodes, rows)
        outcome = self._read_outcome(episodes, rows)
        row_index = torch.as_tensor(rows, device=self._device)
        self.keys.index_copy_(-1, row_index, keys)
        self._packed_params = self._packed_params.index_copy(-1, row_index, params)
        self._attached.put(row_index, configs, inputs.parameters)
        self.params = self._attached.insert_tensors(self._packed_params)
        if self._start is not None:
            motion = dict(zip(Motion._fields, state.motion.unbind(0), strict=True))
            motion |= {name: tensor[row_index] for name, tensor in inputs.state.items()}
            state = state._replace(motion=torch.stack(list(motion.values())))
            state, outcome = self._start(self.params[:, row_index], keys, state)
        if len(rows) == len(episodes.params):
            self.state, self.outcome = state, outcome
            return

        def merge(old: Tensor, new: Tensor, axis: int = -1) -> Tensor:
            return old.index_copy(axis, row_index, new)

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
        """Write state, outcome and the inputs' numbers into the episodes on the host."""
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


class DeviceVectorEnv(TensorVectorEnv):
    """`TensorVectorEnv` by torch's own operations, on any device, with gradients on request.

    In float64 an env-step agrees with the other engines' from the same state to 1e-9, and so does a
    second of stable driving. In float32 a step of 10 ms is within 1e-5 m/s, 1e-6 rad/s and 1e-4 m
    (30 m from the start), a second within 1e-4 m/s, 2e-5 rad/s and 5e-4 m. A step waits for the
    device once, to learn whether an action was bad and whether an episode ended. The compiled
    engine resets on the host, from each row's own generator; its draws are copied. Needs torch, of
    the extra `train`.

    ## Gradients
    With `grad=True` observations, rewards, infos, `rows`, `packets` and `motion` have gradients to
    actions and to tensors () or (N,) in `reset`'s options: `state`, by the names of a `Motion`, and
    `parameters`, by those of a `Vehicle`, true ones in place of the seed's draws. Observations are
    then of `dtype`, else float32, and actions are not rounded. A row that is reset starts a graph
    of its own. At a limit (actuators, grip, actions, the cost's cap) the gradients are those of one
    side; they do not contain the times of failures, ends and arrivals. An env-step in which a row's
    numbers overflow has none.

    Args:
        num_envs: Number of environments N.
        device: "cpu", "cuda", "cuda:1", ...
        dtype: "float64" or "float32".
        autoreset_mode: "NextStep", "SameStep" or "Disabled", as of `StabilityVectorEnv`.
        compile: Whether a tick and the step's end go through `torch.compile`, which takes minutes
            once, and on the CPU needs a C++ compiler (without one it warns and does not).
        grad: Whether results have gradients.
        arguments: Arguments of `StabilityEnv`.

    Raises:
        TypeError: For an argument out of place.
        ValueError: For a value out of place, and a device that is not there.
    """

    def __init__(
        self, num_envs: int = 1, device: str | torch.device = "cpu",
        dtype: str | torch.dtype = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP, *, compile: bool = False,
        grad: bool = False, **arguments: Any,
    ) -> None:  # fmt: skip
        super().__init__(num_envs, device, dtype, autoreset_mode, arguments, is_uniform=False)
        self.engine = NumbaEngine(self.config, num_envs)  # on the host, which resets
        compiler = os.environ.get("CXX", "g++")  # where torch looks for it
        if compile and self.device.type == "cpu" and shutil.which(compiler) is None:
            text = f"compile=True needs a C++ compiler on the CPU, and there is no {compiler!r}"
            warnings.warn(f"{text}: ticks are not compiled", RuntimeWarning, stacklevel=2)
            compile = False
        self._compile, self._grad, slow = compile, grad, self.config.slow
        empty = {i: PacketCapacity(0, 0, 1) for i, name in enumerate(SLOW_NAMES) if name in slow}
        self._build(self._extend_capacities(empty, self.configs))

    def _extend_capacities(
        self, capacities: Capacities, configs: Iterable[EpisodeConfig]
    ) -> Capacities:
        """Extend the slow sensors' capacities to what these configs need, which are checked."""
        unique = list({id(config): config for config in configs}.values())
        for scenario in (config.scenario for config in unique):
            if scenario.steering in ("trace", "wander"):
                text = f"{scenario.name!r}: no {scenario.steering} is driven on a device"
                raise ValueError(text)
        self._check_plants(unique)
        extended = dict(capacities)
        for config in unique:
            for i, capacity in extended.items():
                link = read(config.start.params, P.slow[i])
                frames, copies = -int(-self.control_period // link.period), 1 + (link.duplicate > 0)
                needed = frames, link.max_in_flight, copies
                extended[i] = PacketCapacity(*map(max, capacity, needed))
        return extended

    def _build(self, capacities: Capacities) -> None:
        """Build the step with these capacities, and copy all rows to the device."""
        kinds = self.dtype, self.dtype if self._grad else torch.float32, self.device, self._compile
        self._step = TorchStep(self.config, capacities, *kinds)
        start = TorchReset(self._step) if self._grad else None
        self._rows = _DeviceRows(self.engine.arrays, capacities, self.device, self.dtype, start)

    def _start_rows(self, chosen: IntArray, seeds: dict[int, int], options: dict[str, Any]) -> None:
        """Reset rows on the host, and copy them to the device."""
        inputs, host = _NO_TENSORS, self.engine
        if self._grad:
            place = self.config.base, self.num_envs, self._rows.params
            options, inputs = _split_inputs(options, *place)
        configs, index = self._make_configs(options, chosen)
        capacities = self._extend_capacities(self._rows.capacities, configs)
        needs_rebuild = capacities != self._rows.capacities
        if needs_rebuild and self._grad and len(chosen) < self.num_envs:
            reason = "these sensors take more room than any before"
            raise ValueError(f"{reason}: reset all rows, or the others would lose their gradients")
        if needs_rebuild:
            self._rows.download(host.arrays)
        self._restart_rows(chosen, configs, index, seeds)
        if needs_rebuild:
            self._build(capacities)
        self._rows.upload(host.arrays, chosen, self.configs, inputs)
        self._has_over = bool(self._rows.state.over.any())

    def _advance(self, actions: Any) -> StepEnds:
        """Step all rows; those that were over are reset instead."""
        rows = self._rows
        commands = self._parse_actions(actions, self.dtype, self._grad)
        with torch.set_grad_enabled(self._grad and torch.is_grad_enabled()):
            state, outcome = self._step(rows.params, rows.keys, rows.state, commands)
        flags = torch.stack((outcome.refused.any(), state.over.any()))
        refused, ended = flags.tolist()  # the one time the device is waited for
        if refused and self.config.on_bad_action != "fail":
            self._refuse_actions(outcome.refused.nonzero()[:, 0].tolist(), commands)
        over_rows = rows.state.over if self._has_over else None
        rows.state, rows.outcome, self._has_over = state, outcome, ended
        ends = StepEnds(outcome.rewards, outcome.terminated, outcome.truncated)
        if over_rows is not None:
            self._start_rows(over_rows.nonzero()[:, 0].cpu().numpy(), {}, {})
        if ended and self._mode == AutoresetMode.SAME_STEP:
            ends = ends._replace(final=(outcome.obs, state.report.clone()))
            self._start_rows(state.over.nonzero()[:, 0].cpu().numpy(), {}, {})
        return ends

    def detach(self) -> None:
        """Cut the graph at the state, from earlier actions and states; parameters stay attached."""
        self._rows.detach()

    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._rows.outcome.obs, self._rows.state.report, self._rows.state.over

    def _get_record(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        outcome = self._rows.outcome
        return outcome.rows, outcome.packets, outcome.done, outcome.delivered

    def _get_motion(self) -> Tensor:
        return self._rows.state.motion

    def tensors(self) -> tuple[TorchState, StepOutcome]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""
        return self._rows.state, self._rows.outcome

    def get_state(self) -> Any:
        """Copy the state of all rows, which `StabilityVectorEnv.set_state` takes too."""
        self._rows.download(self.engine.arrays)
        return super().get_state()

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        if "configs" not in snapshot:
            raise ValueError("the snapshot is of engine='cuda'")
        capacities = self._extend_capacities(self._rows.capacities, snapshot["configs"])
        BatchEnv.set_state(self, snapshot)
        self._build(capacities)
