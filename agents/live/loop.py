"""The loop: a tick every millisecond of the monotonic clock, and what it missed."""

import gc
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .assemble import Arrival, Assembler, Tick
from .datagrams import STAMP, Bad, Kind, Status
from .onboard import Onboard
from .port import Port, clock
from .session import Recorder

PERIOD = 1_000_000  # ns
LEAD = 100_000  # ns from a fast row's arrival to the deadline that follows it
PULL, MOST_PULL = 0.02, 5_000  # of the distance from that, ns a tick: two clocks drift apart
SUSPENDED = 1_000_000_000  # ns; who comes this late was not merely busy
STATUS_EVERY = 100  # ticks
IDLE = 0.1  # s
_TOP = 100_000  # us


class Histogram:
    """Times in us of any number of ticks, counted by whole ones; the newest and the largest."""

    def __init__(self) -> None:
        self.counts, self.number = [0] * (_TOP + 1), 0
        self.newest = self.most = 0.0

    def add(self, us: float) -> None:
        """Count a time."""
        self.counts[min(max(int(us), 0), _TOP)] += 1
        self.number += 1
        self.newest, self.most = us, max(self.most, us)

    def quantile(self, share: float) -> float:
        """The time that a share of all do not exceed, to 1 us; NaN of none."""
        left = math.ceil(share * self.number)
        for us, count in enumerate(self.counts):
            left -= count
            if count and left <= 0:
                return us + 1.0 if us < _TOP else self.most
        return math.nan

    def summary(self) -> dict[str, float]:
        """Median, 99.9 % and the largest."""
        if not self.number:
            return {}
        return {"median": self.quantile(0.5), "p999": self.quantile(0.999), "max": self.most}


COUNTED = ("ticks", "deadlines", "misses", "per_million", "suspensions", "actions", "seconds")
TIMES = ("jitter", "latency", "work")


@dataclass
class Statistics:
    """What a loop measured. Times in us.

    jitter: from a deadline to waking up. latency: from a batch's oldest datagram to the estimates
    sent. work: of a tick. deadlines: all that were due; misses: those that passed before the one
    before was done with, which nothing woke for.
    suspensions: of more than a second. ticks: of the estimator. seconds: that it ran.
    """

    jitter: Histogram = field(default_factory=Histogram)
    latency: Histogram = field(default_factory=Histogram)
    work: Histogram = field(default_factory=Histogram)
    deadlines: int = 0
    misses: int = 0
    suspensions: int = 0
    ticks: int = 0
    actions: int = 0
    seconds: float = 0.0

    @property
    def per_million(self) -> float:
        """Misses per million deadlines."""
        return 1e6 * self.misses / max(self.deadlines, 1)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count)


@dataclass
class Loop:
    """An Onboard on a port.

    targets: addresses that get every estimate; viewer: one that gets every tenth and the status.
    step: in the time of the stamps instead of that of the clock: whatever comes is computed at
    once. recorder: writes the session. watch: is called after each tick. patience: s without a
    fast row, after which `run` ends, with TimeoutError if there was none at all. `ended`: why.
    """

    onboard: Onboard
    assembler: Assembler
    port: Port
    targets: Sequence[Any] = ()
    viewer: Any = None
    step: bool = False
    recorder: Recorder | None = None
    watch: Callable[[Tick], None] | None = None
    patience: float = 30.0
    statistics: Statistics = field(default_factory=Statistics)
    ended: str = ""

    def run(self, stop: Callable[[], bool] = lambda: False, duration: float = math.inf) -> None:
        """Take what comes until the drive is over, `stop` or `duration` s; `ended` has the reason.

        Raises TimeoutError where no inertial data comes at all.
        """
        begun = heard = time.monotonic()
        was = gc.isenabled()
        gc.disable()  # a collection takes hundreds of ms
        deadline: int | None = None
        try:
            while not self._over(stop, begun + duration):
                if deadline is None or self.step:
                    batch = self.port.wait(IDLE)
                    if self._take(batch) and not self.step:
                        deadline = clock() + PERIOD
                else:
                    deadline = self._tick(deadline)
                if not self.assembler.silent:
                    heard = time.monotonic()
                elif time.monotonic() - heard > self.patience:
                    self._silence()
                    break
        finally:
            if was:
                gc.enable()
            self.statistics.seconds = time.monotonic() - begun

    def _over(self, stop: Callable[[], bool], end: float) -> bool:
        reasons = {
            "the drive is over": self.assembler.over,
            "stopped": stop(),
            "the time is over": time.monotonic() > end,
        }
        self.ended = next((reason for reason, true in reasons.items() if true), "")
        return bool(self.ended)

    def _silence(self) -> None:
        host, port = self.port.address
        if not self.statistics.ticks:
            raise TimeoutError(
                f"no inertial datagram came to {host}:{port} within {self.patience:g} s"
            )
        self.ended = f"no inertial data for {self.patience:g} s"

    def _tick(self, deadline: int) -> int:
        """Wait for a deadline and take what came; the next one."""
        batch, measured = self.port.until(deadline), self.statistics
        woke = clock()
        rows = self._take(batch)
        done = clock()
        measured.deadlines += 1
        measured.jitter.add((woke - deadline) * 1e-3)
        measured.work.add((done - woke) * 1e-3)
        if rows and batch:
            measured.latency.add((done - batch[0].at) * 1e-3)
        if rows == 1 and batch:
            away = PULL * (batch[-1].at + LEAD - deadline)
            deadline += round(min(max(away, -MOST_PULL), MOST_PULL))
        deadline += PERIOD
        if done > deadline:
            missed = (done - deadline) // PERIOD + 1
            measured.misses += missed
            measured.deadlines += missed
            measured.suspensions += missed * PERIOD > SUSPENDED
            deadline += missed * PERIOD
        return deadline

    def _take(self, batch: list[Arrival]) -> int:
        """The ticks of a batch: estimates and controls are sent; how many there were."""
        onboard, measured, ticks = self.onboard, self.statistics, 0
        for tick in self.assembler.take(batch):
            onboard.take(tick)
            ticks += 1
            measured.ticks += 1
            self._send(tick)
            if self.recorder is not None:
                self.recorder.note(onboard)
            if self.watch is not None:
                self.watch(tick)
        if self.recorder is not None:
            self.recorder.take(self.assembler.accepted)
        return ticks

    def _send(self, tick: Tick) -> None:
        onboard, stamp = self.onboard, tick.number * STAMP
        if onboard.fresh and onboard.action is not None and self.assembler.sender is not None:
            self.statistics.actions += 1
            moment = float(onboard.action[0]) * onboard.facts.full_scale
            turn = float(onboard.action[1]) if len(onboard.action) > 1 else 0.0
            control = moment, turn * onboard.facts.authority
            self.port.send(self.assembler.sender, Kind.CONTROL, stamp, control)
        everyone = [*self.targets, self.viewer] if tick.number % 10 == 0 else self.targets
        for target in filter(None, everyone):
            values = (*onboard.x.tolist(), *onboard.std.tolist())
            self.port.send(target, Kind.ESTIMATE, stamp, values, onboard.names)
        if self.viewer is not None and tick.number % STATUS_EVERY == 0:
            self.port.send(self.viewer, Kind.STATUS, stamp, self.status())

    def status(self) -> Status:
        """What the loop has counted so far."""
        measured, counts = self.statistics, self.assembler.counts
        bad = sum(counts[each] for each in Bad)
        numbers = measured.ticks, measured.misses, counts["held"], bad, counts["lost"]
        times = measured.jitter.newest, measured.latency.newest, measured.work.newest
        return Status._make(map(float, (*numbers, *times)))

    def numbers(self) -> dict[str, Any]:
        """All that was measured, as JSON takes it."""
        measured = self.statistics
        times = {f"{name}_us": getattr(measured, name).summary() for name in TIMES}
        counts = {"counts": dict(self.assembler.counts), "refused": self.onboard.refused}
        return {name: getattr(measured, name) for name in COUNTED} | times | counts

    def lines(self, name: str) -> list[str]:
        """The beginning of a verdict on the loop of an estimator of that name."""
        m, counts = self.statistics, self.assembler.counts
        ended = f"{name}: {m.ticks} ticks in {m.seconds:.1f} s, {self.ended}"
        ignored, refused = map(_listed, (counts, self.onboard.refused))
        by = f"; packets that the estimator refused: {refused}" if refused else ""
        lines = [f"{ended}.", f"Ignored or bridged: {ignored or 'nothing'}{by}."]
        if m.deadlines:
            jitter, latency = (
                f"median {t['median']:.0f}, 99.9 % {t['p999']:.0f}, most {t['max']:.0f} us"
                for t in (m.jitter.summary(), m.latency.summary())
            )
            missed = f"{m.misses} of {m.deadlines} deadlines missed"
            lines[0] = f"{ended}; {missed}, {m.per_million:.0f} per million."
            lines[1:1] = [f"Jitter {jitter}; packet to estimate {latency}."]
        return lines
