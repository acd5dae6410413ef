"""`make_estimator`: from a row of the table and options to a filter."""

import functools
import math
from collections.abc import Mapping
from typing import Any, overload

import numpy as np

from ..envs.sensors.link import SlowSensor
from ..envs.ticks import TICK
from ..envs.vehicle.vehicle import COMS, Vehicle, vehicle_from
from .core.memory import FILTER
from .design.configure import Common, plans, write_clocks, write_rules, write_speed
from .design.late_samples import check_window, place_clones
from .design.models import write_model
from .design.options import Options, check_prior, noise_levels, prior_variances, process_noise
from .design.request import models_of, slow_sensors, wish_of
from .design.schedule import Schedule
from .design.tunings import TUNINGS
from .estimator import Estimator
from .filters import FILTERS
from .protocol import EstimatorFactory, ForeignEstimator, label_of
from .registry import Registry


@overload
def make_estimator(name: str, **arguments: Any) -> Estimator: ...


@overload
def make_estimator(name: EstimatorFactory, **arguments: Any) -> Estimator | ForeignEstimator: ...


def make_estimator(
    name: str | EstimatorFactory,
    *,
    vehicle: Vehicle | str | Mapping[str, Any] = COMS,
    sensors: Mapping[str, SlowSensor] | None = None,
    dt: float = TICK,
    speed: float | None = None,
    **options: Any,
) -> Estimator | ForeignEstimator:
    """Build an estimator by name (`sideslip.estimators.FILTERS` lists them).

    name: of `FILTERS`; or a registered name, an entry point "package.module:Name" or a factory,
    which is called with the arguments below: what it builds comes as a `ForeignEstimator`.
    vehicle: what the filter is told. sensors: the slow sensors that are there, "camera" and "gps".
    dt: seconds of a tick. speed: m/s if it is held; None measures it with the front wheels.

    Options
    -------
    slow: the slow sensor to use (default: the first of camera, gps that it can use and that is
        there). A filter with gains "covariance" also takes several.
    gains: "periodic" (precomputed for a schedule that repeats) or "covariance"; of dual-rate
        "constant", "from-29" or "placed" (with poles).
    delay: "clone" or "buffer" (late samples used exactly), "larsen", "stored", "constant" (with
        assumed_delay in s), "literal", "lag" or "ignore": `sideslip.estimators.delay` says what
        they are.
    between: of single-rate-kf, "hold" (default) or "predict" between its steps.
    intersample: of double-layer "pseudo-residual" (default) or "predict"; of dual-rate "pseudo"
        (default), "predict", "hold" or "oh".
    inverse: the generalised inverse of the pseudo-residual rule, "moore-penrose", "p-weighted",
        "tikhonov" or "bayes".
    poles: negative numbers in rad/s, one for each state, where gains are placed: of the filter's
        error, of dual-rate as `sideslip.estimators.DualRate` says.
    disturbances: of a bicycle, "none", "walk" (d1 and d2 push beta and gamma), "walk-all" (d3
        pushes psi) or "forces" (an Ornstein-Uhlenbeck force and moment).
    leak: 1/s, by which disturbances decay on top of that.
    q_beta, q_gamma, ...: process noise of a state per second, (unit)^2/s; or Q, (n, n) or (n,).
    gyro_noise (rad/s), psi_noise (rad), y_l_noise (m), course_noise (rad at every speed; default
        0.14 deg at 60 km/h growing as 1/V), accel_y_noise (m/s2), roll_rate_noise (rad/s),
        wheel_noise, gps_speed_noise (m/s): standard deviations.
    hdop_table: pairs (HDOP, factor on the GPS's noise), linear in between; None for one noise at
        every HDOP (default: the factor is the HDOP for double-layer, None for the others).
    satellites: the least that a GPS fix needs (default 4).
    gate: a probability; a sample whose innovation is less likely than 1 - gate is skipped.
    adapt: share of a new innovation in an R that follows them (0: R as told).
    force_sd (N), moment_sd (N m), disturbance_time (s): of disturbances that are forces.
    prior: standard deviations of states at the start, by state.
    allow_unstable: build a filter whose error grows.

    Raises
    ------
    ValueError: unknown name, a sensor that is absent, a Q or noise that is no covariance, a
        schedule that does not repeat, a sensor that can be later than the filter's window, options
        that exclude each other, a filter that diverges.
    TypeError: unknown option.
    """
    there = dict(sensors or {})
    if not dt > 0.0:
        raise ValueError(f"{label_of(name)}: a tick of {dt!r} s")
    if not (isinstance(name, str) and name in FILTERS):
        factory = ESTIMATORS.load(name) if isinstance(name, str) else name
        built = factory(vehicle=vehicle_from(vehicle), sensors=there, dt=dt, speed=speed, **options)
        return (
            built
            if isinstance(built, Estimator)
            else ForeignEstimator(built, label_of(name), dt, there)
        )
    row = FILTERS[name]
    told = Options(name, options)
    used = slow_sensors(name, row, there, told)
    wish = wish_of(name, row, used, told)
    models = models_of(row, used, wish, told)
    states = [state for model in models for state in model.names]
    tuning = TUNINGS.get((name, ",".join(used)), {})
    Q = process_noise(name, states, tuning, told)
    noise = noise_levels(name, models[0].forces, told)
    prior = told.take("prior", {})
    check_prior(name, states, prior)
    leak = told.number("leak", 0.0)
    if not 0.0 <= leak < math.inf:
        raise ValueError(f"{name}: leak is in 1/s and not negative, got {leak!r}")
    common = Common(name, row, told)
    unstable = bool(told.take("allow_unstable", False))
    told.done()
    car = vehicle_from(vehicle)

    def memory(sensors_used: tuple[str, ...]) -> tuple[Any, tuple[Schedule, ...]]:
        """The filter's records with some of its slow sensors, and their schedules."""
        filters = np.zeros(len(models), FILTER).view(np.recarray)
        slow, first = {sensor: there[sensor] for sensor in sensors_used}, 0
        for f, model in zip(filters, models, strict=True):
            write_clocks(name, f, row, slow, dt, wish)
            n = len(model.names)
            write_model(
                f, model, car, f.stride * dt, noise, Q[first : first + n, first : first + n]
            )
            f.decay[f.dense : n] *= math.exp(-leak * f.stride * dt)
            f.prior[:n, :n] = np.diag(prior_variances(name, model, noise, prior))
            place_clones(f, slow, wish.late, name)
            write_speed(name, f, speed, dt)
            common.write(f, noise["gps_speed"])
            first += n
        planned = plans(filters[0], row, slow, dt, wish)
        for f in filters:
            write_rules(name, f, row, wish, len(used), planned)
            f.assumed = filters[0].assumed
            check_window(f, {sensor: there[sensor] for sensor in sensors_used}, name)
        filters[0].trailing = max(filters[0].trailing, int(len(models) > 1))
        return filters, planned

    filters, planned = memory(used)
    checked = filters if len(used) < 2 else memory(used[:1])[0]
    estimator = Estimator(
        name,
        tuple(states),
        dt,
        filters,
        {sensor: there[sensor] for sensor in used},
        planned,
        wish,
        unstable,
    )
    estimator.check(checked)
    return estimator


ESTIMATORS = Registry(
    "estimator", {name: functools.partial(make_estimator, name) for name in FILTERS}
)
"""Every estimator that has a name: the package's own and those that were registered."""


def register_estimator(name: str, factory: EstimatorFactory | str) -> None:
    """Give an estimator of your own a name that works wherever an estimator's name does.

    factory: as `EstimatorFactory`, or "package.module:Name", which is imported when first asked
    for. A name is known in this process alone; worker processes and `sideslip`'s command line take
    the entry point itself for a name. Raises as `Registry.register`.
    """
    ESTIMATORS.register(name, factory)
