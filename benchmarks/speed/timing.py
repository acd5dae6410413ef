"""CPU times of workloads that take turns in one process, on one thread, and the table of them."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from ...envs.record import Array
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import compute_range


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

    @property
    def quarter(self) -> "Effort":
        """A quarter of the rounds, three at least, for what is slow."""
        return replace(self, rounds=max(3, self.rounds // 4))


QUICK = Effort(9, 0.01)
FULL = Effort(25, 0.04)
"""Many short rounds: what the machine does meanwhile falls on all workloads of one round."""


def measure_interleaved(workloads: Mapping[str, Workload], effort: Effort) -> dict[str, Array]:
    """Measure CPU time a unit (us) of each round by name, in turn, after a first round."""
    with limit_threads():
        calls = [(x, _count_calls(x, effort.seconds)) for x in workloads.values()]
        rounds = [[_measure_calls(*pair) for pair in calls] for _ in range(effort.rounds)]
    return dict(zip(workloads, np.array(rounds).T, strict=True))


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
    """Something cannot be measured; the message says why."""


@dataclass
class TimeTable:
    """CPU times by name, and the reasons why others are absent."""

    title: str
    metric: str  # metric of its rows
    unit: str  # unit of its numbers
    note: str = ""
    times: dict[str, Array] = field(default_factory=dict)  # shape (rounds,) each
    absent: dict[str, str] = field(default_factory=dict)

    def measure(
        self, workloads: Mapping[str, Callable[[], Workload]], effort: Effort
    ) -> "TimeTable":
        """Measure workloads in turn, but for those that this machine or its packages lack."""
        made = dict[str, Workload]()
        for name, make in workloads.items():
            try:
                made[name] = make()
            except (AbsentError, ModuleNotFoundError) as error:
                if (getattr(error, "name", None) or "").startswith(__package__.partition(".")[0]):
                    raise  # a module of this package is no choice
                self.absent[name] = str(error)
        self.times |= measure_interleaved(made, effort)
        return self

    def add_table(self, suite: Suite) -> None:
        """Add rows and a table to a suite."""
        times = self.times.items()
        records = [{"scenario": x, self.metric: compute_range(y), "n": len(y)} for x, y in times]
        suite.add_rows(records, salt="", env_version="")
        reasons = "; ".join(f"{name} ({reason})" for name, reason in self.absent.items())
        note = self.note + (f" Not measured: {reasons}." if reasons else "")
        columns = Column("scenario", " "), Column(self.metric, f"{self.unit} [range]", form=".3g")
        suite.tables.append(ResultTable(self.title, columns, records, note.lstrip(), keyed=False))
