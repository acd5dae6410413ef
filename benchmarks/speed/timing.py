"""CPU time of contestants side by side: interleaved rounds in one process, on one thread."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass


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
