"""A user's tensors in the place of packed numbers, with their graph; what must not flow back."""

import copy
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arguments import mapping_of, number_of, unknown_names
from ..backend.on_torch import torch
from ..engine.layout import P
from ..engine.packing import EpisodeConfig, car_of, task_of
from ..record import Array
from ..vehicle.dynamics import Motion
from ..vehicle.vehicle import Vehicle

Tensor = torch.Tensor
_FIELDS = [each.name for each in dataclasses.fields(Vehicle) if each.name != "name"]


class Gate:
    """Lets gradients through to the rows that are `open` (N,), zero to the others.

    Where numbers overflow a slope is no number, and stays none when it is multiplied by zero; so
    do slopes that overflow while the numbers do not yet.
    """

    open: Tensor

    def __call__(self, value: Tensor) -> Tensor:
        """The value (..., N); `open` may be set until the gradients come."""
        if not (torch.is_grad_enabled() and value.requires_grad):
            return value
        passed = value.view_as(value)
        passed.register_hook(self._let_through)  # type: ignore[no-untyped-call]
        return passed

    def _let_through(self, slope: Tensor) -> Tensor:
        return torch.where(self.open & torch.isfinite(slope), slope, 0.0)


class Inputs(NamedTuple):
    """Tensors that a reset has in the place of numbers, by name."""

    parameters: dict[str, Any]  # of `Vehicle`, as they came: they may change
    state: dict[str, Tensor]  # (N,), of `Motion`


NOTHING = Inputs({}, {})


def inputs_of(
    options: Mapping[str, Any], base: EpisodeConfig, count: int, like: Tensor
) -> tuple[dict[str, Any], Inputs]:
    """(options of reset without tensors, those tensors) for `count` rows.

    like: has the device and the dtype. Raises ValueError for a parameter that the plant does not
    take from a vehicle by itself, a value that no vehicle has, another shape or another device.
    """
    rest = dict(options)
    parameters = dict(mapping_of("reset option parameters", rest.pop("parameters", {})))
    known = [name for name in _FIELDS if _places_of([name], base)]
    if unknown := [name for name in parameters if name not in known]:
        raise ValueError(unknown_names("parameter", unknown, known))
    for name, value in parameters.items():
        low, high = _of_rows(name, value, count, like).detach().aminmax()
        base.vehicle.replace(**{name: low.item()}).replace(**{name: high.item()})
    if parameters and base.scenario.roll:  # which they make together
        columns = [_of_rows(k, each, count, like).detach() for k, each in parameters.items()]
        for row in set(zip(*(each.tolist() for each in columns), strict=True)):
            base.vehicle.replace(**dict(zip(parameters, row, strict=True))).check_roll()
    state = rest.get("state")
    named = dict(state) if isinstance(state, Mapping) else {}
    found = {name: each for name, each in named.items() if isinstance(each, torch.Tensor)}
    tensors = {name: _of_rows(name, each, count, like) for name, each in found.items()}
    if tensors:
        rows = torch.stack(list(tensors.values())).detach().T.tolist()
        rest["state"] = [named | dict(zip(tensors, row, strict=True)) for row in rows]
    return rest, Inputs(parameters, tensors)


def _of_rows(name: str, value: Any, count: int, like: Tensor) -> Tensor:
    """A tensor () or (count,), or a number, as (count,)."""
    if not isinstance(value, torch.Tensor):
        value = like.new_tensor(number_of(name, value))
    if value.shape not in ((), (count,)):
        raise ValueError(f"{name}: a tensor () or ({count},), got {tuple(value.shape)}")
    if value.device != like.device:
        raise ValueError(f"{name} is on {value.device}, the env on {like.device}")
    of_rows: Tensor = value.to(like.dtype).expand(count)
    return of_rows


def _packed(vehicle: Vehicle, config: EpisodeConfig) -> dict[int, Any]:
    """The packed parameters that follow from a vehicle, by place."""
    task = task_of(vehicle, config.scenario, True)
    return dict(zip((*P.car, *P.task), (*car_of(vehicle), *task), strict=True))


def _with(vehicle: Vehicle, values: Mapping[str, Any]) -> Vehicle:
    """A copy of the vehicle with these values, which are not looked at."""
    changed = copy.copy(vehicle)
    vars(changed).update(values)
    return changed


def _places_of(names: Iterable[str], config: EpisodeConfig) -> list[int]:
    """Where the packed parameters lie that these of a vehicle make: without them they are NaN.

    The friction under the right wheels is the vehicle's where the scenario has none of its own.
    """
    without = _with(config.vehicle, dict.fromkeys(names, np.nan))
    own = () if config.scenario.friction_right is None else (P.car.mu_r,)
    packed = _packed(without, config).items()
    return [place for place, value in packed if value != value and place not in own]


def with_motion(motion: Tensor, state: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """The motion (len(Motion), M) of some rows with the tensors (N,) of a reset."""
    numbers = dict(zip(Motion._fields, motion.unbind(0), strict=True))
    return torch.stack([state[name][rows] if name in state else numbers[name] for name in numbers])


class Attached:
    """The tensors that stand in the packed parameters of some rows."""

    def __init__(self) -> None:
        self._held: list[tuple[Tensor, list[EpisodeConfig], dict[str, Any]]] = []

    def put(
        self, rows: Tensor, configs: Sequence[EpisodeConfig], parameters: dict[str, Any]
    ) -> None:
        """Parameters (N,) of these rows (M,) from now on, in the place of those that they had."""
        own = torch.zeros(len(configs), dtype=torch.bool, device=rows.device)
        own[rows] = True
        left = [(mask & ~own, of, held) for mask, of, held in self._held]
        self._held = [each for each in left if each[0].any()]
        if parameters:
            self._held.append((own, list(configs), parameters))

    def into(self, params: Tensor) -> Tensor:
        """The packed parameters (PARAMS_WIDTH, N) with them."""
        columns, count = list(params.unbind(0)), params.shape[1]
        for mask, configs, parameters in self._held:
            values = {
                name: params.new_tensor([getattr(config.vehicle, name) for config in configs])
                for name in _FIELDS
            }
            values |= {k: _of_rows(k, each, count, params) for k, each in parameters.items()}
            packed = _packed(_with(configs[0].vehicle, values), configs[0])
            for place in _places_of(parameters, configs[0]):
                columns[place] = torch.where(mask, packed[place], columns[place])
        return torch.stack(columns) if self._held else params

    def write(self, params: Tensor, packed: Array) -> None:
        """Their numbers from params (PARAMS_WIDTH, N) into packed ones (N, PARAMS_WIDTH)."""
        for mask, configs, parameters in self._held:
            places = _places_of(parameters, configs[0])
            where = np.ix_(mask.cpu().numpy(), np.array(places))
            packed[where] = params.detach()[places].T[mask].cpu()
