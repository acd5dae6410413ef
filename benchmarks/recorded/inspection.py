"""`sideslip inspect`: whether a log is worth estimating from, on one page."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...envs.record import PACKET, Array, Log
from ...envs.recordings.dialect import SLOW_QUANTITIES, Quantities, find_sampling
from ...envs.recordings.log_file import NEEDED, read_parts
from ...envs.recordings.sources import is_nmea
from ...envs.recordings.tables import COLUMNS, name_log, parse_mapping, read_columns
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from ...estimators.design.options import MEASUREMENTS
from ...estimators.make import make_estimator
from ...estimators.wires import AS_LOGGED, SignalCalibration, apply_wires
from ..harness.drives import SETTLED, call_quietly
from ..harness.results import Column, ResultTable, Suite
from ..report.study import MAX_NIS, describe_innovations, format_verdict
from .checks import CHECKS, InspectedDrive
from .quality import BLOCKER, LEVELS, OK, WARNING, LogFinding, estimate_resolution

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

    from ...envs.recordings.containers import LogSource

FILTER = "joint"
_DEGREES = 180.0 / math.pi
_PLOTTED = ("speed_x", "yaw_rate", "accel_y", "steer", "course")
_READABLE = {"rad": ("deg", _DEGREES), "radps": ("deg/s", _DEGREES), "mps": ("m/s", 1.0),
             "mps2": ("m/s2", 1.0)}  # fmt: skip
_SHOWN_UNITS = {name: _READABLE.get(si, (si, 1.0)) for name, (si, *_) in COLUMNS.items()}
_LABELS = {
    "bias": "gyro bias", "accel_bias": "accel_y bias", "steer_offset": "steering offset",
    "front_tyres": "front tyre stiffness", "rear_tyres": "rear tyre stiffness", "bank": "bank",
    "accel_scale": "accel_y scale", "inverse_friction": "1 / friction",
}  # fmt: skip
_LEARNT = 0.7  # of the deviation at the start, below which the log tells a number
_USEFUL = math.radians(1.0)  # of deviation, below which a slip of 2 deg is surely one


class Prediction(NamedTuple):
    """What the filter expects of its own estimate on the longest part."""

    time: Array  # s, shape (n,)
    beta: Array  # sideslip angle (rad), shape (n,)
    deviation: Array  # its standard deviation (rad), shape (n,)
    usual: float  # median of the deviation where the car moves (rad)
    nis: float  # mean squared innovation over its variance, NaN without slow samples
    learnt: list[str]  # labels of constants that the log tells
    unseen: tuple[str, ...]  # what its sensors cannot see


def inspect_file(
    source: "LogSource", vehicle: VehicleSource, mapping: Sequence[str] | None = None,
    wires: SignalCalibration = AS_LOGGED, figures: bool = True,
) -> Suite:  # fmt: skip
    """Read a drive and judge whether it is worth estimating from.

    Args:
        source: Table, or its file; ValueError for a receiver's log (NMEA).
        vehicle: Vehicle that is assumed, as for `make_vehicle`.
        mapping: Texts such as "steer_rad=Delta"; ValueError for an unknown column or calibration.
        wires: Calibration of the signals.
        figures: Whether to draw.
    """
    if isinstance(source, str | Path) and is_nmea(source):
        text = "a receiver's log (NMEA) has no gyro and no steering; `sideslip replay` filters it"
        raise ValueError(f"{source}: {text}")
    names, car, prediction = parse_mapping(mapping), make_vehicle(vehicle), None
    drive, findings, remarks = _read_drive(source, names, car, wires)
    if drive.logs and not any(finding.level == BLOCKER for finding in findings):
        try:
            prediction = _predict(max(drive.logs, key=lambda log: len(log.time)), car)
        except ValueError as error:
            cure = "an even period of the course, or a shorter --latency"
            findings.append(LogFinding("filter", BLOCKER, "", str(error), cure))
    findings.sort(key=lambda finding: LEVELS.index(finding.level))
    suite = Suite("inspect", f"Is it worth estimating from? {name_log(source)}", " ".join(remarks))
    suite.verdict = _compose_verdict(findings, prediction, car)
    suite.tables = [_make_channels(drive.values), *_make_findings(findings)]
    if figures and drive.values:
        drawn = _draw_figures(drive.values, prediction)
        suite.answers, suite.figures = drawn[:2], drawn[2:]
    return suite


def _read_drive(
    source: "LogSource", names: dict[str, str], car: Vehicle, wires: SignalCalibration
) -> tuple[InspectedDrive, list[LogFinding], list[str]]:
    """The drive, what checks find, remarks; that a file is refused is the only finding then."""
    drive, remarks = InspectedDrive({}, {}, [], car, wires), list[str]()
    try:
        drive.values, drive.kinds, _ = read_columns(source, names, ("time",))
        if set(NEEDED) <= drive.values.keys():
            logs, remarks = read_parts(source, names)
            drive.logs = [apply_wires(log, wires) for log in logs]
    except ValueError as error:
        text = str(error).removeprefix(f"{name_log(source)}: ")
        return drive, [LogFinding("reading", BLOCKER, "", text, "mend the file")], remarks
    return drive, [finding for check in CHECKS for finding in check(drive)], remarks


def _predict(log: Log, car: Vehicle) -> Prediction:
    facts = {"sensors": log.slow, "dt": log.record.dt, "present": log.record.present}
    filter_ = call_quietly(make_estimator, FILTER, vehicle=car, **facts)
    estimates = filter_.run(log)
    deviation = estimates.std[:, estimates.names.index("beta")]
    moving = log.is_moving & (log.time >= log.time[0] + SETTLED)
    usual = float(np.median(deviation[moving])) if moving.any() else math.nan
    used = np.isfinite(estimates.nis)
    sensors = [SLOW_NAMES[int(i)] for i in log.record.packets[used, PACKET.sensor]]
    start, end = estimates.std[0], estimates.std[-1]
    known = {_LABELS[x]: i for i, x in enumerate(estimates.names) if x in _LABELS}
    learnt = [label for label, i in known.items() if end[i] < _LEARNT * start[i]]
    values = np.mean([len(MEASUREMENTS[sensor].rows) for sensor in sensors] or math.nan)
    nis = float(np.mean(estimates.nis[used]) / values) if sensors else math.nan
    unseen = filter_.unobservable
    return Prediction(log.time, estimates["beta"], deviation, usual, nis, learnt, unseen)


def _compose_verdict(
    findings: Sequence[LogFinding], prediction: Prediction | None, car: Vehicle
) -> str:
    counts = Counter(finding.level for finding in findings)
    tally = f"{counts[BLOCKER]} BLOCKER, {counts[WARNING]} WARNING, {counts[OK]} OK."
    if counts[BLOCKER] or prediction is None:
        first = findings[0]  # those that block come first
        cure = f" ({first.cure})" if first.cure and first.cure not in first.text else ""
        what = f"{first.channel}: " if first.channel else ""
        stop = "Do not estimate from this log before it is mended."
        return format_verdict(stop, f"First: {what}{first.text}{cure}.", tally)
    if math.isnan(prediction.usual):
        slow = "The car is never fast enough for a sideslip angle: nothing is estimated."
        return format_verdict(slow, tally)
    deviation = prediction.usual * _DEGREES
    is_lost = prediction.nis > MAX_NIS
    worth = "worth little" if is_lost or prediction.usual > _USEFUL else "worth it"
    unseen = f"; it cannot see {', '.join(prediction.unseen)}" if prediction.unseen else ""
    nis = {} if math.isnan(prediction.nis) else {FILTER: prediction.nis}
    return format_verdict(
        f"This log is {worth}: {FILTER} expects its sideslip angle within {deviation:.2f} deg "
        f"(one deviation, median), if the car is like {car.name}.",
        f"It also tells: {', '.join(prediction.learnt) or 'nothing else'}{unseen}.",
        describe_innovations(nis),
        tally,
    )


def _make_channels(values: Quantities) -> ResultTable:
    rows = []
    for name, column in values.items():
        known = np.isfinite(column)
        if name == "time" or not known.any():
            continue
        unit, scale = _SHOWN_UNITS[name]
        x, steps = column[known] * scale, np.diff(values["time"][known])
        usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else math.nan
        kind, period = find_sampling(column[known])
        rows.append([
            name, unit, 1.0 / (usual * (period or 1.0)), steps.max(initial=0.0),
            estimate_resolution(x) or "fine", float(x.min()), float(x.max()),
            kind or ("samples" if name in SLOW_QUANTITIES else "each row"),
        ])  # fmt: skip
    columns = (
        "channel", "unit", Column("rate", "Hz", form=".3g"), Column("step", "gap / s", form=".3g"),
        Column("grain", "resolution", form=".2g"), Column("low", "from", form=".3g"),
        Column("high", "to", form=".3g"), "values",
    )  # fmt: skip
    return ResultTable("Channels", columns, rows, keyed=False, opened=True)


def _make_findings(findings: Sequence[LogFinding]) -> list[ResultTable]:
    """Make the table of what is not OK, and one of all for the report."""
    columns, cells = ("level", "channel", "what, and what mends it"), []
    for x in (finding for finding in findings if finding.level != OK):
        text = x.text if x.text.endswith("?") else f"{x.text}."
        cells.append([x.level, x.channel, f"{x.check}: {text} -> {x.cure}"])
    note = f"{len(findings) - len(cells)} findings are OK."
    heads = ("check", "level", "channel", "what", "what mends it")
    complete = ResultTable("All findings", heads, findings, keyed=False, detail=True)
    shown = ResultTable("What is not OK", columns, cells, note, keyed=False, opened=True)
    return [shown, complete] if cells else [complete]


def _draw_figures(
    values: Quantities, prediction: Prediction | None
) -> list[tuple[str, "Figure", str]]:
    """Each channel over time, and the sideslip angle with its deviation."""
    from ..report.figures import draw_time_series

    shown = []
    if prediction is not None:
        beta, margin = prediction.beta * _DEGREES, 1.96 * prediction.deviation * _DEGREES
        lines = {FILTER: beta, "95 % from": beta - margin, "95 % to": beta + margin}
        figure = draw_time_series(prediction.time, lines, "sideslip angle / deg", zero_line=True)
        shown.append(("The sideslip angle that this log gives", figure, "Longest part."))
    for name in _PLOTTED:
        if name in values and np.isfinite(values[name]).any():
            unit, scale = _SHOWN_UNITS[name]
            dots = (name,) if name in SLOW_QUANTITIES else ()
            column = {name: scale * values[name]}
            figure = draw_time_series(values["time"], column, f"{name} / {unit}", dots=dots)
            shown.append((name, figure, "As it stands in the file."))
    return shown
