"""`make_estimator`: from a row of the table and options to a filter."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..envs.record import SLOW_NAMES, TICK, SlowSensor
from ..envs.vehicle import COMS, Vehicle, vehicle_from
from . import intersample, spread
from .delay import CONSTANT, RULES, STORED, place_clones
from .estimator import Estimator
from .intersample import NONE, PSEUDO, SPREAD
from .kalman import gain
from .memory import FILTER
from .models import MODELS, SMOOTHING_TIME, Model, bicycle_model, write_model
from .options import (
    Options,
    check_prior,
    gates,
    hdop_table,
    noise_levels,
    poles_of,
    prior_variances,
    process_noise,
)
from .papers import FILTERS, Filter
from .periodic import measured_rows, slow_index
from .schedule import NO_SENSOR, Schedule, schedules, whole_ticks
from .transition import KINEMATIC, SLOWEST, VELOCITY_ROLL
from .tunings import TUNINGS

FASTEST = 80.0  # m/s, of the tables of gains
SPACING = 0.5  # m/s between them
SATELLITES = 4.0  # with fewer, a GPS fix is refused (double-layer-gps 4.3)


@dataclass(frozen=True)
class Wish:
    """What a filter's gains shall be: `design` reads it.

    gains: "periodic", "covariance", "placed"; of the rule "spread" one of `spread.GAINS`.
    inverse: of `intersample.INVERSES`. rule: of `spread.RULES`. poles: rad/s. late: of
    `delay.RULES`. assumed: s, of the rule "constant". between: "hold" or "predict".
    """

    gains: str
    inverse: str
    rule: str
    poles: tuple[float, ...]
    late: str
    assumed: float
    between: str


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
    gains: "periodic" (precomputed for a schedule that repeats) or "covariance"; of dual-rate
        "constant", "from-29" or "placed".
    delay: "clone" or "buffer" (late samples used exactly), "larsen", "stored", "constant" (with
        assumed_delay in s), "literal", "lag" or "ignore": `sideslip.estimators.delay` says what
        they are.
    between: of single-rate-kf, "hold" (default) or "predict" between its steps.
    intersample: of double-layer "pseudo-residual" (default) or "predict"; of dual-rate "pseudo"
        (default), "predict", "hold" or "oh".
    inverse: the generalised inverse of the pseudo-residual rule, "moore-penrose", "p-weighted",
        "tikhonov" or "bayes".
    poles: rad/s, where gains are placed. disturbances: "none", "walk" (d1, d2), "walk-all" or
        "forces". leak: 1/s, by which walking disturbances decay.
    q_beta, q_gamma, ...: process noise of a state per second, (unit)^2/s; or Q, (n, n) or (n,).
    gyro_noise (rad/s), psi_noise (rad), y_l_noise (m), course_noise (rad at every speed; default
        0.14 deg at 60 km/h growing as 1/V), accel_y_noise (m/s2), roll_rate_noise (rad/s),
        wheel_noise, gps_speed_noise (m/s): standard deviations.
    hdop_table: pairs (HDOP, factor on the GPS's noise). satellites: the least (default 4).
    gate: a probability; a sample whose innovation is less likely than 1 - gate is skipped.
    adapt: share of a new innovation in an R that follows them (0: R as told).
    force_sd (N), moment_sd (N m), disturbance_time (s): of disturbances that are forces.
    prior: standard deviations of states at the start, by state.
    allow_unstable: build a filter whose error grows.

    Raises
    ------
    ValueError: unknown name, a sensor that is absent, a Q or noise that is no covariance, a
        schedule that does not repeat, options that exclude each other, a filter that diverges.
    TypeError: unknown option.
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
    wish = _wish(name, row, used, told)
    models = _models(row, used, wish, told)
    states = [state for model in models for state in model.names]
    tuning = TUNINGS.get((name, ",".join(used)), {})
    Q = process_noise(name, states, tuning, told)
    noise = noise_levels(name, models[0].forces, told)
    prior = told.take("prior", {})
    check_prior(name, states, prior)
    leak = told.number("leak", 0.0)
    common = _Common(told, name)
    unstable = bool(told.take("allow_unstable", False))
    told.done()
    car = vehicle_from(vehicle)

    def memory(sensors_used: tuple[str, ...]) -> tuple[Any, tuple[Schedule, ...]]:
        """The filter's records with some of its slow sensors, and their schedules."""
        filters = np.zeros(len(models), FILTER).view(np.recarray)
        slow, first = {sensor: there[sensor] for sensor in sensors_used}, 0
        for f, model in zip(filters, models, strict=True):
            _clocks(name, f, row, slow, dt, wish)
            n = len(model.names)
            write_model(
                f, model, car, f.stride * dt, noise, Q[first : first + n, first : first + n]
            )
            f.decay[f.dense : n] *= math.exp(-leak * f.stride * dt)
            f.prior[:n, :n] = np.diag(prior_variances(name, model, noise, prior))
            f.relax = _relax(wish.late, slow, dt)
            place_clones(f, slow, wish.late, name)
            _speed(name, f, speed, dt)
            common.write(f, noise["gps_speed"])
            first += n
        plans = _plans(filters[0], slow, dt, wish)
        for f in filters:
            _rules(name, f, row, wish, len(used), plans)
        filters[0].trailing = max(filters[0].trailing, int(len(models) > 1))
        return filters, plans

    filters, plans = memory(used)
    checked, _ = (filters, plans) if len(used) < 2 else memory(used[:1])
    estimator = Estimator(
        name,
        tuple(states),
        dt,
        filters,
        {sensor: there[sensor] for sensor in used},
        plans,
        wish,
        unstable,
    )
    estimator.check(checked)
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


def _wish(name: str, row: Filter, used: tuple[str, ...], told: Options) -> Wish:
    """How the gains shall be found, from the row and the options."""
    spreads, placed = row.intersample == "spread", row.gains == "placed"
    rule = told.one_of("intersample", "pseudo", spread.RULES) if spreads else ""
    if row.second:
        rule = told.one_of("intersample", "pseudo-residual", ("pseudo-residual", "predict"))
    known = spread.GAINS if spreads else ("", "periodic", "covariance")
    gains = row.gains if placed else told.one_of("gains", known[0], known)
    if gains == "from-29" and rule != "pseudo":
        raise ValueError(f"{name}: gains 'from-29' are those of intersample='pseudo'")
    between = told.one_of("between", "hold", ("hold", "predict")) if _single(row) else "hold"
    inverse = told.one_of("inverse", intersample.INVERSES[0], intersample.INVERSES)
    late = told.one_of("delay", row.delay, RULES)
    assumed = told.positive("assumed_delay", 0.033) if late == "constant" else 0.0
    poles = poles_of(name, row.poles, told) if placed or gains == "placed" else ()
    if gains == "placed" and not poles:
        raise ValueError(f"{name}: gains='placed' needs poles")
    if late in ("literal", "lag") and "camera" not in used:
        raise ValueError(f"{name}: delay={late!r} is tie-vision's, for the camera")
    return Wish(gains, inverse, rule, poles, late, assumed, between)


def _single(row: Filter) -> bool:
    return row.intersample == "single-rate"


def _models(row: Filter, used: tuple[str, ...], wish: Wish, told: Options) -> list[Model]:
    """The model of each layer."""
    if row.model != "bicycle":
        return [MODELS[row.model]]
    kinds = ("none", "walk", "walk-all", "forces")
    disturbances = told.one_of("disturbances", row.disturbances, kinds)
    first = bicycle_model(used, row.fast, disturbances, wish.late in ("literal", "lag"))
    return [first, MODELS[row.second]] if row.second else [first]


def _clocks(
    name: str, f: Any, row: Filter, slow: Mapping[str, SlowSensor], dt: float, wish: Wish
) -> None:
    for sensor, link in slow.items():
        what = f"{name}: the {sensor}'s period"
        f.period[SLOW_NAMES.index(sensor)] = whole_ticks(link.period, dt, what)
    f.pace = int(f.period.max()) if _single(row) else 1
    f.stride = f.pace if wish.between == "hold" else 1


def _relax(late: str, slow: Mapping[str, SlowSensor], dt: float) -> float:
    """By how much late states follow in a step: at once, or as a first-order lag of the delay."""
    if late != "lag":
        return 1.0
    delay = float(np.mean(slow["camera"].delays)) + 0.5 * slow["camera"].jitter
    return 1.0 - math.exp(-dt / max(delay, dt))


class _Common:
    """Options that every record takes alike."""

    def __init__(self, told: Options, name: str) -> None:
        self.knots = hdop_table(name, told)
        self.gate = gates(name, told)
        self.satellites = told.number("satellites", SATELLITES)
        self.adapt = told.number("adapt", 0.0)
        if not 0.0 <= self.adapt < 1.0:
            raise ValueError(f"{name}: adapt is a share from 0 to 1, got {self.adapt!r}")

    def write(self, f: Any, gps_speed: float) -> None:
        """Into a filter's record."""
        f.knots, f.satellites, f.adapt = len(self.knots), self.satellites, self.adapt
        f.r_speed = gps_speed**2
        f.gate[:] = self.gate
        for i, (hdop, factor) in enumerate(self.knots):
            f.hdop[i], f.hdop_factor[i] = hdop, factor


def _speed(name: str, f: Any, speed: float | None, dt: float) -> None:
    if speed is not None and not (math.isfinite(speed) and speed >= 0.0):
        raise ValueError(f"{name}: speed is in m/s and not negative, got {speed!r}")
    f.measured = int(speed is None)
    f.speed = 0.0 if speed is None else speed
    f.smoothing = 1.0 - math.exp(-dt / SMOOTHING_TIME)


def _plans(f: Any, slow: Mapping[str, SlowSensor], dt: float, wish: Wish) -> tuple[Schedule, ...]:
    """The schedules of the first slow sensor: one, or two extremes where delays are random."""
    if not slow:
        return (NO_SENSOR,)
    name, sensor = next(iter(slow.items()))
    if wish.late == "constant":
        f.assumed = whole_ticks(wish.assumed, dt, "assumed_delay")
        sensor = SlowSensor(sensor.period, (wish.assumed,), sensor.phase)
    frames = int(f.frames[SLOW_NAMES.index(name)])
    return schedules(name, sensor, dt, int(f.stride), int(f.pace), frames)


def _rules(
    name: str, f: Any, row: Filter, wish: Wish, used: int, plans: tuple[Schedule, ...]
) -> None:
    """The codes that choose what compiled code does; ValueError for what does not go together."""
    f.cycle, f.pattern = plans[-1].cycle, max(1, len(plans[-1].lags))
    pseudo = row.intersample == "pseudo-residual" and wish.rule != "predict"
    f.between = PSEUDO if pseudo else SPREAD if row.intersample == "spread" else NONE
    f.periodic = int(_periodic(name, f, row, wish, used, len(plans)))
    f.joint = int(row.gains == "placed" or (pseudo and f.periodic == 1))
    f.trailing = int(f.late in (STORED, CONSTANT))
    if f.measured and f.periodic:
        f.low, f.high, f.spacing = SLOWEST, FASTEST, SPACING
    if f.between == PSEUDO:
        C = measured_rows(f, slow_index(f), 0)
        f.inverse[: len(C), : f.total] = gain(np.eye(f.total), C, np.zeros((len(C), len(C)))).T
    exact = f.periodic == 0 and f.between == NONE
    if not exact and (f.gate.any() or f.adapt > 0.0 or wish.late in ("larsen", "buffer")):
        raise ValueError(
            f"{name}: gate, adapt, delay='larsen' and delay='buffer' need gains='covariance' and "
            "no correction between samples"
        )
    if f.adapt > 0.0 and wish.late in ("larsen", "buffer"):
        raise ValueError(f"{name}: adapt needs delay='clone', got delay={wish.late!r}")


def _periodic(name: str, f: Any, row: Filter, wish: Wish, used: int, plans: int) -> bool:
    """Whether the gains are precomputed; ValueError where that was asked for and cannot be."""
    if f.between == SPREAD or row.gains == "placed":
        return True
    if f.kind in (KINEMATIC, VELOCITY_ROLL) or row.second:
        if wish.gains == "periodic":
            raise ValueError(f"{name}: no periodic gains, its model changes with the yaw rate")
        return False
    if f.between == PSEUDO:
        if wish.gains == "covariance":
            raise ValueError(f"{name} has one constant gain; gains='covariance' is not for it")
        if f.frames.max() > 1:
            raise ValueError(f"{name}: a sample must arrive before the next one is captured")
        return True
    blind = f.frames.max() == 0  # a filter that does not look at the lag
    if used > 1 or (plans > 1 and not blind):
        if wish.gains == "periodic":
            why = "two slow sensors" if used > 1 else "random delay"
            raise ValueError(f"{name}: no periodic gains with {why}; use gains='covariance'")
        return False
    wanted = wish.gains or row.gains
    if not wish.gains and (f.gate.any() or f.adapt > 0.0 or wish.late in ("larsen", "buffer")):
        wanted = "covariance"
    return wanted == "periodic"
