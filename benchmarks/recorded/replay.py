"""A file with a recorded drive, replayed or identified: its parts, signals' calibration, car."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...envs.record import FAST, Log
from ...envs.recordings.log_file import WARNING_PREFIX, read_parts
from ...envs.recordings.tables import parse_mapping
from ...envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from ...estimators.wires import SignalCalibration, apply_wires
from ..harness.drives import SETTLED
from ..harness.results import Suite
from .identify import IdentificationResult, identify, make_suite
from .quality import TRUTH, estimate_resolution, find_contradictions
from .suite import corners, replay
from .validate import make_validation_table

_FITTED, _NOMINAL = "ferrari-250lm-fitted", "ferrari-250lm-nominal"
_FACTOR = 0.7  # of the fitted tyres, where no vehicle is named
TRUTH_WARNING = "The truth of this log is in doubt, and with it all errors: see the warnings."


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
    suite = make_suite(result, logs[0].name)
    suite.warnings = warnings
    if validate:
        suite.tables.append(make_validation_table(logs, car, wires, tyres))
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

    Returns:
        Suite of all parts and corners.

    Raises:
        ValueError: A drive has `until` without "identify", or the readers or `replay` refuse it.
    """
    if until is not None and vehicle != "identify":
        raise ValueError("--until is for --vehicle identify")
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
    parts = [part for part in logs if part.time[-1] - part.time[0] >= SETTLED] or logs[:1]
    suite, *others = [replay(part, design, **settings) for part in parts]
    settings["stiffness_factor"] = factor
    others += [corners(part, car, **settings) for part in parts if "beta" in part.truth]
    for other in others:
        suite.rows += other.rows
        suite.tables += other.tables
        suite.figures += other.figures
    suite.tables += tables
    suite.warnings, remarks = _sort_remarks(remarks, logs, design)
    suite.text = "\n\n".join([suite.text, *remarks])
    if unknown:
        suite.warnings.append(f"the car is not identified, {unknown}: it stays as stated")
    if any(text.startswith(TRUTH) for text in suite.warnings):
        suite.verdict = "\n".join([TRUTH_WARNING, *suite.verdict.splitlines()[1:]])
    return suite
