"""Gradients on tensors: a user's tensors in place of packed numbers, and a gate for gradients."""

import copy
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..engine.config import EpisodeConfig, make_car, make_task_params
from ..engine.layout import P
from ..numerics.torch_backend import torch
from ..record import Array
from ..validation import check_mapping, check_number, describe_unknown
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import Vehicle

Tensor = torch.Tensor
_FIELDS = [field.name for field in dataclasses.fields(Vehicle) if field.name != "name"]


class GradientGate:
    """Gate of gradients: they pass to rows that are `open` (N,), finite ones alone, else zeros."""

    open: Tensor

    def __call__(self, value: Tensor) -> Tensor:
        """Gate a value (..., N); `open` may be set until the gradients come."""
        if not (torch.is_grad_enabled() and value.requires_grad):
            return value
        gated = value.view_as(value)
        gated.register_hook(self._filter_gradient)  # type: ignore[no-untyped-call]
        return gated

    def _filter_gradient(self, slope: Tensor) -> Tensor:
        return torch.where(self.open & torch.isfinite(slope), slope, 0.0)


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


def replace_motion(motion: Tensor, state: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """Replace the motion of some rows by a reset's tensors.

    Args:
        motion: Motion of the rows, shape (len(Motion), M).
        state: Tensors by the names of a `Motion`, shape (N,).
        rows: The rows, shape (M,).

    Returns:
        The motion, shape (len(Motion), M).
    """
    numbers = dict(zip(Motion._fields, motion.unbind(0), strict=True))
    return torch.stack([state[name][rows] if name in state else numbers[name] for name in numbers])


class AttachedParameters:
    """Tensors in the packed parameters of some rows."""

    def __init__(self) -> None:
        self._held: list[tuple[Tensor, list[EpisodeConfig], dict[str, Any]]] = []

    def put(
        self, rows: Tensor, configs: Sequence[EpisodeConfig], parameters: dict[str, Any]
    ) -> None:
        """Put parameters of some rows in place of those that they had.

        Args:
            rows: The rows, shape (M,).
            configs: Configs of all N rows.
            parameters: Tensors () or (N,), or numbers, by the names of a `Vehicle`.
        """
        selected = torch.zeros(len(configs), dtype=torch.bool, device=rows.device)
        selected[rows] = True
        remaining = [(mask & ~selected, old, values) for mask, old, values in self._held]
        self._held = [entry for entry in remaining if entry[0].any()]
        if parameters:
            self._held.append((selected, list(configs), parameters))

    def insert_tensors(self, params: Tensor) -> Tensor:
        """Insert the tensors into the packed parameters.

        Args:
            params: Packed parameters, shape (PARAMS_WIDTH, N).

        Returns:
            Parameters with the tensors.
        """
        columns, count = list(params.unbind(0)), params.shape[1]
        for mask, configs, parameters in self._held:
            values = {
                name: params.new_tensor([getattr(config.vehicle, name) for config in configs])
                for name in _FIELDS
            }
            for name, tensor in parameters.items():
                values[name] = _expand_rows(name, tensor, count, params)
            packed = _pack_vehicle(_replace_values(configs[0].vehicle, values), configs[0])
            for place in _find_places(parameters, configs[0]):
                columns[place] = torch.where(mask, packed[place], columns[place])
        return torch.stack(columns) if self._held else params

    def write(self, params: Tensor, packed: Array) -> None:
        """Write the tensors' numbers into the packed parameters on the host.

        Args:
            params: Parameters with the tensors, shape (PARAMS_WIDTH, N).
            packed: Packed parameters, shape (N, PARAMS_WIDTH).
        """
        for mask, configs, parameters in self._held:
            places = _find_places(parameters, configs[0])
            where = np.ix_(mask.cpu().numpy(), np.array(places))
            packed[where] = params.detach()[places].T[mask].cpu()
