"""CPU times of workloads that take turns in one process, on one thread, and the table of them."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from ..harness.results import ResultRow, ResultTable, Suite


@dataclass(frozen=True)
class Workload:
    """Work whose call consists of some units (steps, ticks, ...)."""

    work: Callable[[], object]
    units: int
    start: Callable[[], object] = lambda: None  # before each round, not timed


@dataclass(frozen=True)
class Effort:
    """Rounds that count, and the CPU time (s) of each workload in one, by whole calls, at least."""

    rounds: int
    seconds: float


QUICK = Effort(9, 0.01)
FULL = Effort(25, 0.04)
"""Many short rounds: what the machine does meanwhile falls on all workloads of one round."""

Taken = list[float]
"""CPU microseconds a unit, round by round."""


def measure_interleaved(workloads: Mapping[str, Workload], effort: Effort) -> dict[str, Taken]:
    """Measure the CPU us a unit of workloads, round by round, after a first round."""
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
    """Measure the CPU microseconds a unit of some calls."""
    workload.start()
    start = time.process_time()
    for _ in range(calls):
        workload.work()
    return 1e6 * (time.process_time() - start) / (calls * workload.units)


def _count_calls(workload: Workload, seconds: float) -> int:
    """Count the calls that take so many seconds, by the second one: the first may compile."""
    _measure_calls(workload, 1)
    once = _measure_calls(workload, 1) * workload.units * 1e-6
    return max(1, round(seconds / max(once, 1e-9)))


@contextmanager
def limit_threads() -> Iterator[None]:
    """Limit linear algebra and torch to one thread, where threadpoolctl is installed."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        yield
        return
    with threadpool_limits(1):
        yield


def compute_range(values: Taken) -> tuple[float, float, float]:
    """Compute the median, minimum and maximum of some values."""
    return statistics.median(values), min(values), max(values)


class AbsentError(Exception):
    """A workload cannot be made; the message says why."""


@dataclass
class WorkloadSet:
    """Workloads by name, and the reasons why others are absent."""

    workloads: dict[str, Workload] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, make: Callable[[], Workload], package: str | None = None) -> None:
        """Add a workload, or why it is absent: the optional package it needs is not installed."""
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
        """Measure all; add rows and a table in us per "step" or "tick"; times, reasons by name."""
        taken, cells = measure_interleaved(self.workloads, effort), []
        for name, values in taken.items():
            middle, *bounds = add_row(suite, name, f"us_per_{unit}", values)
            cells.append([name, *format_range(middle, *bounds), _format_rate(middle)])
        if cells:
            header = ("", f"us per {unit}", "range", "per CPU-s")
            text = note + format_absences(self.absent)
            suite.tables.append(ResultTable(title, header, cells, text, keyed=False))
        return taken, self.absent


def add_row(suite: Suite, name: str, metric: str, values: Taken) -> tuple[float, float, float]:
    """Add the median and range of rounds as a row of a suite, and return them."""
    middle, low, high = compute_range(values)
    row = ResultRow(suite.name, name, metric, middle, low=low, high=high, n=len(values))
    suite.rows.append(row)
    return middle, low, high


def format_absences(absent: Mapping[str, str]) -> str:
    """Format a sentence on the absent workloads, with reasons by name; "" without any."""
    if not absent:
        return ""
    return f" Not measured: {'; '.join(f'{name} ({reason})' for name, reason in absent.items())}."


def format_range(middle: float, low: float, high: float) -> tuple[str, str]:
    """Format a median and its range, to three digits, as two cells of a table."""
    return format_three_digits(middle), " .. ".join(map(format_three_digits, (low, high)))


def format_three_digits(value: float) -> str:
    """Format a number to three digits, without an exponent.

    >>> format_three_digits(0.04431), format_three_digits(7.2), format_three_digits(1004.0)
    ('0.0443', '7.2', '1000')
    """
    return f"{float(f'{value:.3g}'):g}"


def _format_rate(microseconds: float) -> str:
    """Format the number of units in a second of CPU time, to three digits."""
    return f"{float(f'{1e6 / microseconds:.3g}'):,.0f}"
