"""CPU times of workloads that take turns in one process, on one thread, and the table of them."""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate


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

_MAX_SLOW_ROUNDS = 5


class Taken(list[float]):
    """CPU times of rounds (us a unit, or s), or the ratios of two workloads'."""

    @property
    def range(self) -> Estimate:
        """The median, with the smallest and largest number as bounds."""
        return Estimate(statistics.median(self), min(self), max(self))

    @property
    def cells(self) -> tuple[str, str]:
        """The median and range, to three digits, as two cells of a table."""
        middle, low, high = map(format_three_digits, self.range)
        return middle, f"{low} .. {high}"

    def add_row(self, suite: Suite, name: str, metric: str) -> "Taken":
        """Add the median and range as a row of a suite.

        Args:
            suite: Suite that gets the row.
            name: Name of the workload.
            metric: Metric of the row.
        """
        columns = {"salt": "", "env_version": "", "scenario": name}
        suite.add_rows([{metric: self.range}], n=len(self), **columns)
        return self


def measure_interleaved(workloads: Mapping[str, Workload], effort: Effort) -> dict[str, Taken]:
    """Measure CPU time a unit (us) of each round by name, workloads in turn, after a first round.

    Args:
        workloads: Workloads by name.
        effort: Rounds and time of each.
    """
    with limit_threads():
        calls = {name: _count_calls(x, effort.seconds) for name, x in workloads.items()}
        taken = {name: Taken() for name in workloads}
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
    return max(1, math.ceil(seconds / max(once, 1e-9)))


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


class AbsentError(Exception):
    """A workload cannot be made; the message says why."""


@dataclass
class WorkloadSet:
    """Workloads of a table by name, and the reasons why others are absent."""

    title: str  # title of the table
    unit: str  # unit of the workloads, "step" or "tick"
    note: str  # note of the table
    is_slow: bool = False  # whether few rounds suffice
    workloads: dict[str, Workload] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, make: Callable[[], Workload], package: str | None = None) -> None:
        """Add a workload, or why it is absent.

        Args:
            name: Name of the workload.
            make: Function that makes it, or raises `AbsentError`.
            package: Optional package that it needs, None for none.
        """
        try:
            self.workloads[name] = make()
        except AbsentError as error:
            self.absent[name] = str(error)
        except ModuleNotFoundError:
            if package is None:
                raise
            self.absent[name] = f"{package} is not installed"

    def measure(self, suite: Suite, effort: Effort) -> dict[str, Taken]:
        """Measure CPU time a unit (us) of each round by name, and add rows and a table to a suite.

        Args:
            suite: Suite that gets the results.
            effort: Rounds and time of each.
        """
        if self.is_slow:
            effort = replace(effort, rounds=max(1, min(effort.rounds // 2, _MAX_SLOW_ROUNDS)))
        taken, cells = measure_interleaved(self.workloads, effort), []
        for name, values in taken.items():
            values.add_row(suite, name, f"us_per_{self.unit}")
            rate = f"{float(f'{1e6 / values.range.value:.3g}'):,.0f}"
            cells.append([name, *values.cells, rate])
        if cells:
            header = ("", f"us per {self.unit}", "range", "per CPU-s")
            text = self.note + format_absences(self.absent)
            suite.tables.append(ResultTable(self.title, header, cells, text, keyed=False))
        return taken


def format_absences(absent: Mapping[str, str]) -> str:
    """Format a sentence on the absent workloads, "" without any.

    Args:
        absent: Reasons by name.
    """
    if not absent:
        return ""
    return f" Not measured: {'; '.join(f'{name} ({reason})' for name, reason in absent.items())}."


def format_three_digits(value: float) -> str:
    """Format a number to three digits, without an exponent.

    Args:
        value: Number to format.

    >>> format_three_digits(0.04431), format_three_digits(7.2), format_three_digits(1004.0)
    ('0.0443', '7.2', '1000')
    """
    return f"{float(f'{value:.3g}'):g}"
