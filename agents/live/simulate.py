"""The other end of the wires: a simulated car that takes controls, and a relay of NMEA."""

import gc
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import Z
from ...envs.record import FAST, PACKET
from ...envs.recordings.dialect import to_metres
from ...envs.recordings.sources import make_source
from ...envs.sensors.slow import WIDTHS
from ...envs.ticks import TICK
from ..env_info import get_env_facts
from ..rollout import Rollout, rollout
from .loop import Port, clock, wait_until
from .messages import KINDS, MAX_AGE, TICK_US, Address, Arrival, DatagramKind, RejectReason, decode

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from ...envs.recordings.nmea import Counts, Epoch

MAX_TICKS = 250  # of a control period in lock-step: the kernel buffers so many rows
_SLACK = 150_000  # ns before the next row is due, at which a control is too late
CONTROL_TIMEOUT = 60.0  # s that lock-step waits for a control
MAX_HDOP = 99.0  # what receivers give without a fix
_MAX_PAUSE = 10.0  # s between two epochs of a file


@dataclass
class _WireAgent:
    """An agent on the wires: it sends the env's record and returns the controls that arrive."""

    env: gym.Env[Any, Any]  # bare `StabilityEnv`
    port: Port  # sends
    to: Address  # of the receiver
    step: bool = False  # wait for the control of every period
    speed: float = 1.0  # of the clock, 1 for real time
    late: int = 0  # late controls: the last action holds
    periods: int = 0  # number of control periods
    _start_time: int = 0  # ns, when tick 0 is due
    _newest: int = -1  # stamp of the newest control

    def __post_init__(self) -> None:
        self._facts = get_env_facts(self.env)
        self._action = np.zeros(self._facts.width, np.float32)

    def predict(self, *_: object, **__: object) -> tuple[npt.NDArray[np.float32], None]:
        """Return the action, in fractions of full scale, that comes back for the newest record."""
        if not self.periods:
            self._start_time = clock() + round(1e9 * TICK)
        tick = self.send()
        self.periods += 1
        if self.step:
            self._wait_for_control(tick * TICK_US)
        else:
            end = self._get_due_time(tick + 1) - _SLACK
            while self._newest < tick * TICK_US and clock() < end:
                self._read(self.port.wait((end - clock()) * 1e-9))
            self.late += self._newest < tick * TICK_US
        return self._action.copy(), None

    def send(self) -> int:
        """Send the newest record, each tick when it is due, and return the last tick."""
        base: Any = self.env.unwrapped
        record = base.record
        command = base.get_state()["state"][Z.driver]  # which the next fast row carries
        steers = [*record.fast[1:, FAST.steer_command], command]
        for tick, row, steer in zip(record.ticks.tolist(), record.fast, steers, strict=True):
            if not self.step:
                wait_until(self._get_due_time(tick))
            for packet in record.packets[record.packets[:, PACKET.arrived] == tick]:
                sensor = int(packet[PACKET.sensor])
                values = packet[PACKET.value : PACKET.value + WIDTHS[sensor]].tolist()
                age = float((packet[PACKET.arrived] - packet[PACKET.captured]) * TICK)
                values += [age, float(packet[PACKET.quality])]
                self.port.send(self.to, KINDS[sensor], tick * TICK_US, values)
            values = [*row.tolist(), float(steer)]
            self.port.send(self.to, DatagramKind.INERTIAL, tick * TICK_US, values)
        return int(record.ticks[-1])

    def end(self) -> None:
        """Send the record of the last step, and the end of the drive."""
        self.port.send(self.to, DatagramKind.END, self.send() * TICK_US)

    def _get_due_time(self, tick: int) -> int:
        return self._start_time + round(tick * TICK * 1e9 / self.speed)

    def _wait_for_control(self, stamp: int) -> None:
        end = time.monotonic() + CONTROL_TIMEOUT
        while self._newest < stamp:
            if time.monotonic() > end:
                text = f"no control came within {CONTROL_TIMEOUT:g} s for tick {stamp // TICK_US}"
                place = f"--step at {self.to[0]}:{self.to[1]}"
                raise TimeoutError(f"{text}: does `sideslip live` run with {place}?")
            self._read(self.port.wait(0.1))

    def _read(self, arrivals: list[Arrival]) -> None:
        for arrival in arrivals:
            message = decode(arrival.data)
            if isinstance(message, RejectReason) or message.kind != DatagramKind.CONTROL:
                continue
            if message.stamp >= self._newest:
                moment, steering = message.values  # N m, rad
                shares = moment / self._facts.full_scale, steering / self._facts.authority
                self._action = np.array(shares[: self._facts.width], np.float32)
                self._newest = message.stamp


def simulate(
    env: gym.Env[Any, Any], port: Port, to: Address, seed: int = 0, step: bool = False,
    speed: float = 1.0,
) -> tuple[Rollout, _WireAgent]:  # fmt: skip
    """Simulate one episode whose agent is at the other end of the wires.

    In lock-step the drive is that of `rollout` with the same agent, bit for bit; in real time it
    differs by late controls alone.

    Args:
        env: Bare `StabilityEnv`.
        port: Port that sends.
        to: Address of the receiver.
        seed: Seed of the reset.
        step: Whether to run in lock-step.
        speed: Speed of the clock, 1 for real time.

    Returns:
        The episode, and the agent with its counts.

    Raises:
        ValueError: The control period is too long for lock-step.
    """
    if step and get_env_facts(env).control_period > MAX_TICKS:
        raise ValueError(f"in lock-step a control period has at most {MAX_TICKS} ticks")
    agent = _WireAgent(env, port, to, step, speed)
    drive = rollout(env, agent, seed)
    agent.end()
    return drive, agent


class SimulatedCarProcess(AbstractContextManager["SimulatedCarProcess"]):
    """The simulated car in a process of its own, ready before it starts.

    Args:
        arguments: Id and options of the env, then `to`, `seed`, `step` and `speed` of `simulate`.
    """

    def __init__(self, *arguments: object) -> None:
        context = get_context("spawn")
        self._pipe, child_pipe = context.Pipe()
        pipe = (child_pipe, *arguments)
        self._process = context.Process(target=_run_simulated_car, args=pipe, daemon=True)
        self._process.start()
        child_pipe.close()
        self.result()  # it is ready

    def start_drive(self) -> None:
        """Start the drive."""
        self._pipe.send("go")

    def result(self) -> Any:
        """Wait for the drive's end, and return its columns, late controls and periods."""
        try:
            message = self._pipe.recv()
        except EOFError:
            raise ChildProcessError("the simulated car's process ended") from None
        if isinstance(message, Exception):
            raise message
        return message

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _run_simulated_car(
    pipe: "Connection", env_id: str, options: dict[str, Any], to: Address, seed: int, *timing: Any
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the loop at the car's end has the summary
    try:
        env = gym.make(env_id, **options)
        with Port() as port:
            warm_up_agent = _WireAgent(env, port, port.address, speed=10.0)
            rollout(env, warm_up_agent, seed, {"duration": 0.1})  # compiles before the drive
            gc.collect()
            gc.freeze()
            pipe.send("ready")
            pipe.recv()
            drive, agent = simulate(env, port, to, seed, *timing)
        pipe.send((drive.columns, agent.late, agent.periods))
    except Exception as error:
        pipe.send(error)


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
    _origin: tuple[float, float] | None = field(default=None)

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
