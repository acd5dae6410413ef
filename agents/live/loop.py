"""The car's end of the wires: a UDP port, a relay of NMEA, and a tick every millisecond."""

import bisect
import errno
import gc
import math
import select
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from ...envs.recordings.dialect import to_metres
from ...envs.recordings.sources import make_source
from .controller import OnboardController, Recorder
from .messages import (
    MAX_AGE,
    MAX_BYTES,
    TICK_US,
    Address,
    Arrival,
    DatagramKind,
    LoopStatus,
    Message,
    RejectReason,
    StreamSynchroniser,
    Tick,
)

if TYPE_CHECKING:
    from ...envs.recordings.nmea import Counts, Epoch

LOOPBACK = "127.0.0.1"
_BUFFER = 1 << 22  # bytes of the kernel's, as far as it grants them
MAX_BATCH = 512  # datagrams of a batch: a flood of them does not stop the loop
MAX_HDOP = 99.0  # what receivers give without a fix
_MAX_PAUSE = 10.0  # s between two epochs of a file
_SPIN = 150_000  # ns before a point in time, which sleeping alone would miss

clock = time.monotonic_ns  # time of the monotonic clock, which is never set (ns)


def wait_until(deadline: int) -> None:
    """Wait until a point in time.

    Args:
        deadline: Time of `clock` (ns).
    """
    if (left := deadline - clock() - _SPIN) > 0:
        time.sleep(left * 1e-9)
    while clock() < deadline:
        pass


class Port(AbstractContextManager["Port"]):
    """A UDP port that numbers its datagrams; OSError for one in use or an unknown host.

    Args:
        host: Host to bind.
        port: Number to bind, 0 for any.
    """

    def __init__(self, host: str = LOOPBACK, port: int = 0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            text = f"is none: {getattr(error, 'strerror', None) or error}"
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                text = "is in use"
            raise OSError(f"UDP port {port} of {host} {text}") from None
        self.address: Address = self._socket.getsockname()
        self._sent: dict[int, int] = {}

    def send(
        self, to: Address, kind: DatagramKind, stamp: int, values: Sequence[float] = (),
        names: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        """Send a message.

        Args:
            to: Address of the receiver.
            kind: Kind of the datagram.
            stamp: Time stamp (us).
            values: Values of `FIELDS`, in SI units.
            names: Names of states, for estimates.
        """
        number = self._sent[kind] = self._sent.get(kind, -1) + 1
        with suppress(OSError):  # the network takes no datagram now
            self._socket.sendto(Message(kind, number, stamp, values, names).encode(), to)

    def _receive_available(self, batch: list[Arrival]) -> list[Arrival]:
        """Append the datagrams that have arrived to a batch, up to `MAX_BATCH`."""
        while len(batch) < MAX_BATCH:
            try:
                data, sender = self._socket.recvfrom(MAX_BYTES + 1)
            except BlockingIOError:
                break
            except OSError:  # a message of the network about an earlier datagram
                continue
            batch.append(Arrival(clock(), data, sender))
        return batch

    def wait(self, seconds: float) -> list[Arrival]:
        """Wait for the first datagrams, in the order of their arrival; none after a timeout.

        Args:
            seconds: Timeout (s).
        """
        select.select([self._socket], [], [], max(seconds, 0.0))
        return self._receive_available([])

    def _receive_until(self, deadline: int) -> list[Arrival]:
        """Receive datagrams until a time of `clock` (ns), each with its time of arrival."""
        batch: list[Arrival] = []
        while (left := deadline - clock() - _SPIN) > 0:
            if len(batch) >= MAX_BATCH:
                time.sleep(left * 1e-9)
                break
            if select.select([self._socket], [], [], left * 1e-9)[0]:
                self._receive_available(batch)
        while clock() < deadline:
            self._receive_available(batch)
        return self._receive_available(batch)

    def __exit__(self, *_: object) -> None:
        self._socket.close()


@dataclass
class Relay:
    """Sends the epochs of a source as datagrams; a lost line is opened again."""

    source: str  # as for `envs.recordings.sources.make_source`, whose errors it raises
    port: Port  # sends
    to: Address  # of the receiver
    latency: float = 0.0  # s from an epoch to its sentences, added to the age
    speed: float = 1.0  # of a file's clock, 1 for real time
    sent: int = 0  # number of datagrams
    error: str = ""  # reason of the end, "" at a file's end
    counts: "Counts" = field(init=False)  # of the decoder
    _origin: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        from ...envs.recordings.nmea import Decoder

        self._chunks, self._decoder = make_source(self.source), Decoder()
        self.counts = self._decoder.counts

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Relay until the source ends or is lost.

        Args:
            stop: Function that returns whether to stop.
        """
        is_file = not self.source.startswith(("serial:", "tcp:"))
        last_time, due = math.nan, time.monotonic()
        try:
            for epoch in self._iterate_epochs():
                if epoch is not None and is_file and epoch.t > last_time:
                    due += min(epoch.t - last_time, _MAX_PAUSE) / self.speed
                while not stop() and is_file and (left := due - time.monotonic()) > 0.0:
                    time.sleep(min(left, 0.1))
                if stop():
                    return
                if epoch is not None:
                    last_time = epoch.t
                    self.port.send(self.to, DatagramKind.GPS, 0, self._make_values(epoch))
                    self.sent += 1
        except OSError as error:
            self.error = str(error)

    def _iterate_epochs(self) -> Iterator["Epoch | None"]:
        """Iterate over the epochs, with None after each chunk of bytes."""
        for chunk in self._chunks:
            yield from self._decoder.decode_chunk(chunk)
            yield None
        yield from self._decoder.finish()

    def _make_values(self, epoch: Any) -> list[float]:
        """Make the doubles of a datagram; an unknown number is 0, an unknown HDOP the worst."""
        X, Y = 0.0, 0.0  # m east and north of the first fix
        if epoch.has_fix:
            self._origin = self._origin or (epoch.latitude, epoch.longitude)
            X, Y = map(float, to_metres(epoch.latitude, epoch.longitude, self._origin))
        hdop = epoch.hdop if math.isfinite(epoch.hdop) else MAX_HDOP
        course, speed = (value if math.isfinite(value) else 0.0 for value in epoch[3:5])
        age = epoch.age + self.latency
        age = min(max(age, 0.0), MAX_AGE) if math.isfinite(age) else MAX_AGE
        return [course, speed, X, Y, hdop, float(epoch.satellites), age, float(epoch.quality)]


PERIOD = 1_000_000  # ns, a tick of the loop
LEAD = 100_000  # ns from a fast row's arrival to the deadline that follows it
PHASE_GAIN = 0.02  # fraction of the phase error that a tick corrects, as a first-order PLL does
MAX_PHASE_STEP = 5_000  # ns, largest correction in a tick: two clocks drift apart slowly
_SUSPENDED = 1_000_000_000  # ns; a loop that is this late was suspended, not merely busy
_STATUS_EVERY = 100  # ticks between two datagrams of the status
_IDLE = 0.1  # s, longest wait for a datagram before the end's conditions are checked
_TOP = 100_000  # us, from which on times share a histogram's last bin


class _Histogram:
    """Histogram of times in us, by whole ones; `newest` and `largest` are kept exactly."""

    def __init__(self) -> None:
        self.counts, self.number = [0] * (_TOP + 1), 0
        self.newest = self.largest = 0.0

    def add(self, us: float) -> None:
        """Count a time (us)."""
        self.counts[min(max(int(us), 0), _TOP)] += 1
        self.number += 1
        self.newest, self.largest = us, max(self.largest, us)

    def quantile(self, share: float) -> float:
        """Compute the upper edge of a quantile's bin, or the largest time (us)."""
        us = bisect.bisect_left(list(accumulate(self.counts)), math.ceil(share * self.number))
        return min(us + 1.0, self.largest) if us < _TOP else self.largest

    def summarise(self) -> dict[str, float]:
        """Compute median, 99.9 % quantile and maximum (us)."""
        times = {"median": self.quantile(0.5), "p999": self.quantile(0.999), "max": self.largest}
        return times if self.number else {}


@dataclass
class _Statistics:
    """The measurements of a loop."""

    jitter: _Histogram = field(default_factory=_Histogram)  # from a deadline to waking up (us)
    latency: _Histogram = field(default_factory=_Histogram)  # oldest datagram to sending (us)
    work: _Histogram = field(default_factory=_Histogram)  # times of a tick's work (us)
    deadlines: int = 0  # number of deadlines that were due
    misses: int = 0  # deadlines that passed during the work of an earlier one
    suspensions: int = 0  # delays of more than `_SUSPENDED`
    ticks: int = 0  # ticks of the estimator
    actions: int = 0  # number of controls sent
    seconds: float = 0.0  # duration of the run (s)

    @property
    def per_million(self) -> float:
        """Misses per million deadlines."""
        return 1e6 * self.misses / max(self.deadlines, 1)


@dataclass
class Loop:
    """An on-board controller on a port."""

    onboard: OnboardController  # estimator and agent
    assembler: StreamSynchroniser  # synchroniser of the datagrams
    port: Port  # receives and sends
    targets: Sequence[Address] = ()  # which get every estimate
    viewer: Address | None = None  # which gets every tenth estimate and the status
    step: bool = False  # whether time is that of the stamps: datagrams are processed as they arrive
    recorder: Recorder | None = None  # of the session
    patience: float = 30.0  # s without a fast row after which `run` ends
    statistics: _Statistics = field(default_factory=_Statistics)
    ended: str = ""  # reason of the end

    def run(self, stop: Callable[[], bool] = lambda: False, duration: float = math.inf) -> None:
        """Run until the drive is over, and set `ended`.

        Args:
            stop: Function that returns whether to stop.
            duration: Longest duration (s).
        """
        start_time = last_heard = time.monotonic()
        self.onboard.digest = 0  # of this drive
        had_gc, deadline = gc.isenabled(), 0  # ns; 0: no row has come
        gc.disable()  # a collection takes hundreds of ms
        try:
            while not self._check_end(stop, start_time + duration):
                if deadline:
                    deadline = self._run_tick(deadline)
                elif self._take(self.port.wait(_IDLE)) and not self.step:
                    deadline = clock() + PERIOD
                if not self.assembler.silent:
                    last_heard = time.monotonic()
                elif time.monotonic() - last_heard > self.patience:
                    (host, port), limit = self.port.address, f"{self.patience:g} s"
                    if not self.statistics.ticks:
                        text = f"no inertial datagram came to {host}:{port}"
                        raise TimeoutError(f"{text} within {limit}")
                    self.ended = f"no inertial data for {limit}"
                    break
        finally:
            if had_gc:
                gc.enable()
            self.statistics.seconds = time.monotonic() - start_time

    def _check_end(self, stop: Callable[[], bool], end: float) -> bool:
        reasons = {"the drive is over": self.assembler.over, "stopped": stop()}
        reasons["the time is over"] = time.monotonic() > end
        self.ended = next((reason for reason, holds in reasons.items() if holds), "")
        return bool(self.ended)

    def _run_tick(self, deadline: int) -> int:
        """Wait for a deadline, process the arrivals, and return the next deadline."""
        batch, statistics = self.port._receive_until(deadline), self.statistics
        wake_time = clock()
        rows = self._take(batch)
        end_time = clock()
        statistics.deadlines += 1
        statistics.jitter.add((wake_time - deadline) * 1e-3)
        statistics.work.add((end_time - wake_time) * 1e-3)
        if rows and batch:
            statistics.latency.add((end_time - batch[0].at) * 1e-3)
        if rows == 1 and batch:  # the deadlines shall come LEAD behind the rows
            phase_step = PHASE_GAIN * (batch[-1].at + LEAD - deadline)
            deadline += round(min(max(phase_step, -MAX_PHASE_STEP), MAX_PHASE_STEP))
        deadline += PERIOD
        if end_time > deadline:
            missed = (end_time - deadline) // PERIOD + 1
            statistics.misses += missed
            statistics.deadlines += missed
            statistics.suspensions += missed * PERIOD > _SUSPENDED
            deadline += missed * PERIOD
        return deadline

    def _take(self, batch: list[Arrival]) -> int:
        """Process a batch, send estimates and controls, and return the number of its ticks."""
        onboard, statistics, ticks = self.onboard, self.statistics, 0
        for tick in self.assembler.take(batch):
            onboard.take(tick)
            ticks += 1
            statistics.ticks += 1
            self._send(tick)
        if self.recorder is not None:
            self.recorder.take(self.assembler.accepted, onboard.digest)
        return ticks

    def _send(self, tick: Tick) -> None:
        onboard, stamp = self.onboard, tick.number * TICK_US
        sender, action = self.assembler.sender, onboard.action
        if onboard.has_new_action and action is not None and sender is not None:
            self.statistics.actions += 1
            moment, steering, *_ = (*map(float, action), 0.0)
            control = moment * onboard.facts.full_scale, steering * onboard.facts.authority
            self.port.send(sender, DatagramKind.CONTROL, stamp, control)
        receivers = [*self.targets, self.viewer] if tick.number % 10 == 0 else self.targets
        for target in filter(None, receivers):
            values = (*onboard.x.tolist(), *onboard.std.tolist())
            self.port.send(target, DatagramKind.ESTIMATE, stamp, values, onboard.names)
        if self.viewer is not None and tick.number % _STATUS_EVERY == 0:
            self.port.send(self.viewer, DatagramKind.STATUS, stamp, self._make_status())

    def _make_status(self) -> LoopStatus:
        """Collect the counts so far."""
        m, counts = self.statistics, self.assembler.counts
        bad = sum(counts[reason] for reason in RejectReason)
        numbers = m.ticks, m.misses, counts["held"], bad, counts["lost"]
        times = m.jitter.newest, m.latency.newest, m.work.newest
        health = m.deadlines, self.onboard.is_healthy
        return LoopStatus._make(map(float, (*numbers, *times, *health)))

    def numbers(self) -> dict[str, object]:
        """Collect all measurements, in JSON types."""
        numbers: dict[str, object] = {"per_million": self.statistics.per_million}
        for name, value in vars(self.statistics).items():
            is_time = isinstance(value, _Histogram)
            numbers |= {f"{name}_us": value.summarise()} if is_time else {name: value}
        return numbers | {"counts": dict(self.assembler.counts), "refused": self.onboard.refused}

    def lines(self, name: str) -> list[str]:
        """Format the first two or three lines of a verdict on the loop.

        Args:
            name: Name of the estimator.
        """
        m, tables = self.statistics, (self.assembler.counts, self.onboard.refused)
        ended = f"{name}: {m.ticks} ticks in {m.seconds:.1f} s, {self.ended}"
        ignored, refused = (", ".join(f"{n} {key}" for key, n in x.items() if n) for x in tables)
        by = f"; packets that the estimator refused: {refused}" if refused else ""
        lines = [f"{ended}.", f"Ignored or bridged: {ignored or 'nothing'}{by}."]
        if m.deadlines:
            form = "median {median:.0f}, 99.9 % {p999:.0f}, most {max:.0f} us"
            times = m.jitter.summarise(), m.latency.summarise()
            jitter, latency = (form.format(**x) if x else "unknown" for x in times)
            missed = f"{m.misses} of {m.deadlines} deadlines missed"
            lines[0] = f"{ended}; {missed}, {m.per_million:.0f} per million."
            lines[1:1] = [f"Jitter {jitter}; packet to estimate {latency}."]
        return lines
