"""Estimators by name: from a row of the table of filters, or a factory, and options."""

import functools
import inspect
import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, overload

from ..envs.sensors.link import SlowSensor
from ..envs.ticks import TICK
from ..envs.vehicle.parameters import COMS, VehicleSource, make_vehicle
from .delayed_channels import LateEstimator
from .design.assemble import assemble
from .design.config import parse_config
from .design.options import PARAMETERS
from .estimator import Estimator
from .filters import FILTERS
from .protocol import EstimatorFactory, ForeignEstimator, get_label
from .registry import Registry

if TYPE_CHECKING:

    @overload
    def make_estimator(name: str, **arguments: Any) -> Estimator: ...

    @overload
    def make_estimator(
        name: EstimatorFactory, **arguments: Any
    ) -> Estimator | ForeignEstimator: ...


def make_estimator(
    name: str | EstimatorFactory,
    *,
    vehicle: VehicleSource = COMS,
    sensors: Mapping[str, SlowSensor] | None = None,
    dt: float = TICK,
    speed: float | None = None,
    present: Collection[str] | None = None,
    **options: Any,
) -> Estimator | ForeignEstimator:
    """Build an estimator by name (`sideslip.estimators.FILTERS` lists them).

    An unknown option raises TypeError; unknown names, absent sensors and options that are at odds
    ValueError, as do noise that is no covariance, a sensor later than the window, and divergence.

    Args:
        name: Name of `FILTERS`, registered name, entry point "package.module:Name", class in a
            file, "FILE.py:Name", or a factory. A factory is called with the arguments below.
        vehicle: The filter's vehicle, as `make_vehicle` takes it.
        sensors: Available slow sensors by name ("camera", "gps").
        dt: Tick (s).
        speed: Speed (m/s) if it is held; None measures it with the front wheels.
        present: Columns that the record carries, as `Record.present`; None: all. A filter of
            `FILTERS` does without absent fast sensors, unless `fast` names them.
        **options: Options of a filter of `FILTERS`, which `FilterOptions` lists, or of the factory.

    Returns:
        The estimator; what a factory builds comes as a `ForeignEstimator`.
    """
    available, label = dict(sensors or {}), get_label(name)
    if not dt > 0.0:
        raise ValueError(f"{label}: a tick of {dt!r} s")
    if not (isinstance(name, str) and name in FILTERS):
        factory = ESTIMATORS.load(name) if isinstance(name, str) else name
        car = make_vehicle(vehicle)
        built = factory(vehicle=car, sensors=available, dt=dt, speed=speed, **options)
        if isinstance(built, Estimator):
            return built
        return ForeignEstimator(built, label, dt, available)
    if speed is not None and not 0.0 <= speed < math.inf:
        raise ValueError(f"{name}: speed is in m/s and not negative, got {speed!r}")
    fast = dict(FILTERS[name].options).get("fast", ())
    if present is not None and not {*fast} <= {"gyro", *present}:
        options = {"fast": tuple(x for x in fast if x in {"gyro", *present})} | options
    config = parse_config(name, FILTERS[name], available, options)
    car = make_vehicle(vehicle)
    layers, schedules = assemble(config, car, dt, speed)
    estimator = (LateEstimator if config.latency else Estimator)(config, dt, layers, schedules)
    checked = config.linear_part
    estimator.check(layers if checked is config else assemble(checked, car, dt, speed)[0])
    return estimator


_SIGNATURE = inspect.signature(make_estimator)
*_NAMED, _OTHERS = _SIGNATURE.parameters.values()
# completions and `help` see every option of a filter
make_estimator.__signature__ = _SIGNATURE.replace(  # type: ignore[attr-defined]
    parameters=[*_NAMED, *PARAMETERS, _OTHERS]
)

ESTIMATORS = Registry(
    "estimator", {name: functools.partial(make_estimator, name) for name in FILTERS}
)
"""Every estimator that has a name: the package's own and those that were registered."""


def register_estimator(name: str, factory: EstimatorFactory | str) -> None:
    """Register an estimator of your own under a name that works wherever an estimator's name does.

    A name is known in this process alone. Worker processes and `sideslip`'s command line take the
    entry point itself for a name. Errors are those of `Registry.register`.

    Args:
        name: New name, without a colon.
        factory: An `EstimatorFactory`, or "package.module:Name", imported at its first use.
    """
    ESTIMATORS.register(name, factory)
