"""`make_estimator`: from a row of the table and options to a filter."""

import difflib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..envs.record import SLOW_NAMES, TICK, SlowSensor
from ..envs.vehicle import COMS, Vehicle, vehicle_from
from . import intersample
from .delay import RULES, place_clones
from .estimator import Estimator
from .memory import FILTER
from .models import SLOWEST, SMOOTHING_TIME, Model, states_for, write_model
from .options import Options, noise_levels, prior_variances, process_noise
from .papers import FILTERS, Filter
from .schedule import NO_SENSOR, Schedule, schedules, whole_ticks
from .tunings import TUNINGS

FASTEST = 80.0  # m/s, of the tables of gains
SPACING = 0.5  # m/s between them


def make_estimator(
    name: str,
    *,
    vehicle: Vehicle | str | Mapping[str, Any] = COMS,
    sensors: Mapping[str, SlowSensor] | None = None,
    dt: float = TICK,
    speed: float | None = None,
    **options: Any,
) -> Estimator:
    """Build an estimator by name (`sideslip.estimators.FILTERS` lists them).

    vehicle: what the filter is told. sensors: the slow sensors that are there, "camera" and "gps".
    dt: seconds of a tick. speed: m/s if it is held; None measures it with the front wheels.

    Options
    -------
    slow: the slow sensor to use (default: the first of camera, gps that it can use and that is
        there). A filter with gains "covariance" also takes several.
    gains: "periodic" (precomputed for a schedule that repeats) or "covariance".
    delay: "clone" (late samples measure what was captured) or "ignore".
    inverse: the generalised inverse of the pseudo-residual rule, "moore-penrose", "p-weighted" or
        "tikhonov".
    q_beta, q_gamma, ...: process noise of a state per second, (unit)^2/s; or Q, (n, n) or (n,).
    gyro_noise (rad/s), psi_noise (rad), y_l_noise (m), course_noise (rad at every speed; default
        0.14 deg at 60 km/h growing as 1/V): standard deviations.
    force_sd (N), moment_sd (N m), disturbance_time (s): of exact-kf's disturbances.
    prior: standard deviations of states at the start, by state.
    allow_unstable: build a filter whose error grows.

    Raises
    ------
    ValueError: unknown name, a sensor that is absent, a Q or noise that is no covariance, a
        schedule that does not repeat, a filter that diverges. TypeError: unknown option.
    """
    if name not in FILTERS:
        close = difflib.get_close_matches(name, FILTERS, 1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(FILTERS)}"
        raise ValueError(f"unknown estimator {name!r}; {hint}")
    row, there = FILTERS[name], dict(sensors or {})
    if not dt > 0.0:
        raise ValueError(f"{name}: a tick of {dt!r} s")
    told = Options(name, options)
    used = _slow_sensors(name, row, there, told.take("slow", None))
    model = Model(states_for(used), row.disturbances)
    rule = told.one_of("delay", row.delay, RULES)
    kind = told.one_of("inverse", intersample.INVERSES[0], intersample.INVERSES)
    wish = told.one_of("gains", "", ("", "periodic", "covariance"))
    tuning = TUNINGS.get((name, ",".join(used)), {})
    Q = process_noise(name, model, tuning, told)
    noise = noise_levels(name, row, told)
    prior = prior_variances(name, model, noise, told.take("prior", {}))
    unstable = bool(told.take("allow_unstable", False))
    told.done()
    car = vehicle_from(vehicle)

    def memory(sensors_used: tuple[str, ...]) -> tuple[Any, tuple[Schedule, ...]]:
        """The filter's record with some of its slow sensors, and their schedules."""
        filters = np.zeros(1, FILTER).view(np.recarray)
        f = filters[0]
        slow = {sensor: there[sensor] for sensor in sensors_used}
        _clocks(name, f, row, slow, dt)
        write_model(f, model, car, f.stride * dt, noise, Q)
        f.prior[: len(prior), : len(prior)] = np.diag(prior)
        place_clones(f, slow, rule, name)
        _speed(name, f, speed, dt)
        plans = _plans(f, slow, dt)
        f.cycle, f.pattern = plans[-1].cycle, max(1, len(plans[-1].lags))
        f.pseudo = int(row.intersample == "pseudo-residual")
        f.periodic = int(_periodic(name, f, row, wish, len(used), len(plans)))
        if f.measured and f.periodic:
            f.low, f.high, f.spacing = SLOWEST, FASTEST, SPACING
        return filters, plans

    filters, plans = memory(used)
    checked, _ = (filters, plans) if len(used) < 2 else memory(used[:1])
    estimator = Estimator(
        name,
        model.names,
        dt,
        filters,
        {sensor: there[sensor] for sensor in used},
        plans,
        kind,
        unstable,
    )
    estimator.check(checked[0])
    return estimator


def _slow_sensors(
    name: str, row: Filter, there: Mapping[str, SlowSensor], wish: Any
) -> tuple[str, ...]:
    """The slow sensors to use, in the order of `SLOW_NAMES`."""
    if not row.slow:
        if wish is not None:
            raise ValueError(f"{name} uses no slow sensor, got slow={wish!r}")
        return ()
    if wish is None:
        wished = [sensor for sensor in row.slow if sensor in there][:1] or [" or ".join(row.slow)]
    else:
        wished = [wish] if isinstance(wish, str) else list(wish)
    for sensor in wished:
        if wish is not None and sensor not in row.slow:
            raise ValueError(f"{name} can use {' or '.join(row.slow)}, got slow={wish!r}")
        if sensor not in there:
            present = ", ".join(there) or "none"
            raise ValueError(f"{name} needs the slow sensor {sensor}; there is: {present}")
    return tuple(sensor for sensor in SLOW_NAMES if sensor in wished)


def _clocks(name: str, f: Any, row: Filter, slow: Mapping[str, SlowSensor], dt: float) -> None:
    for sensor, link in slow.items():
        what = f"{name}: the {sensor}'s period"
        f.period[SLOW_NAMES.index(sensor)] = whole_ticks(link.period, dt, what)
    f.stride = int(f.period.max()) if row.intersample == "single-rate" else 1


def _speed(name: str, f: Any, speed: float | None, dt: float) -> None:
    if speed is not None and not (math.isfinite(speed) and speed >= 0.0):
        raise ValueError(f"{name}: speed is in m/s and not negative, got {speed!r}")
    f.measured = int(speed is None)
    f.speed = 0.0 if speed is None else speed
    f.smoothing = 1.0 - math.exp(-dt / SMOOTHING_TIME)


def _plans(f: Any, slow: Mapping[str, SlowSensor], dt: float) -> tuple[Schedule, ...]:
    """The schedules of the first slow sensor: one, or two extremes where delays are random."""
    if not slow:
        return (NO_SENSOR,)
    name, sensor = next(iter(slow.items()))
    frames = int(f.frames[SLOW_NAMES.index(name)])
    return schedules(name, sensor, dt, int(f.stride), frames)


def _periodic(name: str, f: Any, row: Filter, wish: str, used: int, plans: int) -> bool:
    """Whether the gains are precomputed; ValueError where that was asked for and cannot be."""
    if f.pseudo:
        if wish == "covariance":
            raise ValueError(f"{name} has one constant gain; gains='covariance' is not for it")
        if f.frames.max() > 1:
            raise ValueError(f"{name}: a sample must arrive before the next one is captured")
        return True
    if used > 1 or plans > 1:
        if wish == "periodic":
            why = "two slow sensors" if used > 1 else "random delay"
            raise ValueError(f"{name}: no periodic gains with {why}; use gains='covariance'")
        return False
    return (wish or row.gains) == "periodic"
