"""The row: one measured number with everything needed to find it again."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...envs.arguments import check_choice
from ...envs.backend.files import atomic_file, write_atomic
from ...envs.documents import from_json as from_json
from ...envs.record import Array
from .explorer import Explorer
from .metrics import METRICS
from .stats import Estimate

if TYPE_CHECKING:
    from pandas import DataFrame

VERDICTS = ("", "reproduced", "partly", "not reproduced", "report only")


@dataclass(frozen=True)
class ResultRow:
    """One number of a benchmark.

    suite, scenario, estimator, controller, metric: what was measured. value with its 95 % interval
    [low, high] over n runs (NaN bounds where there is none); for a claim, which has a verdict, and
    a replay the median and range over n seeds. salt: what salted the seeds.
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
        check_choice("metric", self.metric, METRICS)
        check_choice("verdict", self.verdict, VERDICTS)

    @classmethod
    def from_estimate(cls, metric: str, number: Estimate, **columns: Any) -> "ResultRow":
        """A row of a number with its interval; columns: the others."""
        return cls(metric=metric, value=number.value, low=number.low, high=number.high, **columns)


@dataclass
class ResultTable:
    """A table for the screen and the report: texts, a header, and what each column means.

    keyed: whether the first column names estimators or controllers, which have their colour.
    detail: whether it stands in the report alone, too long for a screen.
    """

    title: str
    header: Sequence[str]
    cells: Sequence[Sequence[str]]
    note: str = ""
    keyed: bool = True
    detail: bool = False

    def to_pandas(self) -> "DataFrame":
        """The texts as a pandas table (needs the extra `report`)."""
        from pandas import DataFrame

        return DataFrame(self.cells, columns=list(self.header))

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        table = self.to_pandas().to_html(index=False, border=0)
        return f"<b>{escape(self.title)}</b>{table}<p>{escape(self.note)}</p>"


@dataclass(frozen=True)
class ShareMap:
    """Shares between 0 and 1 over two axes: shares by name, each (y, x)."""

    title: str
    x: Array
    y: Array
    shares: Mapping[str, Array]
    x_label: str
    y_label: str


@dataclass
class Suite:
    """The result of a benchmark module: rows for machines, tables and figures for people.

    verdict: the answer in plain words, at most five lines (`harness.verdict`). warnings: of the
    input, that stand over it. answers: figures that answer a question each: (question, plotly
    figure, the answer in a sentence). figures: the others, (title, figure, what to see). Both are
    empty where the extra `report` is not installed or pictures were not asked for. explorers:
    figures with menus. maps: for the summary's PNG. files: what the report offers to save, (file
    name, media type, text).
    """

    name: str
    title: str
    text: str
    rows: list[ResultRow] = field(default_factory=list)
    tables: list[ResultTable] = field(default_factory=list)
    figures: list[tuple[str, Any, str]] = field(default_factory=list)
    explorers: list[Explorer] = field(default_factory=list)
    maps: list[ShareMap] = field(default_factory=list)
    files: list[tuple[str, str, str]] = field(default_factory=list)
    verdict: str = ""
    warnings: list[str] = field(default_factory=list)
    answers: list[tuple[str, Any, str]] = field(default_factory=list)

    @property
    def headlines(self) -> list[str]:
        """The warnings and the verdict, line by line."""
        ended = (text if text.endswith("?") else f"{text}." for text in self.warnings)
        return [*(f"WARNING: {text}" for text in ended), *self.verdict.splitlines()]

    def to_pandas(self) -> "DataFrame":
        """The rows as a pandas table (needs the extra `report`)."""
        from pandas import DataFrame

        return DataFrame([asdict(row) for row in self.rows])

    def _repr_html_(self) -> str:
        """What a notebook shows: the verdict and the first table."""
        lines = "".join(f"<p>{escape(line)}</p>" for line in self.headlines)
        return f"<h3>{escape(self.title)}</h3>{lines}" + "".join(
            table._repr_html_() for table in self.tables[:1]
        )


def check_writable(*paths: Path | None) -> None:
    """OSError before the work, not after it, where a result cannot be written."""
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
    """Write a text file or nothing."""
    write_atomic(path, text.encode())


def write_json(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """The rows as a JSON list of objects; NaN becomes null."""
    plain = [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(row).items()
        }
        for row in rows
    ]
    write_text(path, json.dumps(plain, indent=1) + "\n")


def read_json(path: str | Path) -> list[ResultRow]:
    """Rows that `write_json` wrote; ValueError, with file, row and column, for others."""
    rows = []
    for i, entry in enumerate(read_objects(path), 1):
        numbers = {name: math.nan if value is None else value for name, value in entry.items()}
        rows.append(from_json(ResultRow, numbers, f"{path}: row {i}"))
    return rows


def read_objects(path: str | Path) -> list[dict[str, Any]]:
    """A file's JSON list of objects; ValueError, with the path, for another file."""
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON, or is cut short: {error}") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: expected a JSON list of objects")
    return entries


def write_parquet(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """The rows as a Parquet table (needs the extra `report`)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with atomic_file(path) as file:
        pq.write_table(pa.Table.from_pylist([asdict(row) for row in rows]), file)
