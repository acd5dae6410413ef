"""CPU time of contestants side by side: interleaved rounds in one process, on one thread.

The contestants of one comparison, those that could not come, and the table of their costs.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from ..harness.results import ResultRow, ResultTable, Suite


@dataclass(frozen=True)
class Workload:
    """Some work and the number of units (steps, ticks, ...) that one call of it consists of.

    start: called before each round, not timed.
    """

    work: Callable[[], object]
    units: int
    start: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Effort:
    """How long to measure: rounds that count, and the CPU seconds that a contestant works at least
    in each of them, by whole calls of its work."""

    rounds: int
    seconds: float


QUICK = Effort(9, 0.01)
FULL = Effort(25, 0.04)
"""Many short rounds: what the machine does meanwhile falls on all contestants of one round."""

Taken = list[float]
"""CPU microseconds a unit, round by round."""


def measure_interleaved(workloads: Mapping[str, Workload], effort: Effort) -> dict[str, Taken]:
    """Each contestant's time in every round, after one that does not count."""
    with limit_threads():
        calls = {
            name: _count_calls(workload, effort.seconds) for name, workload in workloads.items()
        }
        taken: dict[str, Taken] = {name: [] for name in workloads}
        for _ in range(effort.rounds):
            for name, workload in workloads.items():
                taken[name].append(_measure_calls(workload, calls[name]))
    return taken


def _measure_calls(workload: Workload, calls: int) -> float:
    """CPU microseconds a unit of some calls of the work."""
    workload.start()
    start = time.process_time()
    for _ in range(calls):
        workload.work()
    return 1e6 * (time.process_time() - start) / (calls * workload.units)


def _count_calls(workload: Workload, seconds: float) -> int:
    """How many calls take so many seconds, by the second call: the first may compile."""
    _measure_calls(workload, 1)
    once = _measure_calls(workload, 1) * workload.units * 1e-6
    return max(1, round(seconds / max(once, 1e-9)))


@contextmanager
def limit_threads() -> Iterator[None]:
    """Linear algebra and torch on one thread, where threadpoolctl is installed."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        yield
        return
    with threadpool_limits(1):
        yield


def compute_range(values: Taken) -> tuple[float, float, float]:
    """(median, least, largest)."""
    return statistics.median(values), min(values), max(values)


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
