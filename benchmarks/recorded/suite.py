"""The suite `replay`: estimators over one recorded drive, and how far they are from the truth."""

import dataclasses
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ... import __version__
from ...envs.record import Array, Log
from ...envs.sensors.link import SlowSensor
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.models import MEASUREMENTS
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import Estimate
from ..harness.verdict import describe_leader, format_verdict
from .emulate import Emulation, LoggedMotion
from .honesty import HONESTY, compute_honesty, describe_innovations

GYRO_ONLY = "bicycle-kf"
_BOTH, _GPS = ("gps", "camera"), ("gps",)
ESTIMATORS: dict[str, tuple[str, ...]] = {
    GYRO_ONLY: (), "single-rate-kf": _BOTH, "multirate-kf": _BOTH, "multirate-residual-kf": _BOTH,
    "course-kf": _GPS, "dakf": _GPS, "exact-kf": _BOTH, "joint": _BOTH,
}  # fmt: skip
"""The estimators of a replay and the slow sensors that serve them, the better one first."""

_WIDTHS = np.array([0.126, 0.253, 0.385, 0.524, 0.674, 0.842, 1.036, 1.282, 1.645, 1.96])
"""Half-widths of intervals in deviations, which should hold `SHARES` of the errors."""
SHARES = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95])
_OWN_NOISE = "joint"  # brings its levels along and finds the accelerometer's as it drives
_MIN_COURSE_NOISE = 0.01  # deg, of the course, the least that estimators assume
_MIN_GYRO_NOISE = 0.002  # rad/s; below, what the model lacks weighs more than the sensor's noise
_MOTION = ("beta", "gamma", "psi", "y_l", "course", "phi", "phi_rate", "F_d", "N_d")


@dataclass(frozen=True, kw_only=True)
class Settings(Emulation):
    """How a drive is replayed; estimators assume the course noise of its `Emulation`.

    Raises:
        ValueError: A value out of range, or an unknown estimator.
    """

    estimators: Sequence[str] | None = None  # in `ESTIMATORS`, None: all; gyro-only always runs
    q_beta: float = 1e-3  # process noise of sideslip (rad2/s)
    q_gamma: float = 0.1  # process noise of the yaw rate ((rad/s)2/s)
    q_psi: float = 0.0  # process noise of the heading (rad2/s)
    seeds: int = 5  # number of noises of the emulated course
    seed: int = 0  # the first of their seeds
    stiffness_factor: float = 1.0  # of both tyre stiffnesses of the estimators
    figures: bool = True
    emulated: bool = True  # whether a log with truth and no slow sensor gets a course
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by estimator
    noise: Mapping[str, float] = field(default_factory=dict)  # deviations assumed, by option

    def __post_init__(self) -> None:
        super().__post_init__()
        requested = (*(self.estimators or ()), *self.options)
        unknown = [name for name in requested if name not in ESTIMATORS]
        if unknown:
            names = ", ".join(unknown)
            raise ValueError(f"unknown estimator {names}; known here: {', '.join(ESTIMATORS)}")
        if self.seeds < 1 or self.seed < 0:
            raise ValueError(f"expected seeds >= 1 and seed >= 0, got {self.seeds}, {self.seed}")
        for name in ("q_beta", "q_gamma", "q_psi"):
            if not 0.0 <= (value := getattr(self, name)) < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {value}")


@dataclass
class ReplayResult:
    """Errors of one vehicle's estimators on one drive, by estimator."""

    squares: dict[str, Array] = field(default_factory=dict)  # by seed (rad2); empty without truth
    # by seed: NEES, fraction of errors in the 95 % interval, mean log score; empty without truth
    honesty: dict[str, Array] = field(default_factory=dict)
    held: dict[str, Array] = field(default_factory=dict)  # fraction in intervals, by `SHARES`
    nis: dict[str, float] = field(default_factory=dict)  # mean, a value of a packet; first seed
    cost: dict[str, float] = field(default_factory=dict)  # CPU time per row (us)
    traces: dict[str, Array] = field(default_factory=dict)  # sideslip of the first seed (rad)
    # states that are no motion at the end: name, value, standard deviation
    outcomes: dict[str, list[tuple[str, float, float]]] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)  # why it is left out, or what it misses

    @property
    def rmse(self) -> dict[str, Estimate]:
        """RMS errors over the seeds (rad), best first."""
        ranges = {name: _compute_range(np.sqrt(x)) for name, x in self.squares.items()}
        return dict(sorted(ranges.items(), key=lambda item: item[1].value))

    def rank_by_score(self) -> dict[str, float]:
        """Rank by the median log score, best first: medians of the share that intervals hold."""
        medians = {name: np.median(rows, axis=0) for name, rows in self.honesty.items()}
        ranked = sorted(medians, key=lambda name: -float(medians[name][2]))
        return {name: float(medians[name][1]) for name in ranked}


def _compute_range(values: Array) -> Estimate:
    return Estimate(*(float(function(values)) for function in (np.median, np.min, np.max)))


def _compute_ratio(result: ReplayResult, name: str, other: str = GYRO_ONLY) -> Estimate:
    """Compute the RMS error over another's, seed by seed."""
    return _compute_range(np.sqrt(result.squares[name] / result.squares[other]))


def _compute_held_shares(error: Array, deviation: Array) -> Array:
    """Compute the shares of errors that intervals hold which should hold `SHARES`."""
    ratios = np.sort(np.abs(error / deviation))
    return np.asarray(np.searchsorted(ratios, _WIDTHS) / len(ratios))


def _make_drives(log: Log, settings: Settings) -> list[Log]:
    """A drive for each noise of the course, or the logged one; ValueError if it is too short."""
    duration = log.time[-1] - log.time[0]
    if duration < SETTLED:
        text = f"the drive lasts {duration:.3g} s, errors count from {SETTLED:g} s on"
        raise ValueError(f"{log.name}: {text}")
    if log.slow or "beta" not in log.truth or not settings.emulated:
        return [settings.apply(log, None)]
    return [settings.apply(log, settings.seed + i) for i in range(settings.seeds)]


def _run_estimators(drives: Sequence[Log], vehicle: Vehicle, settings: Settings) -> ReplayResult:
    """Run every wanted estimator that the drives' slow sensors serve over every drive."""
    log, result = drives[0], ReplayResult()
    counts = (log.time >= log.time[0] + SETTLED - 1e-9) & ~LoggedMotion(log).is_backward
    truth = log.truth.get("beta")
    if truth is not None and not (counts := counts & np.isfinite(truth)).any():
        text = f"the sideslip truth is unknown from {SETTLED:g} s on, driven forward"
        raise ValueError(f"{log.name}: {text}")
    for name, serves in ESTIMATORS.items():
        if settings.estimators is not None and name not in (GYRO_ONLY, *settings.estimators):
            continue
        slow = next((sensor for sensor in serves if sensor in log.slow), None)
        inertial = name == _OWN_NOISE and "accel_y" in log.record.present
        if serves and slow is None and not inertial:
            result.remarks[name] = f"left out: needs {' or '.join(serves)}"
            continue
        try:
            estimator = _make_estimator(name, slow, log, vehicle, settings)
        except ValueError as error:
            if name == GYRO_ONLY:
                raise
            result.remarks[name] = f"left out: {str(error).removeprefix(f'{name}: ')}"
            continue
        missing = [column for column in estimator.needs if column not in log.record.present]
        if missing and name != GYRO_ONLY:
            result.remarks[name] = f"left out: needs the column {', '.join(missing)}"
            continue
        if estimator.unobservable:
            result.remarks[name] = f"cannot see {'; '.join(estimator.unobservable)}"
        numbers = []
        for drive in (log, *drives):  # the first run designs the gains
            start = time.process_time()
            estimates = estimator.run(drive)
            spent = (time.process_time() - start) / len(counts) * 1e6
            result.cost[name] = min(spent, result.cost.get(name, math.inf))
            beta = estimates.x[:, estimates.names.index("beta")]
            result.traces.setdefault(name, beta)
            if slow is not None and np.isfinite(estimates.nis).any():
                values = len(MEASUREMENTS[slow].rows)  # of a packet, each of which adds 1
                result.nis.setdefault(name, float(np.nanmean(estimates.nis)) / values)
            ends = zip(estimates.names, estimates.x[-1], estimates.std[-1], strict=True)
            others = [(state, float(x), float(sd)) for state, x, sd in ends]
            result.outcomes[name] = [end for end in others if end[0] not in _MOTION]
            if truth is not None:
                wrong = (beta - truth)[counts]
                deviation = estimates.std[counts, estimates.names.index("beta")]
                numbers.append((np.mean(wrong**2), *compute_honesty(wrong, deviation)))
                result.held.setdefault(name, _compute_held_shares(wrong, deviation))
        if truth is not None:
            result.squares[name] = np.array(numbers[1:])[:, 0]
            result.honesty[name] = np.array(numbers[1:])[:, 1:]
    return result


def _make_estimator(
    name: str, slow: str | None, log: Log, vehicle: Vehicle, settings: Settings
) -> Any:
    sensors: dict[str, SlowSensor] = {} if slow is None else {slow: log.slow[slow]}
    options: dict[str, Any] = {} if slow is None else {"slow": slow}
    if name != _OWN_NOISE:
        options |= {"q_beta": settings.q_beta, "q_gamma": settings.q_gamma}
        options |= {} if slow is None else {"q_psi": settings.q_psi}
    if slow == "gps":
        emulated = math.radians(max(settings.course_noise_deg, _MIN_COURSE_NOISE))
        options["course_noise"] = settings.noise.get("course_noise", emulated)
    if "gyro_noise" in settings.noise and name != _OWN_NOISE:
        options["gyro_noise"] = max(settings.noise["gyro_noise"], _MIN_GYRO_NOISE)
    options |= settings.options.get(name, {})
    facts = {"sensors": sensors, "dt": log.record.dt, "present": log.record.present}
    # quietly: the result names what is unseen
    return call_quietly(make_estimator, name, vehicle=vehicle, **facts, **options)


_CORNERS = ((0.7, 0.7), (0.7, 1.3), (1.3, 0.7), (1.3, 1.3))
DEGREES = 180.0 / math.pi
_WINDOW = 10.0  # s to either side of the largest sideslip
_HIDDEN = "Names that are pale in the legend are hidden; a click shows them."


def replay(log: Log, vehicle: Vehicle, **settings: Any) -> Suite:
    """Run the estimators over a recorded drive, designed from this vehicle, and score them.

    A log with slow sensors is replayed with those; else a GPS course is emulated where the log
    knows the true sideslip; else estimators that need one are left out. Without truth nothing is
    scored, but drawn. Of rmse (rad, from 2 s on), ratio (over gyro-only) and us_per_tick, value is
    the median, low and high are the smallest and largest over the noises.

    Args:
        log: Recorded drive.
        vehicle: Vehicle from which the estimators are designed.
        settings: Fields of `Settings`; TypeError for an unknown, ValueError for a bad one.

    Returns:
        Suite with verdict, tables and figures.
    """
    how = Settings(**settings)
    car = vehicle.scale_stiffness(how.stiffness_factor)
    drives = _make_drives(log, how)
    result = _run_estimators(drives, car, how)
    suite = Suite("replay", f"A recorded drive: {log.name}", _make_text(log, drives, car, how))
    records = _add_rows(suite, result, log.name, car, how)
    suite.tables = [_make_table(result, records, log.name, car, len(drives))]
    if cells := [(x, *state) for x, states in result.outcomes.items() for state in states]:
        note = "At the end of the drive, SI units; tyres are factors on the assumed stiffness."
        value, deviation = Column("value", form=".4g"), Column("deviation", form=".2g")
        columns, title = ("estimator", "state", value, deviation), "what the estimators found"
        suite.tables.append(ResultTable(f"{log.name}: {title}", columns, cells, note))
    suite.verdict = _compose_verdict(result, "gps" in drives[0].slow and "gps" not in log.slow)
    if how.figures:
        suite.figures = _draw_figures(result, log)
        if result.squares and suite.figures:
            (_, bars, text), *suite.figures = suite.figures
            title = f"Which estimator is closest on a recorded drive? ({log.name})"
            suite.answers = [(title, bars, f"{suite.verdict.splitlines()[1]} {text}")]
    return suite


def _compose_verdict(result: ReplayResult, emulated: bool) -> str:
    """Compose the verdict; emulated: whether the GPS course is made from the truth."""
    if not result.squares:
        return format_verdict(
            f"Nobody wins: without the true sideslip angle {len(result.traces)} estimators are "
            "drawn, not scored.",
            describe_innovations(result.nis),
            "Not covered: how far off they are. A log with a true sideslip angle would show it.",
        )
    best, share = next(iter(result.rank_by_score().items()))
    rmse = {name: DEGREES * errors.value for name, errors in result.rmse.items()}
    first, *rest = rmse
    over = {name: _compute_ratio(result, first, name) for name in rest}
    slow = [name for name in result.squares if name != GYRO_ONLY]
    gain = f"{GYRO_ONLY}, with the gyro alone, errs {rmse[GYRO_ONLY]:.2f} deg"
    return format_verdict(
        "An estimator infers the sideslip angle: between where the car points and where it goes.",
        f"From the recorded angle {describe_leader(first, over, 'stray')}.",
        f"Its error: {rmse[first]:.2f} deg. By the log score {best} is best; its 95 % interval "
        f"holds {100.0 * share:.0f} %.",
        f"Why: {gain}; a slow sensor {'helps' if first in slow else 'does not help'} here.",
        "Not covered: other drives and cars"
        + ("; the GPS course is made from the truth, with drawn noise." if emulated else "."),
    )


def corners(log: Log, vehicle: Vehicle, **settings: Any) -> Suite:
    """Replay with the four corners of a vehicle: front and rear stiffness x 0.7 and x 1.3.

    Args:
        log: Recorded drive.
        vehicle: Vehicle in the middle of the corners.
        settings: Fields of `Settings`.

    Returns:
        Suite of one table and the rows of every corner, without figures.

    Raises:
        ValueError: The log has no truth, or `replay` refuses it.
    """
    how = Settings(**settings)
    if "beta" not in log.truth:
        raise ValueError(f"{log.name}: corners are scored against sideslip truth; there is none")
    drives = _make_drives(log, how)
    suite = Suite("replay", f"A recorded drive: {log.name}", "")
    results = {}
    for front, rear in _CORNERS:
        car = vehicle.scale_stiffness(how.stiffness_factor).scale_stiffness(front, rear)
        result = results[f"{front} / {rear}"] = _run_estimators(drives, car, how)
        scenario = f"{log.name}: {vehicle.name}, front x {front}, rear x {rear}"
        _add_rows(suite, result, scenario, car, how)
    names = [name for name in ESTIMATORS if any(name in x.squares for x in results.values())]
    cells = [[name, *(x.rmse.get(name) for x in results.values())] for name in names]
    title = f"{log.name}, {vehicle.name} with front / rear stiffness x ...: RMSE / deg"
    note = "The same process noise in all corners; medians over the noises."
    columns = "estimator", *(Column(name, "", DEGREES, ".2f", interval=False) for name in results)
    suite.tables = [ResultTable(title, columns, cells, note)]
    return suite


def _make_text(log: Log, drives: Sequence[Log], car: Vehicle, settings: Settings) -> str:
    duration, rate = log.time[-1] - log.time[0], 1.0 / log.record.dt
    text = [f"{duration:.0f} s at {rate:.4g} Hz. The estimators are designed from {car.name!r}"]
    if settings.stiffness_factor != 1.0:
        text.append(f"with both tyre stiffnesses x {settings.stiffness_factor:g}")
    text.append(
        f"and one process noise: {settings.q_beta:g} rad2/s on sideslip, {settings.q_gamma:g} "
        f"(rad/s)2/s on yaw rate, {settings.q_psi:g} rad2/s on heading."
    )
    if log.slow:
        text.append(f"Slow sensors are the log's own: {', '.join(log.slow)}.")
    elif "gps" in drives[0].slow:
        gps = drives[0].slow["gps"]
        text.append(
            f"A GPS course is emulated every {gps.period:.4g} s from the sideslip truth and the "
            f"integral of the logged yaw rate: noise {settings.course_noise_deg:g} deg, "
            f"{gps.longest_delay:.4g} s late, bias {settings.bias_deg:g} deg."
        )
    elif settings.emulated:
        text.append("The log has no slow sensor and no truth to emulate one from.")
    if settings.gyro_bias_degps:
        text.append(f"{settings.gyro_bias_degps:g} deg/s are added to the gyro.")
    if "beta" in log.truth:
        text.append(f"Errors count from {SETTLED:g} s on.")
        if count := int(LoggedMotion(log).is_backward.sum()):
            text.append(f"{count} rows are driven backward, and not scored.")
    else:
        text.append("The log has no sideslip truth, so nothing is scored.")
    return " ".join(text)


def _add_rows(
    suite: Suite, result: ReplayResult, scenario: str, car: Vehicle, how: Settings
) -> Any:
    """Add rows of every number of a result, and return the records, best first."""
    plain = dataclasses.asdict(how) | {"estimators": list(how.estimators or ESTIMATORS)}
    del plain["figures"], plain["emulated"]  # these move no number
    spec = json.dumps({"vehicle": car.to_dict(), "settings": plain})
    records = {}
    for name, cost in result.cost.items():
        record: dict[str, Any] = {"estimator": name, "n": 1}
        if name in result.squares:
            errors = {"rmse": result.rmse[name], "ratio": _compute_ratio(result, name)}
            record |= errors | {"n": len(result.squares[name])}
            for column, values in zip(HONESTY, result.honesty[name].T, strict=True):
                record[column.key] = _compute_range(values)
        if name in result.nis:
            record["nis"] = result.nis[name]
        records[name] = record | {"us_per_tick": cost}
    where = {"scenario": scenario, "salt": f"seed {how.seed}", "spec": spec}
    suite.add_rows(records.values(), env_version=f"replay {__version__}", **where)
    return [records[name] for name in result.rank_by_score() or records]


def _make_table(
    result: ReplayResult, records: Sequence[Any], name: str, car: Vehicle, noises: int
) -> ResultTable:
    note = "; ".join(f"`{label}` {remark}" for label, remark in result.remarks.items())
    cost = Column("us_per_tick", "us per tick", form=".3f")
    surprise = Column("nis", "NIS of a value", form=".2f")
    if not result.squares:
        title = f"{name}, designed from {car.name}: no truth, no score"
        return ResultTable(title, ("estimator", surprise, cost), records, note)
    rmse = Column("rmse", "RMSE / deg [least, most]", DEGREES, ".3f")
    ratio = Column("ratio", "of gyro only", form=".2f", interval=False)
    columns = "estimator", rmse, ratio, *HONESTY, cost
    title = f"{name}, {car.name}: error of the sideslip angle (median of {noises} noises)"
    return ResultTable(title, columns, records, note)


def _draw_figures(result: ReplayResult, log: Log) -> list[tuple[str, Any, str]]:
    """Bars, sideslip, errors and tracks of the first noise; nothing without plotly."""
    try:
        from ..report.figures import draw_curves, draw_groups, draw_time_series, draw_track
    except ModuleNotFoundError:
        return []
    truth = log.truth.get("beta")
    traces = result.traces if truth is None else {"truth": truth} | result.traces
    slips = {name: DEGREES * beta for name, beta in traces.items()}
    label = "sideslip angle / deg"
    peak_time = log.time[np.nanargmax(np.abs(next(iter(slips.values()))))]
    near = np.abs(log.time - peak_time) <= _WINDOW
    close = {name: beta[near] for name, beta in slips.items()}
    overview = _select_traces(draw_time_series(log.time, slips, label), result)
    paths = {name: _compute_path(log, beta) for name, beta in traces.items()}
    shown = [
        ("the sideslip angle and its estimates", overview, _HIDDEN),
        ("where the car slips most", draw_time_series(log.time[near], close, label),
            f"The {2 * _WINDOW:g} s around the largest sideslip angle, all estimators."),
        ("the track", _select_traces(draw_track(paths), result),
            "Dead reckoning from wheel speed, the integral of the logged yaw rate and each "
            f"sideslip angle: what a degree of sideslip is worth on the road. {_HIDDEN}"),
    ]  # fmt: skip
    if truth is not None:
        errors = {name: DEGREES * (beta - truth) for name, beta in result.traces.items()}
        over_time = draw_time_series(log.time, errors, f"error of the {label}", zero_line=True)
        figure = _select_traces(over_time, result)
        shown.insert(2, ("errors", figure, f"Estimate minus truth. {_HIDDEN}"))
        held = {"truth": SHARES} | result.held
        labels = "fraction that intervals should hold", "fraction they hold"
        curves = draw_curves(SHARES, held, *labels)
        text = f"Below the line of truth an estimator is surer than it may be. {_HIDDEN}"
        shown.insert(3, ("whether intervals hold", _select_traces(curves, result), text))
        groups = {log.name: {name: x.rescale(DEGREES) for name, x in result.rmse.items()}}
        bars = draw_groups(groups, f"RMSE of the {label}", {})
        text = f"Median over the noises; whiskers: least and most. {GYRO_ONLY} has no slow sensor."
        shown.insert(0, ("error of each estimator", bars, text))
    return [(f"{log.name}: {title}", *more) for title, *more in shown]


def _compute_path(log: Log, beta: Array) -> tuple[Array, Array]:
    """Compute a drive's path, x and y (m), by dead reckoning from a sideslip angle (rad)."""
    psi, v_x = LoggedMotion(log).heading, LoggedMotion(log).speed
    v_y = v_x * np.tan(np.nan_to_num(beta))
    x_rate = v_x * np.cos(psi) - v_y * np.sin(psi)
    y_rate = v_x * np.sin(psi) + v_y * np.cos(psi)
    return np.cumsum(x_rate) * log.record.dt, np.cumsum(y_rate) * log.record.dt


def _select_traces(figure: Any, result: ReplayResult) -> Any:
    """The figure with only truth, gyro-only and the best estimator in sight."""
    best = next(iter(result.rmse), "exact-kf")
    for trace in figure.data:
        if trace.name in result.traces and trace.name not in (GYRO_ONLY, best):
            trace.visible = "legendonly"
    return figure
