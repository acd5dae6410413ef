"""The row: one measured number with everything needed to reproduce it."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...envs.io import atomic_file, write_atomic
from ...envs.io import from_json as from_json
from ...envs.record import Array
from ...envs.validation import check_choice
from .metrics import METRICS
from .stats import Estimate
from .study import Explorer

if TYPE_CHECKING:
    from pandas import DataFrame

VERDICTS = ("", "reproduced", "partly", "not reproduced", "report only")


@dataclass(frozen=True)
class ResultRow:
    """One number of a benchmark.

    For a claim, which has a verdict, and a replay, value and bounds are median and range over n
    seeds.

    Attributes:
        suite: Name of the suite.
        scenario: Name of the scenario.
        metric: Name of the metric, in `METRICS`.
        value: Number in the metric's unit.
        estimator: Name of the estimator.
        controller: Name of the controller.
        low: Lower bound of the 95 % interval, NaN without one.
        high: Upper bound of the 95 % interval, NaN without one.
        n: Number of runs.
        salt: Salt of the seeds.
        env_version: Version of the env.
        spec: JSON of the env, "" where no env was run.
        verdict: Verdict on a claim, in `VERDICTS`.
        paper: Paper of a claim.

    Raises:
        ValueError: The metric or verdict is outside of the vocabulary.
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
        """Make a row of a number with its interval.

        Args:
            metric: Name of the metric.
            number: Number and interval.
            columns: Other fields.

        Returns:
            Row of the metric.
        """
        return cls(metric=metric, value=number.value, low=number.low, high=number.high, **columns)


@dataclass
class ResultTable:
    """A table for the screen and the report.

    Attributes:
        title: Title of the table.
        header: Headings of the columns.
        cells: Texts, row by row.
        note: Meaning of the columns.
        keyed: Whether the first column names estimators or controllers, which have their colour.
        detail: Whether it stands in the report alone, too long for a screen.
    """

    title: str
    header: Sequence[str]
    cells: Sequence[Sequence[str]]
    note: str = ""
    keyed: bool = True
    detail: bool = False

    def to_pandas(self) -> "DataFrame":
        """Convert the texts to a pandas table (needs the extra `report`)."""
        from pandas import DataFrame

        return DataFrame(self.cells, columns=list(self.header))

    def _repr_html_(self) -> str:
        """Format the table for a notebook."""
        table = self.to_pandas().to_html(index=False, border=0)
        return f"<b>{escape(self.title)}</b>{table}<p>{escape(self.note)}</p>"


@dataclass(frozen=True)
class ShareMap:
    """Fractions between 0 and 1 over two axes.

    Attributes:
        title: Title of the map.
        x: Values of the horizontal axis.
        y: Values of the vertical axis.
        shares: Fractions by name, each of shape (y, x).
        x_label: Label of the horizontal axis.
        y_label: Label of the vertical axis.
    """

    title: str
    x: Array
    y: Array
    shares: Mapping[str, Array]
    x_label: str
    y_label: str


@dataclass
class Suite:
    """The result of a benchmark module: rows for machines, tables and figures for people.

    `answers` and `figures` are empty without the extra `report` or where pictures were not
    requested.

    Attributes:
        name: Name of the suite.
        title: Title of the suite.
        text: Text of the report.
        rows: Rows of all numbers.
        tables: Tables of the report.
        figures: Title, plotly figure, and what to see in it.
        explorers: Figures with menus.
        maps: Maps for the summary's PNG.
        files: Files that the report offers: name, media type, text.
        verdict: Answer in plain words, at most five lines (`harness.verdict`).
        warnings: Warnings about the input, which stand above the verdict.
        answers: Question, plotly figure, and the answer in a sentence.
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
        """Warnings and verdict, line by line."""
        ended = (text if text.endswith("?") else f"{text}." for text in self.warnings)
        return [*(f"WARNING: {text}" for text in ended), *self.verdict.splitlines()]

    def to_pandas(self) -> "DataFrame":
        """Convert the rows to a pandas table (needs the extra `report`)."""
        from pandas import DataFrame

        return DataFrame([asdict(row) for row in self.rows])

    def _repr_html_(self) -> str:
        """Format the verdict and the first table for a notebook."""
        lines = "".join(f"<p>{escape(line)}</p>" for line in self.headlines)
        return f"<h3>{escape(self.title)}</h3>{lines}" + "".join(
            table._repr_html_() for table in self.tables[:1]
        )


def check_writable(*paths: Path | None) -> None:
    """Check that results can be written, before the work.

    Args:
        paths: Files to write; None is skipped.

    Raises:
        OSError: A file cannot be written.
    """
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
    """Write a text file or nothing.

    Args:
        path: File to write.
        text: Content of the file.
    """
    write_atomic(path, text.encode())


def write_json(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write rows as a JSON list of objects; NaN becomes null.

    Args:
        path: File to write.
        rows: Rows.
    """
    plain = [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(row).items()
        }
        for row in rows
    ]
    write_text(path, json.dumps(plain, indent=1) + "\n")


def read_json(path: str | Path) -> list[ResultRow]:
    """Read rows that `write_json` wrote.

    Args:
        path: File to read.

    Returns:
        Rows in order.

    Raises:
        ValueError: The file holds others; the message has file, row and column.
    """
    rows = []
    for i, entry in enumerate(read_objects(path), 1):
        numbers = {name: math.nan if value is None else value for name, value in entry.items()}
        rows.append(from_json(ResultRow, numbers, f"{path}: row {i}"))
    return rows


def read_objects(path: str | Path) -> list[dict[str, Any]]:
    """Read a JSON list of objects.

    Args:
        path: File to read.

    Returns:
        Objects in order.

    Raises:
        ValueError: The file holds something else; the message has the path.
    """
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON, or is cut short: {error}") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"{path}: expected a JSON list of objects")
    return entries


def write_parquet(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write rows as a Parquet table (needs the extra `report`).

    Args:
        path: File to write.
        rows: Rows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with atomic_file(path) as file:
        pq.write_table(pa.Table.from_pylist([asdict(row) for row in rows]), file)
