"""The row: one measured number with everything needed to find it again."""

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ...envs.backend.files import write_whole
from .explorer import Explorer
from .metrics import METRICS
from .stats import Estimate

VERDICTS = ("", "reproduced", "partly", "not reproduced", "report only")


@dataclass(frozen=True)
class Row:
    """One number of a benchmark.

    suite, scenario, estimator, controller, metric: what was measured. value with its 95 % interval
    [low, high] over n runs (NaN bounds where there is no spread); for a claim, which has a verdict,
    the median and range over n seeds. salt: what salted the seeds.
    spec: the env's JSON, "" where no env was run. verdict and paper: for claims.

    Raises ValueError for a metric or verdict outside the vocabulary.
    """

    suite: str
    scenario: str
    metric: str
    value: float
    estimator: str = ""
    controller: str = ""
    low: float = math.nan
    high: float = math.nan
    n: int = 1
    salt: str = ""
    env_version: str = ""
    spec: str = ""
    verdict: str = ""
    paper: str = ""

    def __post_init__(self) -> None:
        if self.metric not in METRICS:
            raise ValueError(f"unknown metric {self.metric!r}; known: {', '.join(METRICS)}")
        if self.verdict not in VERDICTS:
            raise ValueError(f"unknown verdict {self.verdict!r}")

    @classmethod
    def of(cls, metric: str, number: Estimate, **columns: Any) -> "Row":
        """A row of a number with its interval; columns: the others."""
        return cls(metric=metric, value=number.value, low=number.low, high=number.high, **columns)


@dataclass
class Table:
    """A table for the screen and the report: texts, a header, and what each column means.

    keyed: whether the first column names estimators or controllers, which have their colour.
    """

    title: str
    header: Sequence[str]
    cells: Sequence[Sequence[str]]
    note: str = ""
    keyed: bool = True


@dataclass
class Suite:
    """What a benchmark module gives: rows for machines, tables and figures for people.

    figures: (title, plotly figure, a sentence on what to see). Empty where the extra `report` is
    not installed or pictures were not asked for. explorers: figures with menus. files: what the
    report offers to save, (file name, media type, text).
    """

    name: str
    title: str
    text: str
    rows: list[Row] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: list[tuple[str, Any, str]] = field(default_factory=list)
    explorers: list[Explorer] = field(default_factory=list)
    files: list[tuple[str, str, str]] = field(default_factory=list)


def check_writable(*paths: Path | None) -> None:
    """OSError before the work, not after it, where a result cannot be written."""
    for path in paths:
        if path is None:
            continue
        folder = path.absolute().parent
        if not folder.is_dir():
            raise FileNotFoundError(f"cannot write {path}: there is no such folder")
        if not os.access(folder, os.W_OK):
            raise PermissionError(f"cannot write {path}: its folder is read-only")


def write_text(path: str | Path, text: str) -> None:
    """Write a text file or nothing."""
    write_whole(Path(path), text.encode())


def write_json(path: str | Path, rows: Sequence[Row]) -> None:
    """The rows as a JSON list of objects; NaN becomes null."""
    plain = [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(row).items()
        }
        for row in rows
    ]
    write_text(path, json.dumps(plain, indent=1) + "\n")


def read_json(path: str | Path) -> list[Row]:
    """Rows that `write_json` wrote."""
    names = {entry.name: entry.type for entry in fields(Row)}
    rows = []
    for entry in json.loads(Path(path).read_text(encoding="utf-8")):
        unknown = sorted(set(entry) - set(names))
        if unknown:
            raise ValueError(f"{path}: unknown column {', '.join(unknown)}")
        known: dict[str, Any] = {k: math.nan if v is None else v for k, v in entry.items()}
        rows.append(Row(**known))
    return rows


def write_parquet(path: str | Path, rows: Sequence[Row]) -> None:
    """The rows as a Parquet table (needs the extra `report`)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    part = Path(path).with_name(f".{Path(path).name}.part")
    try:
        pq.write_table(pa.Table.from_pylist([asdict(row) for row in rows]), part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
