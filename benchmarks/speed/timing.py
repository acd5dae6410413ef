"""CPU time of contestants side by side: interleaved rounds in one process, on one thread."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Contestant:
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


def interleaved(contestants: Mapping[str, Contestant], effort: Effort) -> dict[str, Taken]:
    """Each contestant's time in every round, after one that does not count."""
    with one_thread():
        calls = {name: _calls(each, effort.seconds) for name, each in contestants.items()}
        taken: dict[str, Taken] = {name: [] for name in contestants}
        for _ in range(effort.rounds):
            for name, each in contestants.items():
                taken[name].append(_timed(each, calls[name]))
    return taken


def _timed(contestant: Contestant, calls: int) -> float:
    """CPU microseconds a unit of some calls of the work."""
    contestant.start()
    start = time.process_time()
    for _ in range(calls):
        contestant.work()
    return 1e6 * (time.process_time() - start) / (calls * contestant.units)


def _calls(contestant: Contestant, seconds: float) -> int:
    """How many calls take so many seconds, by the second call: the first may compile."""
    _timed(contestant, 1)
    once = _timed(contestant, 1) * contestant.units * 1e-6
    return max(1, round(seconds / max(once, 1e-9)))


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra and torch on one thread, where threadpoolctl is installed."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        yield
        return
    with threadpool_limits(1):
        yield


def spread(values: Taken) -> tuple[float, float, float]:
    """(median, least, largest)."""
    return statistics.median(values), min(values), max(values)
