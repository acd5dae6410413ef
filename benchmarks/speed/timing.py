"""Side by side: CPU and wall time of contestants in interleaved rounds, in one process, on one
thread."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Contestant:
    """Some work and the number of units (steps, ticks, ...) that one call of it consists of.

    start: called before each round, not timed.
    """

    work: Callable[[], object]
    units: int
    start: Callable[[], object] | None = None


@dataclass
class Taken:
    """Microseconds a unit, round by round: of the processor, and on the wall."""

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    rounds: how many count. seconds: of CPU, the least that a contestant works in each round, by
    whole calls of its work.
    """

    rounds: int
    seconds: float


QUICK = Effort(9, 0.01)
FULL = Effort(25, 0.04)
"""Many short rounds: what the machine does meanwhile falls on all contestants of one round."""


def interleaved(contestants: Mapping[str, Contestant], effort: Effort) -> dict[str, Taken]:
    """Each contestant's time in every round, after one that does not count.

    Whatever else the machine does falls on neighbours alike.
    """
    with one_thread():
        calls = {
            name: _calls(contestant, effort.seconds) for name, contestant in contestants.items()
        }
        taken = {name: Taken() for name in contestants}
        for _ in range(effort.rounds):
            for name, contestant in contestants.items():
                cpu, wall = _timed(contestant, calls[name])
                taken[name].cpu.append(cpu)
                taken[name].wall.append(wall)
    return taken


def _timed(contestant: Contestant, calls: int) -> tuple[float, float]:
    """(CPU, wall) microseconds a unit of some calls of the work."""
    if contestant.start is not None:
        contestant.start()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
        contestant.work()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    scale = 1e6 / (calls * contestant.units)
    return cpu * scale, wall * scale


def _calls(contestant: Contestant, seconds: float) -> int:
    """How many calls take so many seconds, by the second call: the first may compile."""
    _timed(contestant, 1)
    once = _timed(contestant, 1)[0] * contestant.units * 1e-6
    return max(1, round(seconds / max(once, 1e-9)))


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra keeps to one thread, where threadpoolctl is installed."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        yield
        return
    with threadpool_limits(1):
        yield


def spread(values: list[float]) -> tuple[float, float, float]:
    """(median, least, largest)."""
    return statistics.median(values), min(values), max(values)


def ratios(values: list[float], of: list[float]) -> list[float]:
    """values / of, round by round."""
    return [value / other for value, other in zip(values, of, strict=True)]
