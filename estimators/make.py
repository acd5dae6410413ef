"""`make_estimator`: from a row of the table, or a factory, and options to a filter."""

import functools
import math
from collections.abc import Mapping
from typing import Any, overload

from ..envs.sensors.link import SlowSensor
from ..envs.ticks import TICK
from ..envs.vehicle.vehicle import COMS
from ..envs.vehicle.vehicles import VehicleSource, vehicle_from
from .design.assemble import alone, assemble, told_tyres
from .design.config import configure
from .estimator import Estimator
from .filters import FILTERS
from .late import LateEstimator
from .protocol import EstimatorFactory, ForeignEstimator, label_of
from .registry import Registry


@overload
def make_estimator(name: str, **arguments: Any) -> Estimator: ...


@overload
def make_estimator(name: EstimatorFactory, **arguments: Any) -> Estimator | ForeignEstimator: ...


def make_estimator(
    name: str | EstimatorFactory,
    *,
    vehicle: VehicleSource = COMS,
    sensors: Mapping[str, SlowSensor] | None = None,
    dt: float = TICK,
    speed: float | None = None,
    **options: Any,
) -> Estimator | ForeignEstimator:
    """Build an estimator by name (`sideslip.estimators.FILTERS` lists them).

    name: of `FILTERS`; or a registered name, an entry point "package.module:Name", a class in a
    file, "FILE.py:Name", or a factory, which is called with the arguments below: what it builds
    comes as a `ForeignEstimator`. vehicle: the filter's, as `vehicle_from` takes it. sensors: the
    slow sensors that are there, by name ("camera", "gps"). dt: seconds of a tick. speed: m/s if it
    is held; None measures it with the front wheels. options: of a filter of `FILTERS`, those that
    `FilterConfig` lists.

    Raises
    ------
    ValueError: unknown name, a sensor that is absent, a Q or noise that is no covariance, a
        schedule that does not repeat, a sensor that can be later than the filter's window, options
        that exclude each other, a filter that diverges.
    TypeError: unknown option.
    """
    there, own = dict(sensors or {}), label_of(name)
    if not dt > 0.0:
        raise ValueError(f"{own}: a tick of {dt!r} s")
    if not (isinstance(name, str) and name in FILTERS):
        factory = ESTIMATORS.load(name) if isinstance(name, str) else name
        built = factory(vehicle=vehicle_from(vehicle), sensors=there, dt=dt, speed=speed, **options)
        return built if isinstance(built, Estimator) else ForeignEstimator(built, own, dt, there)
    if speed is not None and not 0.0 <= speed < math.inf:
        raise ValueError(f"{name}: speed is in m/s and not negative, got {speed!r}")
    config = configure(name, FILTERS[name], there, options)
    car = vehicle_from(vehicle)
    layers, schedules = assemble(config, car, dt, speed)
    estimator = (LateEstimator if config.latency else Estimator)(config, dt, layers, schedules)
    several = len(config.sensors) > 1  # no cycle of both to check
    checked = told_tyres(alone(config) if several else config)
    estimator.check(layers if checked is config else assemble(checked, car, dt, speed)[0])
    return estimator


_LEARNED = f"{__package__}.learned.correction"  # rooms above this one, loaded when asked for
ESTIMATORS = Registry(
    "estimator",
    {
        **{name: functools.partial(make_estimator, name) for name in FILTERS},
        "learned": f"{_LEARNED}:learned",
        "learned-exact-kf": f"{_LEARNED}:learned_exact_kf",
        "learned-joint": f"{_LEARNED}:learned_joint",
    },
)
"""Every estimator that has a name: the package's own and those that were registered."""


def register_estimator(name: str, factory: EstimatorFactory | str) -> None:
    """Give an estimator of your own a name that works wherever an estimator's name does.

    factory: as `EstimatorFactory`, or "package.module:Name", which is imported when first asked
    for. A name is known in this process alone; worker processes and `sideslip`'s command line take
    the entry point itself for a name. Raises as `Registry.register`.
    """
    ESTIMATORS.register(name, factory)
