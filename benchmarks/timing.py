"""Side by side: CPU time of contestants in interleaved rounds, in one process, on one thread."""

import statistics
import time
from collections.abc import Callable, Mapping

ROUNDS = 7

Contestant = Callable[[], float]
"""Does some work and returns the CPU microseconds of one unit of it."""


def microseconds(work: Callable[[], object], units: int) -> float:
    """CPU time of some work over the units it consists of."""
    start = time.process_time()
    work()
    return (time.process_time() - start) / units * 1e6


def interleaved(
    contestants: Mapping[str, Contestant], rounds: int | None = None
) -> dict[str, list[float]]:
    """Each contestant's time in every round (default: `ROUNDS`), after one that does not count.

    Whatever else the machine does falls on neighbours alike. Linear algebra keeps to one thread
    where threadpoolctl is installed.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        limit = None
    else:
        limit = threadpool_limits(1)
    try:
        for contestant in contestants.values():
            contestant()
        taken: dict[str, list[float]] = {name: [] for name in contestants}
        for _ in range(ROUNDS if rounds is None else rounds):
            for name, contestant in contestants.items():
                taken[name].append(contestant())
        return taken
    finally:
        if limit is not None:
            limit.restore_original_limits()


def spread(values: list[float]) -> tuple[float, float, float]:
    """(median, least, largest)."""
    return statistics.median(values), min(values), max(values)


def ratios(values: list[float], of: list[float]) -> list[float]:
    """values / of, round by round."""
    return [value / other for value, other in zip(values, of, strict=True)]
