"""A file with a recorded drive, replayed or identified; whether the car found stays near the log.

The identified car drives held-out parts of the log by steering and speed, beside what was measured.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.recordings.log_file import WARNING_PREFIX, read_parts
from ...envs.recordings.sources import is_nmea
from ...envs.recordings.tables import parse_mapping
from ...envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from ...estimators.wires import SignalCalibration, apply_wires
from ..harness.drives import SETTLED
from ..harness.results import Column, ResultTable, Suite
from ..harness.verdict import format_verdict
from .bicycle_fit import compute_residual, make_windows, simulate_windows
from .identify import Finding, IdentificationResult, identify
from .quality import TRUTH, estimate_resolution, find_contradictions, find_saturated
from .suite import Settings, corners, replay

_FITTED, _NOMINAL = "ferrari-250lm-fitted", "ferrari-250lm-nominal"
_FACTOR = 0.7  # of the fitted tyres, where no vehicle is named
TRUTH_WARNING = "The truth of this log is in doubt, and with it all errors: see the warnings."
_FINDINGS_NOTE = (
    "Intervals by a jackknife over 40 stretches of the log (20 for sensors), and by priors around "
    "what is stated, to which numbers that this log does not tell are drawn. Latencies of steering "
    "and acceleration are applied only where they lower the error on stretches that the fit has "
    "not seen: the lag of tyres looks like one."
)
_BLOCK, _MOST_BLOCKS = 12.0, 16  # s, the shortest; of a part
# ISO 19364 (steady-state circular driving) and ISO 22140 (lateral transient response) compare a
# simulation with tolerances around what was measured. Their texts are not at hand: these numbers
# are assumed. name: factor to the unit shown, unit, offset in it, share of the measured value
_CORRIDORS = {
    "yaw rate": (180.0 / np.pi, "deg/s", 1.0, 0.1),
    "lateral acceleration": (1.0, "m/s2", 0.3, 0.1),
    "sideslip angle": (180.0 / np.pi, "deg", 0.3, 0.15),
}
_MIN_SHARE, _MAX_GAIN_ERROR = 0.95, 0.1  # assumed as well
_VALIDATION_NOTE = (
    "Odd blocks identify, even ones are driven open loop: the model's first second forgets its "
    "start, 4 s count. A sample is inside within offset + share x what was measured; a channel "
    f"stays inside with {100.0 * _MIN_SHARE:.0f} % of its samples and a gain (simulated over "
    f"measured, by least squares) within {100.0 * _MAX_GAIN_ERROR:.0f} % of 1. Form after "
    "ISO 19364 and ISO 22140, whose text was not at hand: all tolerances are assumptions, and "
    "this is no proof of conformity."
)


def _sort_remarks(
    remarks: Sequence[str], logs: Sequence[Log], car: Vehicle
) -> tuple[list[str], list[str]]:
    """Sort a reader's remarks into warnings and all others, with those on the drives themselves."""
    marked = [text for text in remarks if text.startswith(WARNING_PREFIX)]
    urgent = [text.removeprefix(WARNING_PREFIX).rstrip(".") for text in marked]
    others = [text for text in remarks if text not in marked]
    step = math.degrees(max(estimate_resolution(log.record.fast[:, FAST.gyro]) for log in logs))
    others += [f"The gyro's resolution is {step:.3g} deg/s."] if step > 0.1 else []
    return urgent + [finding.text for finding in find_contradictions(logs, car)], others


def identify_file(
    log: str | Path,
    vehicle: VehicleSource,
    mapping: Sequence[str] = (),
    wires: SignalCalibration | None = None,
    tyres: str | None = None,
    until: float | None = None,
    validate: bool = False,
) -> tuple[IdentificationResult, Suite]:
    """Read a drive and identify its car.

    Args:
        log: File of the drive.
        vehicle: Stated vehicle, as for `make_vehicle`.
        mapping: Texts such as "steer_rad=Delta".
        wires: Stated calibration of the signals.
        tyres: Law of the tyres, as for `identify`.
        until: End of the part that is used (s), None for all.
        validate: Whether to say how well a car from half of the log drives the other half.

    Returns:
        Identified car and calibration, and their suite.
    """
    logs, remarks = read_parts(log, parse_mapping(mapping), end=until)
    car = make_vehicle(vehicle)
    result = identify(logs, car, wires, tyres)
    warnings, remarks = _sort_remarks(remarks, logs, car)
    result.remarks = remarks + result.remarks
    suite = _make_suite(result, logs[0].name)
    suite.warnings = warnings
    if validate:
        suite.tables.append(_make_validation_table(logs, car, wires, tyres))
    return result, suite


def replay_file(
    log: str | Path,
    vehicle: VehicleSource | None = None,
    *,
    mapping: Sequence[str] | None = None,
    wires: SignalCalibration | None = None,
    nominal: VehicleSource = "passenger-car",
    until: float | None = None,
    **settings: Any,
) -> Suite:
    """Read a drive and replay it, each part of a log with holes by itself; with truth, corners too.

    Args:
        log: File of the drive.
        vehicle: Vehicle as for `make_vehicle`. "identify": the log identifies the car, or its
            first `until` s do and the rest is replayed. None: the Ferrari 250 LM of the Stanford
            log, for estimates with fitted tyres x 0.7, for corners with nominal tyres.
        mapping: Texts such as "steer_rad=Delta".
        wires: Calibration of the signals; its latency and noise overrule identified ones.
        nominal: Vehicle whose mass and arms an identified car with linear tyres has.
        until: End of the part that identifies the car (s).
        settings: Fields of `Settings`.

    Raises:
        ValueError: `until` or `nominal` without "identify", or the readers or `replay` refuse it.
    """
    if is_nmea(log):
        raise ValueError(f"{log}: a receiver's log (NMEA); replay_nmea reads it")
    if vehicle != "identify" and (until is not None or nominal != "passenger-car"):
        raise ValueError("--until and --nominal are for --vehicle identify")
    wires, tables, unknown = wires or SignalCalibration(), [], ""
    factor = settings.get("stiffness_factor", 1.0)  # of corners, whose tyres are nominal
    if vehicle == "identify":
        result, shown = identify_file(log, nominal, mapping or (), wires, "linear", until)
        vehicle, tables, unknown = result.car, shown.tables, result.reason
        latency = {**result.wires.latency, **wires.latency}
        wires = result.wires._replace(latency=latency, noise={**result.wires.noise, **wires.noise})
    logs, remarks = read_parts(log, parse_mapping(mapping or ()), start=until or 0.0)
    logs = [apply_wires(part, wires) for part in logs]
    if vehicle is None:
        car, design = make_vehicle(_NOMINAL), make_vehicle(_FITTED)
        settings = {"stiffness_factor": _FACTOR} | settings
        remarks.append(
            "No vehicle was named, so the estimators assume the Ferrari 250 LM of the Stanford "
            f"log, fitted tyres x {_FACTOR}. For another car name its file: `--vehicle FILE`."
        )
    else:
        car = design = make_vehicle(vehicle)
    settings = {"noise": wires.noise} | settings
    settings["emulated"] = not any(part.slow for part in logs)
    present = {name for part in logs for name in part.slow}
    is_emulated = not present and any("beta" in part.truth for part in logs)
    for name in () if is_emulated else ("course_rate", "delay", "bias_deg"):
        if settings.get(name, getattr(Settings, name)) != getattr(Settings, name):
            has = "the log has slow sensors itself" if present else "no true angle makes one"
            raise ValueError(f"{name} is of an emulated course, got {settings[name]}; {has}")
    for name in sorted({"camera", "gps"} & wires.latency.keys() - present):
        remarks.append(f"The latency of {name} is not used: the log has no such sensor.")
    parts = [part for part in logs if part.time[-1] - part.time[0] >= SETTLED] or logs[:1]
    suites = [replay(part, design, **settings) for part in parts]
    times = [part.time[-1] - part.time[0] for part in parts]
    suite = suites.pop(longest := int(np.argmax(times)))  # whose verdict is the file's
    settings["stiffness_factor"] = factor
    others = suites + [corners(part, car, **settings) for part in parts if "beta" in part.truth]
    for other in others:
        suite.rows += other.rows
        suite.tables += other.tables
        suite.figures += other.figures
    suite.tables += tables
    suite.warnings, remarks = _sort_remarks(remarks, logs, design)
    suite.text = "\n\n".join([suite.text, *remarks])
    if suites:
        text = f"the verdict is of the longest of {len(parts)} parts, "
        suite.warnings.append(f"{text}{times[longest]:.0f} of {sum(times):.0f} s")
    if unknown:
        suite.warnings.append(f"the car is not identified, {unknown}: it stays as stated")
    if any(text.startswith(TRUTH) for text in suite.warnings):
        suite.verdict = "\n".join([TRUTH_WARNING, *suite.verdict.splitlines()[1:]])
    return suite


def _make_suite(result: IdentificationResult, name: str) -> Suite:
    """Make a suite of what a log shows: a table with a verdict."""
    suite = Suite("identify", f"The car of a recorded drive: {name}", "; ".join(result.remarks))
    missing = [finding.name for finding in result.findings if not finding.is_determined]
    answer = f"Not identified. This log shows nothing of the car: {result.reason}. "
    answer += "It stays as stated."
    if not result.reason:
        text = "The stated car leaves {:.2f} deg/s of the yaw rate, the found one {:.2f} "
        answer = (text + "({:.2f} held out).").format(*map(math.degrees, result.rates))
    slip = ""
    if not any(map(math.isnan, result.slips)):
        text = "Beside the log's own sideslip, which was not used: {:.2f}, now {:.2f} deg."
        slip = text.format(*map(math.degrees, result.slips))
    untold = f"Not told by this log: {', '.join(missing) or 'nothing'}."
    limits = "Not covered: the mass, which scales all; drives beside the part that was used."
    suite.verdict = format_verdict(answer, slip, untold, limits)
    header = ("number", "stated", "found", "95 %", "unit", "told by this log?")
    cells = list(map(_format_cells, result.findings))
    suite.tables = [ResultTable("What the log shows", header, cells, _FINDINGS_NOTE, keyed=False)]
    return suite


def _format_cells(row: Finding) -> list[str]:
    stated, value = (f"{x:.4g}" if math.isfinite(x) else "-" for x in (row.stated, row.value))
    ends = "-"
    if math.isfinite(row.half):
        ends = f"{row.value - row.half:.4g} .. {row.value + row.half:.4g}"
    remark = ": ".join(filter(None, ["yes" if row.is_determined else "no", row.remark]))
    return [row.name, stated, value, ends, row.unit or "-", remark]


def _cut(log: Log, start: int, end: int) -> Log:
    """Cut rows out of a log, with the packets that were captured and arrived in them."""
    record, packets = log.record, log.record.packets
    first, behind = record.first + start, record.first + end
    within = (packets[:, PACKET.captured] >= first) & (packets[:, PACKET.arrived] < behind)
    fast = record.fast[start:end]
    record = dataclasses.replace(record, fast=fast, packets=packets[within], first=first)
    truth = {name: values[start:end] for name, values in log.truth.items()}
    return dataclasses.replace(log, record=record, truth=truth)


def _split_blocks(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Split logs into odd blocks, to identify from, and even ones, which are held out."""
    blocks = []
    for log in logs:
        count = int(np.clip(len(log.time) * log.record.dt / _BLOCK, 1, _MOST_BLOCKS))
        ends = np.linspace(0, len(log.time), count + 1).astype(int).tolist()
        blocks += [_cut(log, *pair) for pair in itertools.pairwise(ends)]
    return blocks[::2], blocks[1::2]


def _make_validation_table(
    logs: Sequence[Log], car: Vehicle, wires: SignalCalibration | None, tyres: str | None
) -> ResultTable:
    """Compare a car from odd blocks of a log with the even ones; where none is found, why."""
    moved = [apply_wires(log, SignalCalibration(at=wires.at if wires else {})) for log in logs]
    odd, even = _split_blocks(moved)
    wires = wires and wires._replace(at={})
    result = identify(odd, car, wires, tyres)
    w = make_windows(even, [find_saturated(log) for log in even]) if even else None
    reason = result.reason
    if w is None or not len(w.starts):
        reason = reason or "no window of 5 s is held out"
    title = "Does the found car stay within assumed corridors of ISO 19364 / 22140?"
    columns = (
        "channel", Column("rmse", "RMSE", form=".3g"), "unit", "corridor",
        Column("inside", "inside / %", 100.0, ".0f"), Column("gain", "gain", form=".3f"), "stays",
    )  # fmt: skip
    if reason or result.theta is None or w is None:
        return ResultTable(title, columns, [], f"Not validated: {reason}.", keyed=False)
    w = dataclasses.replace(w, tyres=result.tyres)
    places, residual = w.scored_rows, compute_residual(car, result.theta, w)
    rows = zip([*_CORRIDORS][: 2 if w.accel else 1], w.rows, residual.swapaxes(0, 1), strict=False)
    measured = {name: (row[places], row[places] - left) for name, row, left in rows}
    if all("beta" in log.truth for log in even):
        every = round(w.dt / even[0].record.dt)
        truth = np.concatenate([log.truth["beta"][::every] for log in even])
        # with the antenna at the centre of gravity its sideslip angle is the car's
        slip = simulate_windows(car.replace(antenna_ahead=0.0), result.theta, w)[2]
        if np.isfinite(truth[places]).any():
            measured["sideslip angle"] = truth[places], slip[:, places[0] - w.starts[0] - 1]
    cells = [_compare(name, *pair) for name, pair in measured.items()]
    return ResultTable(title, columns, cells, _VALIDATION_NOTE, keyed=False)


def _compare(name: str, measured: Array, simulated: Array) -> list[object]:
    """Cells of a channel: measured and simulated, shape (windows, rows)."""
    factor, unit, offset, share = _CORRIDORS[name]
    known = np.isfinite(measured)
    x, y = factor * measured[known], factor * simulated[known]
    inside = float(np.mean(np.abs(y - x) <= offset + share * np.abs(x)))
    gain = float(x @ y / (x @ x))
    stays = inside >= _MIN_SHARE and abs(gain - 1.0) <= _MAX_GAIN_ERROR
    corridor = f"{offset:g} + {100.0 * share:.0f} %"
    rmse = float(np.sqrt(np.mean((y - x) ** 2)))
    return [name, rmse, unit, corridor, inside, gain, "yes" if stays else "no"]
