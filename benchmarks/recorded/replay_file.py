"""A file with a recorded drive, replayed: its parts, its wires, its car."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...envs.recordings.columns import parse_mapping
from ...envs.recordings.parts import URGENT, read_parts
from ...envs.recordings.sources import is_nmea
from ...envs.vehicle.vehicles import VehicleSource, vehicle_from
from ..harness.drives import SETTLED
from ..harness.results import Suite
from .checks import TRUTH, remarks_of, warnings_of
from .identify import Identified, identify, suite_of
from .suite import corners, replay
from .wires import Wires, corrected

FITTED, NOMINAL = "ferrari-250lm-fitted", "ferrari-250lm-nominal"
FACTOR = 0.7  # of the fitted tyres, where no vehicle is named
DOUBT = "The truth of this log is in doubt, and with it all errors: see the warnings."


def urgent_first(remarks: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a reader's remarks into warnings, without their mark, and the rest."""
    urgent = [text.removeprefix(URGENT).rstrip(".") for text in remarks if text.startswith(URGENT)]
    return urgent, [text for text in remarks if not text.startswith(URGENT)]


def identify_file(
    log: str | Path,
    vehicle: VehicleSource,
    mapping: Sequence[str] = (),
    wires: Wires | None = None,
    tyres: str | None = None,
    until: float | None = None,
) -> tuple[Identified, Suite]:
    """Read a drive and find its car: (what the log shows, its table).

    until: s of the log that are used, None: all. Raises what `read_parts`, `vehicle_from` and
    `identify` do.
    """
    logs, remarks = read_parts(log, parse_mapping(mapping), end=until)
    car = vehicle_from(vehicle)
    found = identify(logs, car, wires, tyres)
    urgent, remarks = urgent_first(remarks)
    found.remarks = [*remarks, *remarks_of(logs), *found.remarks]
    suite = suite_of(found, logs[0].name)
    suite.warnings = urgent + warnings_of(logs, car)
    return found, suite


def replay_file(
    log: str | Path,
    vehicle: VehicleSource | None = None,
    *,
    mapping: Sequence[str] | None = None,
    wires: Wires | None = None,
    nominal: VehicleSource = "passenger-car",
    until: float | None = None,
    **settings: Any,
) -> Suite:
    """Read a drive and its vehicle, replay it, each part of a log with holes by itself, and where
    it has truth the vehicle's corners too; a receiver's log (NMEA) is replayed as `replay_nmea`
    does.

    vehicle: of `vehicle_from`; "identify": found in the log, or in its first `until` s, of which
    the rest is then replayed, with the mass and arms of `nominal` and linear tyres, which
    estimators have; None: the Ferrari 250 LM of the Stanford log, with the fitted tyres x 0.7, and
    the corners of the nominal one. mapping: texts such as "steer_rad=Delta". wires: what is known
    beside the car; identified ones stand behind it.
    settings: of `replay`. Raises what `read_parts`, `vehicle_from`, `identify`, `replay` do.
    """
    if is_nmea(log):
        from .receiver_suite import receiver_suite, replay_nmea

        return receiver_suite(replay_nmea(log, vehicle, mapping))
    if until is not None and vehicle != "identify":
        raise ValueError("--until is for --vehicle identify")
    wires, tables, unknown = wires or Wires(), [], ""
    if vehicle == "identify":
        found, shown = identify_file(log, nominal, mapping or (), wires, "linear", until)
        vehicle, tables, unknown = found.car, shown.tables, found.reason
        latency = {**found.wires.latency, **wires.latency}
        wires = found.wires._replace(latency=latency, noise={**found.wires.noise, **wires.noise})
    logs, remarks = read_parts(log, parse_mapping(mapping or ()), start=until or 0.0)
    logs = [corrected(part, wires) for part in logs]
    if vehicle is None:
        car, design = vehicle_from(NOMINAL), vehicle_from(FITTED)
        settings = {"stiffness_factor": FACTOR} | settings
        remarks.append(
            "No vehicle was named, so the estimators assume the Ferrari 250 LM of the Stanford "
            f"log, fitted tyres x {FACTOR}. For another car name its file: `--vehicle FILE`."
        )
    else:
        car = design = vehicle_from(vehicle)
    remarks += remarks_of(logs)
    settings = {"noise": wires.noise} | settings
    settings["emulated"] = not any(part.slow for part in logs)
    parts = [part for part in logs if part.time[-1] - part.time[0] >= SETTLED] or logs[:1]
    suite, *others = [replay(part, design, **settings) for part in parts]
    others += [corners(part, car, **settings) for part in parts if "beta" in part.truth]
    for each in others:
        suite.rows += each.rows
        suite.tables += each.tables
        suite.figures += each.figures
    suite.tables += tables
    urgent, remarks = urgent_first(remarks)
    suite.text = "\n\n".join([suite.text, *remarks])
    suite.warnings = urgent + warnings_of(logs, design)
    if unknown:
        suite.warnings.append(f"the car is not identified, {unknown}: it stays as stated")
    if any(text.startswith(TRUTH) for text in suite.warnings):
        suite.verdict = "\n".join([DOUBT, *suite.verdict.splitlines()[1:]])
    return suite
