"""The contestants of one comparison, those that could not come, and the table of their costs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ..harness.results import ResultRow, ResultTable, Suite
from .timing import Effort, Taken, Workload, compute_range, measure_interleaved


class AbsentError(Exception):
    """A contestant that cannot come; the message says why."""


@dataclass
class WorkloadSet:
    """Contestants by name; `absent`: why others are not among them."""

    workloads: dict[str, Workload] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, make: Callable[[], Workload], package: str | None = None) -> None:
        """Make a contestant; without the optional package that it comes from it is absent."""
        try:
            self.workloads[name] = make()
        except AbsentError as error:
            self.absent[name] = str(error)
        except ModuleNotFoundError:
            if package is None:
                raise
            self.absent[name] = f"{package} is not installed"

    def measure(
        self, suite: Suite, title: str, unit: str, effort: Effort, note: str
    ) -> tuple[dict[str, Taken], dict[str, str]]:
        """Time the contestants, add rows and a table; (times by name, why others are absent).

        unit: "step" or "tick".
        """
        taken, cells = measure_interleaved(self.workloads, effort), []
        for name, values in taken.items():
            middle, *ends = add_row(suite, name, f"us_per_{unit}", values)
            cells.append(
                [
                    name,
                    format_three_digits(middle),
                    " .. ".join(map(format_three_digits, ends)),
                    format_rate(middle),
                ]
            )
        if cells:
            header = ("", f"us per {unit}", "range", "per CPU-s")
            text = note + format_absences(self.absent)
            suite.tables.append(ResultTable(title, header, cells, text, keyed=False))
        return taken, self.absent


def add_row(suite: Suite, name: str, metric: str, values: Taken) -> tuple[float, float, float]:
    """Add a row of a suite; its (median, least, largest)."""
    middle, low, high = compute_range(values)
    suite.rows.append(
        ResultRow(suite.name, name, metric, middle, low=low, high=high, n=len(values))
    )
    return middle, low, high


def format_absences(absent: Mapping[str, str]) -> str:
    """A sentence on those that could not come, or nothing."""
    if not absent:
        return ""
    return f" Not measured: {'; '.join(f'{name} ({reason})' for name, reason in absent.items())}."


def format_three_digits(value: float) -> str:
    """A number to three digits, without an exponent.

    >>> format_three_digits(0.04431), format_three_digits(7.2), format_three_digits(1004.0)
    ('0.0443', '7.2', '1000')
    """
    return f"{float(f'{value:.3g}'):g}"


def format_rate(microseconds: float) -> str:
    """How many in a second, to three digits.

    >>> format_rate(0.0443), format_rate(7.25), format_rate(1210.0)
    ('22,600,000', '138,000', '826')
    """
    return f"{float(f'{1e6 / microseconds:.3g}'):,.0f}"
