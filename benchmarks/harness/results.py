"""Results of suites: rows for machines, tables and explorers for people, and the files of rows.

Args:
    path: File.
    paths: Files, None for none.
    text: Content of a file.
    rows: Rows of a run's suites.
"""

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import __version__
from ...envs.io import atomic_file, from_json, write_atomic
from ...envs.record import Array
from ...envs.validation import check_choice
from .metrics import METRICS
from .stats import Estimate

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

VERDICTS = ("", "reproduced", "partly", "not reproduced", "report only")


@dataclass(frozen=True)
class ResultRow:
    """One number of a benchmark, ValueError for a metric or verdict outside of the vocabulary.

    Value and bounds of a claim, which has a verdict, and of a replay are median and range.
    """

    suite: str
    scenario: str
    metric: str  # name of the metric, in `METRICS`
    value: float  # number in the metric's unit
    estimator: str = ""
    controller: str = ""
    low: float = math.nan  # lower bound of the 95 % interval, NaN without one
    high: float = math.nan  # upper bound of the 95 % interval, NaN without one
    n: int = 1  # number of runs
    salt: str = ""
    env_version: str = ""
    spec: str = ""  # JSON of the env, "" where no env was run
    verdict: str = ""  # verdict on a claim, in `VERDICTS`
    paper: str = ""

    def __post_init__(self) -> None:
        check_choice("metric", self.metric, METRICS)
        check_choice("verdict", self.verdict, VERDICTS)


_COLUMNS = {item.name for item in fields(ResultRow)} - {"suite", "metric", "value", "low", "high"}

Cell = Any  # a text, a number, an `Estimate`, several numbers of one template, or nothing (NaN too)
Line = Mapping[str, Cell]  # cells of a line by key, of which metrics become rows


@dataclass(frozen=True)
class Column:
    """A column of a table, and how `report` formats its numbers."""

    key: str  # key of the column's cells in a record
    heading: str = ""  # quantity and unit, "" for the key
    scale: float = 1.0  # factor of the numbers
    form: str = "g"  # format of each number, or template of several: "{:.3g} ({:.3g})"
    interval: bool = True  # whether intervals are shown


HONESTY = (
    Column("nees", "NEES", form=".2f", interval=False),
    Column("coverage", "in 95 %", 100.0, ".0f", interval=False),
    Column("log_score", "log score", form=".2f", interval=False),
)
"""Whether a filter's deviations are honest, by `stats.compute_honesty`."""


@dataclass
class ResultTable:
    """A table for the screen and the report."""

    title: str
    columns: Sequence[object]  # each a `Column`, or the heading of one of texts
    cells: Sequence[Any]  # lines: cells by the columns' keys, or in the columns' order
    note: str = ""  # meaning of the columns
    keyed: bool = True  # the first column names estimators or controllers, shown in colour
    detail: bool = False  # it stands in the report alone, too long for a screen
    opened: bool = False  # the report shows it unfolded


@dataclass
class Explorer:
    """Time series of which two are shown beside each other."""

    title: str
    menus: Sequence[str]  # labels of the parts of a cell's key but the last one, which is the entry
    # signals (n,) by key, with time "t" (s); with X, Y (m) and psi (rad) a cell is shown in motion
    cells: Mapping[tuple[str, ...], Mapping[str, Array]]
    # plots above each other by quantity and unit: signals and legend, the entry's colour first
    panels: Mapping[str, Sequence[tuple[str, str]]]
    caption: str = ""  # caption, a sentence
    pair: tuple[str, str] = ("", "")  # the two entries at the start
    # length and width of the car (m) by the shared part of the key
    bodies: Mapping[tuple[str, ...], tuple[float, float]] = field(default_factory=dict)


@dataclass
class Suite:
    """The result of a benchmark: rows for machines, tables and figures for people.

    `answers` and `figures` are empty without the extra `report`, and where no pictures are wanted.
    """

    name: str
    title: str
    text: str
    rows: list[ResultRow] = field(default_factory=list)
    tables: list[ResultTable] = field(default_factory=list)
    figures: list[tuple[str, "Figure", str]] = field(default_factory=list)  # title, plotly, caption
    explorers: list[Explorer] = field(default_factory=list)  # figures with menus
    verdict: str = ""  # answer in plain words, at most five lines
    warnings: list[str] = field(default_factory=list)  # about the input, above the verdict
    answers: list[tuple[str, "Figure", str]] = field(default_factory=list)  # question, plotly, text

    @property
    def headlines(self) -> list[str]:
        """Warnings and verdict, line by line."""
        ended = (text if text.endswith("?") else f"{text}." for text in self.warnings)
        return [*(f"WARNING: {text}" for text in ended), *self.verdict.splitlines()]

    def add_rows(self, records: Iterable[Line], env_id: str = "", **common: str | int) -> None:
        """Add a row of each metric of records, on fixed seeds unless `salt` says otherwise.

        A number that is not finite has no row; keys that are no metrics and no columns of
        `ResultRow` are for tables alone.

        Args:
            records: Columns of rows, and numbers by metric.
            env_id: Id of the env, "" where rows have the package's version alone.
            **common: Columns that all rows share.
        """
        shared = {"salt": "fixed", "env_version": f"{env_id} {__version__}".lstrip()} | common
        for record in records:
            columns: dict[str, Any] = shared | {k: v for k, v in record.items() if k in _COLUMNS}
            for metric, cell in record.items():
                if metric not in METRICS or cell is None or isinstance(cell, str):
                    continue
                number = Estimate(*cell) if isinstance(cell, tuple) else Estimate(float(cell))
                if math.isfinite(number.value):
                    columns |= number._asdict() | {"suite": self.name, "metric": metric}
                    self.rows.append(ResultRow(**columns))


def check_writable(*paths: Path | None) -> None:
    """Check before the work that files can be written; OSError otherwise."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise IsADirectoryError(f"cannot write {path}: it is a folder")
        folder = Path(os.path.realpath(path)).parent
        if path.exists() and not path.is_file():  # a pipe or a device, which is not replaced
            folder = path
        if not folder.exists():
            raise FileNotFoundError(f"cannot write {path}: there is no such folder")
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"cannot write {path}: it, or its folder, is read-only")


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_atomic(path, text.encode())


def write_json(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write rows as a JSON list of objects, one a line; NaN becomes null."""
    plain = [asdict(row) for row in rows]
    for row in plain:
        row |= {x: None for x in ("value", "low", "high") if not math.isfinite(row[x])}
    write_text(path, "[\n" + ",\n".join(map(json.dumps, plain)) + "\n]\n")


def read_json(path: str | Path) -> list[ResultRow]:
    """Read rows of `write_json`; ValueError with file, row and column where there are none."""
    rows = []
    for i, entry in enumerate(read_objects(path), 1):
        numbers = {name: math.nan if value is None else value for name, value in entry.items()}
        rows.append(from_json(ResultRow, numbers, f"{path}: row {i}"))
    return rows


def read_objects(path: str | Path) -> list[dict[str, Any]]:
    """Read a JSON list of objects; ValueError for anything else."""
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON, or is cut short: {error}") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: expected a JSON list of objects")
    return entries


def write_parquet(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write rows as a Parquet table (needs the extra `report`)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with atomic_file(path) as file:  # pandas would write NaN as null
        pq.write_table(pa.Table.from_pylist([asdict(row) for row in rows]), file)
