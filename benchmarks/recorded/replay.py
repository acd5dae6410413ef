"""`sideslip replay`: estimators over a recorded drive, and how far they are from its truth.

A drive with truth and without a slow sensor gets a GPS course made of the truth and the gyro.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...envs.record import FAST, Array, Log
from ...envs.recordings.log_file import make_packets, read_parts
from ...envs.recordings.sources import is_nmea
from ...envs.recordings.tables import parse_mapping
from ...envs.sensors.link import SlowSensor
from ...envs.validation import check_choice
from ...envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from ...estimators.design.options import MEASUREMENTS
from ...estimators.make import make_estimator
from ...estimators.wires import AS_LOGGED, SignalCalibration, apply_wires
from ..harness.drives import SETTLED, call_quietly
from ..harness.results import HONESTY, Column, ResultTable, Suite
from ..harness.stats import Estimate, compute_honesty, compute_range
from ..report.study import describe_innovations, describe_leader, format_verdict
from .identify import identify_file
from .quality import TRUTH, sort_remarks
from .sensor_noise import GYRO_ONLY

_BOTH, _GPS = ("gps", "camera"), ("gps",)
ESTIMATORS: dict[str, tuple[str, ...]] = {
    GYRO_ONLY: (), "single-rate-kf": _BOTH, "multirate-kf": _BOTH, "multirate-residual-kf": _BOTH,
    "course-kf": _GPS, "dakf": _GPS, "exact-kf": _BOTH, "joint": _BOTH,
}  # fmt: skip
"""The estimators of a replay and the slow sensors that serve them, the better one first."""
_OWN_NOISE = "joint"  # brings its levels along and finds the accelerometer's as it drives
_MIN_COURSE_NOISE = 0.01  # deg, of the course, the least that estimators assume
_MIN_GYRO_NOISE = 0.002  # rad/s; below, what the model lacks weighs more than the sensor's noise
_NOT_NEGATIVE = ("course_rate", "course_noise_deg", "delay", "q_beta", "q_gamma", "q_psi")
TRUTH_WARNING = "The truth of this log is in doubt, and with it all errors: see the warnings."
_HIDDEN = "Names that are pale in the legend are hidden; a click shows them."
DEGREES = 180.0 / math.pi


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a drive is replayed; ValueError for a value out of range or an unknown estimator.

    Estimators assume the noise of the emulated course.
    """

    course_rate: float = 10.0  # Hz; a sample every so many whole rows of the log
    course_noise_deg: float = 0.5  # standard deviation of the course (deg)
    delay: float = 0.0  # of the course (s)
    bias_deg: float = 0.0  # constant error of the course (deg)
    gyro_bias_degps: float = 0.0  # of the gyro that estimators see, not of the emulated heading
    estimators: Sequence[str] | None = None  # in `ESTIMATORS`, None: all; gyro-only always runs
    q_beta: float = 1e-3  # process noise of sideslip (rad2/s)
    q_gamma: float = 0.1  # process noise of the yaw rate ((rad/s)2/s)
    q_psi: float = 0.0  # process noise of the heading (rad2/s)
    seeds: int = 5  # number of noises of the emulated course
    seed: int = 0  # the first of their seeds
    figures: bool = True
    emulated: bool = True  # whether a log with truth and no slow sensor gets a course
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by estimator
    noise: Mapping[str, float] = field(default_factory=dict)  # deviations assumed, by option

    def __post_init__(self) -> None:
        for name in (*(self.estimators or ()), *self.options):
            check_choice("estimator", name, ESTIMATORS)
        if self.seeds < 1 or self.seed < 0:
            raise ValueError(f"expected seeds >= 1 and seed >= 0, got {self.seeds}, {self.seed}")
        for name in (*_NOT_NEGATIVE, "bias_deg", "gyro_bias_degps"):
            value, rule = getattr(self, name), " and not negative" * (name in _NOT_NEGATIVE)
            if not math.isfinite(value) or (rule and value < 0.0):
                raise ValueError(f"{name} must be finite{rule}, got {value}")
        if self.course_rate == 0.0:
            raise ValueError(f"course_rate must be positive, got {self.course_rate} Hz")


def _emulate_course(log: Log, settings: Settings, seed: int) -> Log:
    """Add a GPS that measures the course alone to a log with truth.

    course = sideslip truth + integral of the logged yaw rate + bias + noise. Samples stand on
    ticks that are whole periods, none where the truth is unknown.
    """
    record, beta = log.record, log.truth["beta"]
    if settings.course_rate * record.dt > 1.0 + 1e-6:
        raise ValueError(
            f"a course at {settings.course_rate:g} Hz needs a log at least as fast; "
            f"this one has {1.0 / record.dt:.4g} rows a second"
        )
    rows, late = round(1.0 / (settings.course_rate * record.dt)), round(settings.delay / record.dt)
    captured = np.arange(-record.first % rows, len(beta), rows)
    noise = np.random.default_rng(seed).standard_normal(len(captured))
    exact = (beta + log.heading)[captured] + math.radians(settings.bias_deg)
    course = np.full(len(beta), np.nan)
    course[captured] = exact + math.radians(settings.course_noise_deg) * noise
    course[max(len(beta) - late, 0) :] = np.nan  # these would arrive after the end
    values = {"time": log.time, "speed_x": log.speed, "course": course}
    values["gps_latency"] = np.full(len(beta), late * record.dt)
    packets, _ = make_packets(values, record.first, record.dt)
    gps = SlowSensor(period=rows * record.dt, delays=(late * record.dt,))
    return replace(log, record=replace(record, packets=packets), slow={"gps": gps})


def _make_drives(log: Log, settings: Settings) -> list[Log]:
    """Make a drive for each noise of the course, or the logged one, with the gyro's bias."""
    duration = log.time[-1] - log.time[0]
    if duration < SETTLED:
        text = f"the drive lasts {duration:.3g} s, errors count from {SETTLED:g} s on"
        raise ValueError(f"{log.name}: {text}")
    drives, fast = [log], log.record.fast.copy()
    if settings.emulated and "beta" in log.truth and not log.slow:
        drives = [_emulate_course(log, settings, settings.seed + i) for i in range(settings.seeds)]
    fast[:, FAST.gyro] += math.radians(settings.gyro_bias_degps)
    return [replace(drive, record=replace(drive.record, fast=fast)) for drive in drives]


@dataclass
class ReplayResult:
    """Errors of one vehicle's estimators on one drive, by estimator."""

    # by seed: mean squared error (rad2), NEES, fraction of errors in the 95 % interval, mean log
    # score, shape (seeds, 4), the best median log score first; empty without truth
    scores: dict[str, Array] = field(default_factory=dict)
    nis: dict[str, float] = field(default_factory=dict)  # mean, a value of a packet; first seed
    traces: dict[str, Array] = field(default_factory=dict)  # sideslip of the first seed (rad)
    remarks: dict[str, str] = field(default_factory=dict)  # why it is left out, or what it misses

    @property
    def rmse(self) -> dict[str, Estimate]:
        """RMS errors over the seeds (rad), best first."""
        ranges = {name: compute_range(np.sqrt(x[:, 0])) for name, x in self.scores.items()}
        return dict(sorted(ranges.items(), key=lambda item: item[1].value))

    def compare(self, name: str, other: str = GYRO_ONLY) -> Estimate:
        """Compute the RMS error over another's, seed by seed.

        Args:
            name: Estimator.
            other: The other one.
        """
        return compute_range(np.sqrt(self.scores[name][:, 0] / self.scores[other][:, 0]))


def _run_estimators(drives: Sequence[Log], vehicle: Vehicle, settings: Settings) -> ReplayResult:
    """Run every wanted estimator that the drives' slow sensors serve over every drive."""
    log, result = drives[0], ReplayResult()
    counts = (log.time >= log.time[0] + SETTLED - 1e-9) & ~log.is_backward
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
        for drive in drives:
            estimates = estimator.run(drive)
            result.traces.setdefault(name, estimates["beta"])
            if slow is not None and np.isfinite(estimates.nis).any():
                values = len(MEASUREMENTS[slow].rows)  # of a packet, each of which adds 1
                result.nis.setdefault(name, float(np.nanmean(estimates.nis)) / values)
            if truth is not None:
                wrong = (estimates["beta"] - truth)[counts]
                deviation = estimates.std[counts, estimates.names.index("beta")]
                honesty = compute_honesty(wrong, deviation)
                numbers.append((np.mean(wrong**2), *honesty))
        if truth is not None:
            result.scores[name] = np.array(numbers)
    ranked = sorted(result.scores.items(), key=lambda item: -float(np.median(item[1][:, 3])))
    result.scores = dict(ranked)
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


def replay(log: Log, vehicle: Vehicle, **settings: Any) -> Suite:
    """Run the estimators over a recorded drive, designed from this vehicle, and score them.

    A log with slow sensors is replayed with those; else a GPS course is emulated where the log
    knows the true sideslip; else estimators that need one are left out. Without truth nothing is
    scored, but drawn. Of rmse (rad, from 2 s on) and ratio (over gyro-only), value is the median,
    low and high are the smallest and largest over the noises.

    Args:
        log: Recorded drive.
        vehicle: Vehicle from which the estimators are designed.
        settings: Fields of `Settings`; TypeError for an unknown, ValueError for a bad one.
    """
    how = Settings(**settings)
    drives = _make_drives(log, how)
    result = _run_estimators(drives, vehicle, how)
    suite = Suite("replay", f"A recorded drive: {log.name}", _make_text(log, drives, vehicle, how))
    records = _add_rows(suite, result, log.name, vehicle, how)
    suite.tables = [_make_table(result, records, f"{log.name}, {vehicle.name}", len(drives))]
    suite.verdict = _compose_verdict(result, "gps" in drives[0].slow and "gps" not in log.slow)
    if how.figures:
        _draw_figures(suite, result, log)
    return suite


def replay_file(
    log: str | Path, vehicle: VehicleSource = "passenger-car", *,
    mapping: Sequence[str] | None = None, wires: SignalCalibration = AS_LOGGED,
    nominal: VehicleSource = "passenger-car", until: float | None = None, **settings: Any,
) -> Suite:  # fmt: skip
    """Read a drive and replay it, each part of a log with holes by itself.

    Args:
        log: File of the drive; ValueError where its reader or `replay` refuses it.
        vehicle: Vehicle as for `make_vehicle`. "identify": the log identifies the car, or its
            first `until` s do and the rest is replayed.
        mapping: Texts such as "steer_rad=Delta".
        wires: Calibration of the signals; its latency and noise overrule identified ones.
        nominal: Vehicle whose mass and arms an identified car with linear tyres has.
        until: End of the identifying part (s); like `nominal` a ValueError without "identify".
        settings: Fields of `Settings`.
    """
    if is_nmea(log):
        raise ValueError(f"{log}: a receiver's log (NMEA); replay_nmea reads it")
    if vehicle != "identify" and (until is not None or nominal != "passenger-car"):
        raise ValueError("--until and --nominal are for --vehicle identify")
    tables, unknown = list[ResultTable](), ""
    if vehicle == "identify":
        result, shown = identify_file(log, nominal, mapping, wires, "linear", until)
        vehicle, tables, unknown = result.car, shown.tables, result.reason
        latency = {**result.wires.latency, **wires.latency}
        wires = result.wires._replace(latency=latency, noise={**result.wires.noise, **wires.noise})
    car = make_vehicle(vehicle)
    logs, remarks = read_parts(log, parse_mapping(mapping), start=until or 0.0)
    logs = [apply_wires(part, wires) for part in logs]
    present = {name for part in logs for name in part.slow}
    settings = {"noise": wires.noise} | settings | {"emulated": not present}
    is_emulated = not present and any("beta" in part.truth for part in logs)
    for name in () if is_emulated else ("course_rate", "delay", "bias_deg"):
        if settings.get(name, getattr(Settings, name)) != getattr(Settings, name):
            has = "the log has slow sensors itself" if present else "no true angle makes one"
            raise ValueError(f"{name} is of an emulated course, got {settings[name]}; {has}")
    for name in sorted({"camera", "gps"} & wires.latency.keys() - present):
        remarks.append(f"The latency of {name} is not used: the log has no such sensor.")
    parts = [part for part in logs if part.time[-1] - part.time[0] >= SETTLED] or logs[:1]
    suites = [replay(part, car, **settings) for part in parts]
    times = [part.time[-1] - part.time[0] for part in parts]
    suite = suites.pop(longest := int(np.argmax(times)))  # whose verdict is the file's
    for other in suites:
        suite.rows += other.rows
        suite.tables += other.tables
        suite.figures += other.figures
    suite.tables += tables
    suite.warnings, remarks = sort_remarks(remarks, logs, car)
    suite.text = "\n\n".join([suite.text, *remarks])
    if suites:
        text = f"the verdict is of the longest of {len(parts)} parts, "
        suite.warnings.append(f"{text}{times[longest]:.0f} of {sum(times):.0f} s")
    if unknown:
        suite.warnings.append(f"the car is not identified, {unknown}: it stays as stated")
    if any(text.startswith(TRUTH) for text in suite.warnings):
        suite.verdict = "\n".join([TRUTH_WARNING, *suite.verdict.splitlines()[1:]])
    return suite


def _compose_verdict(result: ReplayResult, emulated: bool) -> str:
    """Compose the verdict; emulated: whether the GPS course is made from the truth."""
    if not result.scores:
        return format_verdict(
            f"Nobody wins: without the true sideslip angle {len(result.traces)} estimators are "
            "drawn, not scored.",
            describe_innovations(result.nis),
            "Not covered: how far off they are. A log with a true sideslip angle would show it.",
        )
    best, scores = next(iter(result.scores.items()))
    share = float(np.median(scores[:, 2]))
    rmse = {name: DEGREES * errors.value for name, errors in result.rmse.items()}
    first, *rest = rmse
    over = {name: result.compare(first, name) for name in rest}
    gain = f"{GYRO_ONLY}, with the gyro alone, errs {rmse[GYRO_ONLY]:.2f} deg"
    helps = "does not help" if first == GYRO_ONLY else "helps"
    return format_verdict(
        "An estimator infers the sideslip angle: between where the car points and where it goes.",
        f"From the recorded angle {describe_leader(first, over, 'stray')}.",
        f"Its error: {rmse[first]:.2f} deg. By the log score {best} is best; its 95 % interval "
        f"holds {100.0 * share:.0f} %.",
        f"Why: {gain}; a slow sensor {helps} here.",
        "Not covered: other drives and cars"
        + ("; the GPS course is made from the truth, with drawn noise." if emulated else "."),
    )


def _make_text(log: Log, drives: Sequence[Log], car: Vehicle, settings: Settings) -> str:
    duration, rate = log.time[-1] - log.time[0], 1.0 / log.record.dt
    text = [
        f"{duration:.0f} s at {rate:.4g} Hz. The estimators are designed from {car.name!r} "
        f"and one process noise: {settings.q_beta:g} rad2/s on sideslip, {settings.q_gamma:g} "
        f"(rad/s)2/s on yaw rate, {settings.q_psi:g} rad2/s on heading."
    ]
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
        if count := int(log.is_backward.sum()):
            text.append(f"{count} rows are driven backward, and not scored.")
    else:
        text.append("The log has no sideslip truth, so nothing is scored.")
    return " ".join(text)


def _add_rows(
    suite: Suite, result: ReplayResult, scenario: str, car: Vehicle, how: Settings
) -> Any:
    """Add rows of every number of a result, and return the records, best first."""
    plain = asdict(how) | {"estimators": list(how.estimators or ESTIMATORS)}
    del plain["figures"], plain["emulated"]  # these move no number
    spec = json.dumps({"vehicle": car.to_dict(), "settings": plain})
    records = {}
    for name in result.traces:
        record: dict[str, Any] = {"estimator": name, "n": 1}
        if name in result.scores:
            scores = result.scores[name]
            errors = {"rmse": result.rmse[name], "ratio": result.compare(name)}
            record |= errors | {"n": len(scores)}
            for column, values in zip(HONESTY, scores.T[1:], strict=True):
                record[column.key] = compute_range(values)
        if name in result.nis:
            record["nis"] = result.nis[name]
        records[name] = record
    where = {"scenario": scenario, "salt": f"seed {how.seed}", "spec": spec}
    suite.add_rows(records.values(), env_version=f"replay {__version__}", **where)
    return [records[name] for name in result.scores or records]


def _make_table(
    result: ReplayResult, records: Sequence[Any], name: str, noises: int
) -> ResultTable:
    note = "; ".join(f"`{label}` {remark}" for label, remark in result.remarks.items())
    if not result.scores:
        columns = "estimator", Column("nis", "NIS of a value", form=".2f")
        return ResultTable(f"{name}: no truth, no score", columns, records, note)
    rmse = Column("rmse", "RMSE / deg [least, most]", DEGREES, ".3f")
    ratio = Column("ratio", "of gyro only", form=".2f", interval=False)
    title = f"{name}: error of the sideslip angle (median of {noises} noises)"
    return ResultTable(title, ("estimator", rmse, ratio, *HONESTY), records, note)


def _draw_figures(suite: Suite, result: ReplayResult, log: Log) -> None:
    """Draw sideslip angles and, with truth, errors of the first noise, and a bar for each RMSE."""
    from ..report.figures import draw_groups, draw_time_series

    truth, label = log.truth.get("beta"), "sideslip angle / deg"
    lines = result.traces if truth is None else {"truth": truth} | result.traces
    angles = {name: DEGREES * beta for name, beta in lines.items()}
    overview = _select_traces(draw_time_series(log.time, angles, label), result)
    title = f"{log.name}: the sideslip angle and its estimates"
    suite.figures = [(title, overview, _HIDDEN)]
    if truth is None:
        return
    errors = {name: DEGREES * (beta - truth) for name, beta in result.traces.items()}
    over_time = draw_time_series(log.time, errors, f"error of the {label}", zero_line=True)
    figure = _select_traces(over_time, result)
    suite.figures.append((f"{log.name}: errors", figure, f"Estimate minus truth. {_HIDDEN}"))
    groups = {log.name: {name: x.rescale(DEGREES) for name, x in result.rmse.items()}}
    bars = draw_groups(groups, f"RMSE of the {label}", {})
    text = f"Median over the noises; whiskers: least and most. {GYRO_ONLY} has no slow sensor."
    question = f"Which estimator is closest on a recorded drive? ({log.name})"
    suite.answers = [(question, bars, f"{suite.verdict.splitlines()[1]} {text}")]


def _select_traces(figure: Any, result: ReplayResult) -> Any:
    """The figure with only truth, gyro-only and the best estimator in sight."""
    hidden = result.traces.keys() - {GYRO_ONLY, next(iter(result.rmse), "exact-kf")}
    return figure.update_traces({"visible": "legendonly"}, lambda trace: trace.name in hidden)
