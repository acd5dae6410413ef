"""CPU times of workloads that take turns in one process, on one thread, and the table of them."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate
from ..report.study import add_rows


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
Taken = list[float]
"""CPU microseconds a unit, round by round."""


def measure_interleaved(workloads: Mapping[str, Workload], effort: Effort) -> dict[str, Taken]:
    """Measure the CPU time a unit of workloads, round by round, after a first round.

    Args:
        workloads: Workloads by name.
        effort: Rounds and time of each.

    Returns:
        CPU time a unit (us) in each round, by name.
    """
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


def compute_range(values: Taken) -> Estimate:
    """Compute the median and range of rounds.

    Args:
        values: A number of each round.

    Returns:
        Median, with smallest and largest number as bounds.
    """
    return Estimate(statistics.median(values), min(values), max(values))


class AbsentError(Exception):
    """A workload cannot be made; the message says why."""


@dataclass
class WorkloadSet:
    """Workloads of a table by name, and the reasons why others are absent."""

    title: str  # title of the table
    unit: str  # unit of the workloads, "step" or "tick"
    note: str  # note of the table
    is_slow: bool = False  # whether few rounds have to do
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
        """Measure all, and add rows and a table to a suite.

        Args:
            suite: Suite that gets the results.
            effort: Rounds and time of each.

        Returns:
            CPU time a unit (us) in each round, by name.
        """
        if self.is_slow:
            effort = replace(effort, rounds=max(1, min(effort.rounds // 2, _MAX_SLOW_ROUNDS)))
        taken, cells = measure_interleaved(self.workloads, effort), []
        for name, values in taken.items():
            number = add_row(suite, name, f"us_per_{self.unit}", values)
            rate = f"{float(f'{1e6 / number.value:.3g}'):,.0f}"
            cells.append([name, *format_range(number), rate])
        if cells:
            header = ("", f"us per {self.unit}", "range", "per CPU-s")
            text = self.note + format_absences(self.absent)
            suite.tables.append(ResultTable(self.title, header, cells, text, keyed=False))
        return taken


def add_row(suite: Suite, name: str, metric: str, values: Taken) -> Estimate:
    """Add the median and range of rounds as a row of a suite.

    Args:
        suite: Suite that gets the results.
        name: Name of the workload.
        metric: Metric of the row.
        values: A number of each round.

    Returns:
        Median with its range.
    """
    number = compute_range(values)
    columns = {"salt": "", "env_version": "", "scenario": name}
    add_rows(suite, {metric: number}, n=len(values), **columns)
    return number


def format_absences(absent: Mapping[str, str]) -> str:
    """Format a sentence on the absent workloads.

    Args:
        absent: Reasons by name.

    Returns:
        Sentence, "" without any.
    """
    if not absent:
        return ""
    return f" Not measured: {'; '.join(f'{name} ({reason})' for name, reason in absent.items())}."


def format_range(number: Estimate) -> tuple[str, str]:
    """Format a median and its range, to three digits, as two cells of a table.

    Args:
        number: Median with its range.

    Returns:
        Both texts.
    """
    middle, low, high = map(format_three_digits, number)
    return middle, f"{low} .. {high}"


def format_three_digits(value: float) -> str:
    """Format a number to three digits, without an exponent.

    Args:
        value: Number to format.

    Returns:
        Text.

    >>> format_three_digits(0.04431), format_three_digits(7.2), format_three_digits(1004.0)
    ('0.0443', '7.2', '1000')
    """
    return f"{float(f'{value:.3g}'):g}"
