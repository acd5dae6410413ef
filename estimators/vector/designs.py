"""The few different filters of a batch: each is designed once, their gains lie in one pool."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.sensors.link import SlowSensor
from ...envs.vehicle.vehicle import Vehicle
from ..estimator import Estimator
from ..make import make_estimator

Array = npt.NDArray[np.float64]


class Told(NamedTuple):
    """What a filter is told of its car."""

    vehicle: Vehicle
    sensors: Mapping[str, SlowSensor]
    speed: float | None = None

    @property
    def design(self) -> Any:
        """A key that is equal for filters that differ in the phases of their clocks alone."""
        clocks = [(name, dataclasses.replace(s, phase=0.0)) for name, s in self.sensors.items()]
        return self.vehicle, tuple(sorted(clocks)), self.speed


class Designs:
    """Estimators of one name by what they were told, and the pool of their gains."""

    def __init__(self, name: str, dt: float, options: Mapping[str, Any]) -> None:
        self._name, self._dt, self._options = name, dt, dict(options)
        self._built: dict[Any, Estimator] = {}
        self._places: dict[Any, tuple[int, ...]] = {}
        self.pool = np.zeros(0)

    def __getitem__(self, design: Any) -> Estimator:
        return self._built[design]

    def built(self, told: Told) -> Estimator:
        """The estimator for this, built unless it is at hand."""
        design = told.design
        if design not in self._built:
            self._built[design] = make_estimator(
                self._name,
                vehicle=told.vehicle,
                sensors=told.sensors,
                dt=self._dt,
                speed=told.speed,
                **self._options,
            )
        return self._built[design]

    def gains(self, design: Any) -> Array:
        """The table of a design, to be read and written in the pool."""
        start, *shape = self._places[design]
        return self.pool[start : start + int(np.prod(shape))].reshape(shape)

    def place(self, used: Sequence[Any]) -> npt.NDArray[np.int64]:
        """Lay the gains of the designs in use side by side in a new pool and drop the others.

        Returns where each one's lie, (len(used), 4): offset and shape.
        """
        self._built = {design: self._built[design] for design in dict.fromkeys(used)}
        tables = [
            self.gains(design) if design in self._places else built.gains
            for design, built in self._built.items()
        ]
        ends = np.cumsum([table.size for table in tables])
        self.pool = np.concatenate([table.ravel() for table in tables])
        self._places = {
            design: (int(end) - table.size, *table.shape)
            for design, table, end in zip(self._built, tables, ends, strict=True)
        }
        return np.array([self._places[design] for design in used], np.int64)
