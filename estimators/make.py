"""`make_estimator`: from a row of the table and options to a filter."""

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.record import SLOW_NAMES, TICK, SlowSensor
from ..envs.vehicle import COMS, Vehicle, vehicle_from
from . import intersample
from .delay import RULES, place_clones
from .estimator import Estimator
from .memory import FILTER
from .models import SLOWEST, SMOOTHING_TIME, Model, states_for, write_model
from .papers import FILTERS, Filter
from .schedule import NO_SENSOR, Schedule, schedules, whole_ticks
from .tunings import TUNINGS

Array = npt.NDArray[np.float64]

FASTEST = 80.0  # m/s, of the tables of gains
SPACING = 0.5  # m/s between them

NOISE = {
    "gyro_noise": 0.005,  # rad/s
    "psi_noise": 3.5e-3,  # rad
    "y_l_noise": 0.02,  # m
    "course_noise": math.radians(0.14),  # rad at 60 km/h, growing as 1/V
}
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s
PRIOR = {"beta": 0.02, "gamma": 0.05, "psi": 0.05, "y_l": 0.3, "d1": 0.1, "d2": 1.0}


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
    told = _Options(name, options)
    used = _slow_sensors(name, row, there, told.take("slow", None))
    model = Model(states_for(used), row.disturbances)
    rule = told.one_of("delay", row.delay, RULES)
    kind = told.one_of("inverse", intersample.INVERSES[0], intersample.INVERSES)
    wish = told.one_of("gains", "", ("", "periodic", "covariance"))
    tuning = TUNINGS.get((name, ",".join(used)), {})
    Q = _process_noise(name, model, tuning, told)
    noise = _noise(name, row, told)
    prior = _prior(name, model, noise, told.take("prior", {}))
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


class _Options:
    """Options that must all be asked for."""

    def __init__(self, name: str, options: Mapping[str, Any]) -> None:
        self.name, self._left, self._known = name, dict(options), list[str]()

    def has(self, key: str) -> bool:
        return key in self._left

    def take(self, key: str, default: Any) -> Any:
        self._known.append(key)
        return self._left.pop(key, default)

    def one_of(self, key: str, default: str, known: Sequence[str]) -> str:
        value = self.take(key, default)
        if value not in known:
            raise ValueError(
                f"{self.name}: {key} is one of {', '.join(filter(None, known))}, got {value!r}"
            )
        return str(value)

    def positive(self, key: str, default: float) -> float:
        value = self.take(key, default)
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} is a number, got {value!r}") from None
        if not (number > 0.0 and math.isfinite(number)):
            raise ValueError(f"{self.name}: {key} must be positive and finite, got {value!r}")
        return number

    def done(self) -> None:
        if self._left:
            raise TypeError(
                f"{self.name} has no option {', '.join(map(repr, sorted(self._left)))}; "
                f"it has: {', '.join(sorted(self._known))}"
            )


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


def _process_noise(
    name: str, model: Model, tuning: Mapping[str, float], told: _Options
) -> Array:
    """Q (n, n) per second."""
    n = len(model.names)
    Q = np.diag([float(tuning.get(state, 0.0)) for state in model.names])
    whole = told.take("Q", None)
    if whole is not None:
        Q = np.array(whole, np.float64)
        Q = np.diag(Q) if Q.ndim == 1 else Q
        if Q.shape != (n, n):
            raise ValueError(f"{name}: Q has shape ({n}, {n}) or ({n},), got {np.shape(whole)}")
    for i, state in enumerate(model.names):
        value = told.take(f"q_{state}", None)
        if value is not None:
            Q[i, i] = float(value)
    _covariance(f"{name}: Q", Q)
    return Q


def _covariance(what: str, M: Array) -> None:
    """ValueError unless M is finite, symmetric and positive semidefinite."""
    if not np.isfinite(M).all():
        raise ValueError(f"{what} is not finite")
    if not np.allclose(M, M.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{what} is not symmetric")
    least = np.linalg.eigvalsh(M).min()
    if least < -1e-12 * max(np.abs(M).max(), 1e-300):
        raise ValueError(f"{what} is indefinite: its least eigenvalue is {least:.3g}")


def _noise(name: str, row: Filter, told: _Options) -> dict[str, float]:
    """Standard deviations as `write_model` takes them."""
    noise = {}
    for key, default in NOISE.items():
        if key == "course_noise" and told.has(key):
            noise["course_fixed"] = told.positive(key, default)
        noise[key.removesuffix("_noise")] = told.positive(key, default)
    if row.disturbances == "forces":
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: told.positive(key, default) for short, (key, default) in keys}
    return noise


def _prior(
    name: str, model: Model, noise: Mapping[str, float], prior: Mapping[str, float]
) -> list[float]:
    """The states' variances at the start."""
    sd = PRIOR | {"F_d": noise.get("force", 0.0), "N_d": noise.get("moment", 0.0)}
    for state, value in prior.items():
        if state not in model.names:
            raise ValueError(f"{name} has no state {state!r}; it has: {', '.join(model.names)}")
        if not (float(value) >= 0.0 and math.isfinite(value)):
            raise ValueError(f"{name}: the prior of {state} is a standard deviation, got {value!r}")
        sd[state] = float(value)
    return [sd[state] ** 2 for state in model.names]


def _clocks(
    name: str, f: Any, row: Filter, slow: Mapping[str, SlowSensor], dt: float
) -> None:
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
