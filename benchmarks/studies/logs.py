"""The suite `logs`: `joint`, with one setting, on every recorded drive that the user downloaded."""

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Array, Log
from ...envs.recordings.log_file import read_parts
from ...envs.recordings.tables import parse_mapping
from ...envs.vehicle.parameters import VehicleSource, make_vehicle
from ...estimators.analysis.smoother import smooth
from ...estimators.make import make_estimator
from ...estimators.wires import apply_wires, read_wires
from ..harness.drives import SETTLED, call_quietly
from ..harness.results import HONESTY, Column, ResultTable, Suite
from ..harness.stats import compute_honesty
from ..report.study import Request, Study, format_verdict

_FILE = Path(__file__).with_suffix(".toml")
_NAME = "joint"
_DEG = math.degrees(1.0)
_COLUMNS = (
    Column("scenario", "drive"), "estimator", Column("n", "rows", form=".0f", interval=False),
    Column("median", "median / deg", _DEG, ".2f", interval=False),
    Column("p95", "95th / deg", _DEG, ".2f", interval=False),
    Column("worst", "worst / deg", _DEG, ".2f", interval=False), *HONESTY,
)  # fmt: skip


def _measure(request: Request) -> tuple[list[dict[str, Any]], list[str]]:
    records, absent = list[dict[str, Any]](), list[str]()
    if request.data is not None and not request.data.is_dir():
        raise FileNotFoundError(f"{request.data}: there is no such folder")
    for preset in tomllib.loads(_FILE.read_text(encoding="utf-8"))["preset"]:
        files = sorted(request.data.glob(preset["pattern"])) if request.data else []
        if not files:
            absent.append(
                f"{preset['name']} is not there: {preset['address']}. Licence: "
                f"{preset['licence']}. Save as {preset['pattern']} in the folder "
                f"of --data: {preset['prepare']}"
            )
        for path in files:
            beside = path.with_name("vehicle.toml")
            vehicle: VehicleSource = beside if beside.exists() else preset["vehicle"]
            try:
                parts, _ = read_parts(path, parse_mapping(preset["mapping"]))
            except ValueError as error:
                absent.append(str(error))
                continue
            for part in parts:
                log = apply_wires(part, read_wires(vehicle))
                if _find_scored(log).any():
                    records += _score(log, vehicle)
                else:
                    reason = "no true sideslip angle while it moves, from 2 s on"
                    absent.append(f"{log.name} is not scored: {reason}")
    return records, absent


def _find_scored(log: Log) -> npt.NDArray[np.bool_]:
    truth = log.truth.get("beta", np.full(len(log.time), np.nan))
    is_settled = log.time >= log.time[0] + SETTLED - 1e-9
    return np.asarray(is_settled & log.is_moving & ~log.is_backward & np.isfinite(truth))


def _score(log: Log, vehicle: VehicleSource) -> list[dict[str, Any]]:
    """Records of a drive: the filter, and the smoother, which knows one second more."""
    facts = {"sensors": log.slow, "dt": log.record.dt, "present": log.record.present}
    filter_ = call_quietly(make_estimator, _NAME, vehicle=make_vehicle(vehicle), **facts)
    truth, records = log.truth["beta"], []
    counts = _find_scored(log)
    for label, estimates in (
        (_NAME, filter_.run(log)),
        ("its smoother, 1 s", call_quietly(smooth, filter_, log)),
    ):
        place = estimates.names.index("beta")
        error: Array = (estimates.x[:, place] - truth)[counts]
        numbers = np.quantile(np.abs(error), (0.5, 0.95, 1.0)).tolist()
        numbers += compute_honesty(error, estimates.std[counts, place])
        keys = ("median", "p95", "worst", *(column.key for column in HONESTY))
        record = {"scenario": log.name, "estimator": label, "n": len(error)}
        records.append(record | dict(zip(keys, numbers, strict=True)))
    return records


def _add_tables(suite: Suite, results: tuple[list[dict[str, Any]], list[str]]) -> None:
    records, suite.warnings = results
    suite.add_rows(records)
    if records:
        note = "Absolute errors of the sideslip angle from 2 s on, moving forward."
        suite.tables = [ResultTable("Recorded drives", _COLUMNS, records, note)]


def _compose_verdict(results: tuple[list[dict[str, Any]], list[str]]) -> str:
    records, absent = results
    if not records:
        return format_verdict("No drive was read: the lines above say where to get each.")
    scored = [record for record in records if record["estimator"] == _NAME]
    median, p95 = (_DEG * float(np.median([r[key] for r in scored])) for key in ("median", "p95"))
    return format_verdict(
        f"{_NAME} errs {median:.2f} deg (95th percentile {p95:.2f}), medians over the drives: "
        f"{len(scored)}.",
        f"Not scored or not there: {len(absent)}; the lines above name each." if absent else "",
    )


STUDY = Study(
    "logs", "How far off is one setting on recorded drives?",
    "`joint` without options, its car from the preset or from vehicle.toml beside the drive.",
    (1, 1),
    _measure, _add_tables, _compose_verdict,
)  # fmt: skip
