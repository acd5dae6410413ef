"""The processes that a loop talks to: a simulated car, and a viewer in terminal and browser.

They are processes of their own, as they would cost the loop its deadlines.
"""

import asyncio
import gc
import json
import math
import os
import secrets
import signal
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from html import escape
from ipaddress import ip_address
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.engine.layout import Z
from ...envs.numerics import require_extra
from ...envs.numerics.functions import TICK
from ...envs.record import FAST, PACKET
from ...envs.sensors.slow import WIDTHS
from ...estimators.design.options import FOREIGN_STATE, STATES
from ..env_info import get_env_facts
from ..rollout import Rollout, rollout
from .loop import LOOPBACK, Port, clock, wait_until
from .messages import KINDS, TICK_US, Address, DatagramKind, LoopStatus, RejectReason, decode

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from aiohttp import web
    from aiohttp.typedefs import Handler
    from rich.table import Table

MAX_TICKS = 250  # of a control period in lock-step: the kernel buffers so many rows
_SLACK = 150_000  # ns before the next row is due, at which a control is too late
CONTROL_TIMEOUT = 60.0  # s that lock-step waits for a control
_PAGE = Path(__file__).with_name("page.html")
_SECONDS = 20.0  # s, of the page's plots
_RATE = 100  # estimates a second: the loop sends the viewer every tenth tick's
_DEGREES = math.degrees(1.0)  # deg/rad
_CONTENT_SECURITY_POLICY = ("default-src 'none'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; "
                            "connect-src 'self'; frame-ancestors 'none'")  # fmt: skip


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
        end = self._get_due_time(tick + 1) - _SLACK
        if self.step:
            end = clock() + round(1e9 * CONTROL_TIMEOUT)
        while (is_late := self._newest < tick * TICK_US) and clock() < end:
            for arrival in self.port.wait((end - clock()) * 1e-9):
                self._read(arrival.data)
        if is_late and self.step:
            text = f"no control came within {CONTROL_TIMEOUT:g} s for tick {tick}"
            place = f"--step at {self.to[0]}:{self.to[1]}"
            raise TimeoutError(f"{text}: does `sideslip live` run with {place}?")
        self.late += is_late
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

    def _read(self, data: bytes) -> None:
        message = decode(data)
        if isinstance(message, RejectReason) or message.kind != DatagramKind.CONTROL:
            return
        if message.stamp >= self._newest:
            moment, steering = message.values  # N m, rad
            shares = moment / self._facts.full_scale, steering / self._facts.authority
            self._action = np.array(shares[: self._facts.width], np.float32)
            self._newest = message.stamp


def simulate(
    env: gym.Env[Any, Any], port: Port, to: Address, seed: int = 0, step: bool = False,
    speed: float = 1.0,
) -> tuple[Rollout, _WireAgent]:  # fmt: skip
    """Simulate one episode whose agent, which counts, is at the other end of the wires.

    In lock-step the drive is that of `rollout` with the same agent, bit for bit; in real time it
    differs by late controls alone.

    Args:
        env: Bare `StabilityEnv`.
        port: Port that sends.
        to: Address of the receiver.
        seed: Seed of the reset.
        step: Whether to run in lock-step; ValueError for a control period too long for it.
        speed: Speed of the clock, 1 for real time.
    """
    if step and get_env_facts(env).control_period > MAX_TICKS:
        raise ValueError(f"in lock-step a control period has at most {MAX_TICKS} ticks")
    agent = _WireAgent(env, port, to, step, speed)
    drive = rollout(env, agent, seed)
    agent.end()
    return drive, agent


class _Peer:
    """A process of its own that answers through a pipe."""

    def __init__(self, run: Callable[..., None], *arguments: object) -> None:
        context = get_context("spawn")
        self._pipe, child_pipe = context.Pipe()
        self._process = context.Process(target=run, args=(child_pipe, *arguments), daemon=True)
        self._process.start()
        child_pipe.close()

    def result(self) -> Any:
        """Wait for the next answer and return it; its error is raised."""
        try:
            answer = self._pipe.recv()
        except EOFError:
            raise ChildProcessError(f"the process of a {type(self).__name__} ended") from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()


class SimulatedCarProcess(_Peer):
    """The simulated car in a process of its own, ready before it starts.

    Its `result` is the drive's columns, late controls and periods.

    Args:
        arguments: Id and options of the env, then `to`, `seed`, `step` and `speed` of `simulate`.
    """

    def __init__(self, *arguments: object) -> None:
        super().__init__(_run_simulated_car, *arguments)
        self.result()  # it is ready

    def start_drive(self) -> None:
        """Start the drive."""
        self._pipe.send("go")


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


class _ViewerProtocol(asyncio.DatagramProtocol):
    """The newest datagrams of a loop: its status, and estimates with angles in degrees."""

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()  # of the states
        # time (s), estimates and standard deviations
        self.samples = deque[list[float]](maxlen=round(_RATE * _SECONDS))
        self.status, self.count, self.over = LoopStatus(), 0, asyncio.Event()

    def datagram_received(self, data: bytes, _: object) -> None:
        """Process a datagram of the loop."""
        message = decode(data)
        if isinstance(message, RejectReason):
            return
        if message.kind == DatagramKind.STATUS:
            self.status = LoopStatus(*message.values)
        elif message.kind == DatagramKind.END:
            self.over.set()
        elif message.kind == DatagramKind.ESTIMATE:
            if message.names != self.names:
                self.names = message.names
                self.samples.clear()
            # units of angles begin with "d": deg, deg/s
            factors = [_DEGREES if _get_unit(name)[0] == "d" else 1.0 for name in self.names] * 2
            values = [a * b for a, b in zip(message.values, factors, strict=True)]
            self.samples.append([message.stamp * 1e-6, *values])
            self.count += 1


def _get_unit(name: str) -> str:
    """Get the unit in which a state is shown, with deg for rad."""
    return STATES.get(name, FOREIGN_STATE).unit.replace("rad", "deg")


def _make_table(protocol: _ViewerProtocol, title: str) -> "Table":
    """Make the table of the estimates and the loop's counts."""
    from rich.table import Table
    from rich.text import Text

    table = Table("state", "estimate", "std", "unit", title=Text(title), title_justify="left")
    n = len(protocol.names)
    newest = protocol.samples[-1] if protocol.samples else []
    for name, x, std in zip(protocol.names, newest[1 : 1 + n], newest[1 + n :], strict=False):
        table.add_row(Text(name), f"{x:+.3f}", f"{std:.3f}", _get_unit(name))
    counts = protocol.status
    time = f"t {newest[0]:.1f} s; " if newest else "no inertial data yet; "
    time += "" if counts.healthy else "the estimator is lost; "
    table.caption = (
        f"{time}{counts.misses:.0f} of {counts.deadlines:.0f} deadlines missed, "
        f"{counts.held:.0f} ticks held\n{counts.bad:.0f} datagrams bad, {counts.lost:.0f} lost; "
        f"jitter {counts.jitter:.0f} us, latency {counts.latency:.0f} us"
    )
    return table


def _make_event(protocol: _ViewerProtocol, sent: int) -> tuple[str, int]:
    """Make JSON of the samples after so many, of all where none were sent; count them all."""
    n_old = max(len(protocol.samples) - (protocol.count - sent), 0)
    event = {"all": sent == 0, "names": [[name, _get_unit(name)] for name in protocol.names]}
    event |= {"samples": list(protocol.samples)[n_old:], "status": protocol.status._asdict()}
    return json.dumps(event), protocol.count


async def _send_events(protocol: _ViewerProtocol, request: "web.Request") -> "web.StreamResponse":
    """Send server-sent events of new samples, twenty times a second."""
    from aiohttp import web

    response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
    await response.prepare(request)
    sent = 0
    with suppress(ConnectionError):
        while not protocol.over.is_set():
            text, sent = _make_event(protocol, sent)
            await response.write(f"data: {text}\n\n".encode())
            await asyncio.sleep(0.05)
    return response


async def _render_page(title: str, protocol: _ViewerProtocol, _: "web.Request") -> "web.Response":
    from aiohttp import web

    event, _count = _make_event(protocol, 0)  # so that it is drawn as soon as it is loaded
    nonce = secrets.token_urlsafe(16)
    page = _PAGE.read_text(encoding="utf-8").replace("NONCE", nonce).replace("TITLE", escape(title))
    text = page.replace("FIRST", event.replace("<", "\\u003c"))
    headers = {"Content-Security-Policy": _CONTENT_SECURITY_POLICY.format(nonce)}
    headers["Cache-Control"] = "no-store"
    return web.Response(text=text, content_type="text/html", headers=headers)


def _is_same_origin(host: str, origin: str | None) -> bool:
    """Return whether a request is for this server and from its own page."""
    # DNS rebinding: a foreign page whose name resolves to this address has that name as the host
    name = host.rpartition(":")[0].strip("[]") or host
    with suppress(ValueError):
        name = "localhost" if ip_address(name) else name
    return name == "localhost" and origin in (None, f"http://{host}")


async def _show(pipe: "Connection", title: str, page: Address | None, screen: bool) -> None:
    loop, runner, url, local = asyncio.get_running_loop(), None, "", (LOOPBACK, 0)
    transport, protocol = await loop.create_datagram_endpoint(_ViewerProtocol, local_addr=local)
    if page is not None:
        from aiohttp import web

        @web.middleware
        async def check_origin(request: web.Request, handler: "Handler") -> web.StreamResponse:
            if not _is_same_origin(request.host, request.headers.get("Origin")):
                raise web.HTTPForbidden(text="this page is served by its address, to itself alone")
            return await handler(request)

        app = web.Application(middlewares=[check_origin])
        app.router.add_get("/", partial(_render_page, title, protocol))
        app.router.add_get("/events", partial(_send_events, protocol))
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
        await runner.setup()
        try:
            await web.TCPSite(runner, *page).start()
        except OSError as error:
            raise OSError(f"the page of port {page[1]}: {error.strerror}") from None
        host, port = runner.addresses[0][:2]
        url = f"http://{host}:{port}/"
    pipe.send((transport.get_extra_info("sockname"), url))
    if screen:
        from rich.live import Live

        with Live(refresh_per_second=5, auto_refresh=False) as live:
            while not protocol.over.is_set():
                live.update(_make_table(protocol, f"{title} {url}"), refresh=True)
                with suppress(TimeoutError):
                    await asyncio.wait_for(protocol.over.wait(), 0.2)
    await protocol.over.wait()
    transport.close()
    if runner is not None:
        await runner.cleanup()


def _run_viewer(pipe: "Connection", *arguments: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the loop ends it, with its summary
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # whatever the loop's is
    os.nice(5)
    try:
        with require_extra("wires", "the page needs {}"):
            asyncio.run(_show(pipe, *arguments))
    except (OSError, ModuleNotFoundError) as error:
        pipe.send(error)


class Viewer(_Peer):
    """The process that shows a loop's estimates; ModuleNotFoundError without aiohttp.

    Args:
        title: Title above the estimates.
        page: Host and port of the page, port 0 for any, OSError for one in use; None: no page.
        screen: Whether the terminal has a table.
    """

    def __init__(self, title: str, page: Address | None, screen: bool) -> None:
        super().__init__(_run_viewer, title, page, screen)
        self.address, self.url = self.result()  # where the loop sends its datagrams; the page's

    def __exit__(self, *_: object) -> None:
        with Port() as port:
            port.send(self.address, DatagramKind.END, 0)
        self._process.join(3.0)
        super().__exit__()
