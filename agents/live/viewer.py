"""Views of a loop's estimates: a table in the terminal, a page in the browser.

They are a process of their own, as drawing would cost the loop its deadlines.
"""

import asyncio
import json
import os
import secrets
import signal
from collections import deque
from contextlib import AbstractContextManager, suppress
from functools import partial
from html import escape
from ipaddress import ip_address
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from ...estimators.design.models import FOREIGN_STATE, STATES
from .loop import LOOPBACK, Port
from .messages import Address, DatagramKind, LoopStatus, Message, RejectReason, decode

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from aiohttp import web
    from aiohttp.typedefs import Handler
    from rich.table import Table

_PAGE = Path(__file__).with_name("page.html")
_SECONDS = 20.0  # s, of the page's plots
_RATE = 100  # estimates a second: the loop sends the viewer every tenth tick's
_DEGREES = 57.29577951308232  # deg/rad
_CONTENT_SECURITY_POLICY = ("default-src 'none'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; "
                            "connect-src 'self'; frame-ancestors 'none'")  # fmt: skip


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
        if message.kind == DatagramKind.ESTIMATE:
            self._add_estimate(message)
        elif message.kind == DatagramKind.STATUS:
            self.status = LoopStatus(*message.values)
        elif message.kind == DatagramKind.END:
            self.over.set()

    def _add_estimate(self, message: Message) -> None:
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


async def _run_viewer(title: str, page: Address | None, screen: bool, pipe: "Connection") -> None:
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
        await web.TCPSite(runner, *page).start()
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


def _run_process(title: str, page: Address | None, screen: bool, pipe: "Connection") -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the loop ends it, with its summary
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # whatever the loop's is
    os.nice(5)
    try:
        asyncio.run(_run_viewer(title, page, screen, pipe))
    except (OSError, ModuleNotFoundError) as error:
        missing = isinstance(error, ModuleNotFoundError)
        pipe.send("the page needs aiohttp: pip install 'sideslip[wires]'" if missing else error)


class Viewer(AbstractContextManager["Viewer"]):
    """The process that shows a loop's estimates.

    Args:
        title: Title above the estimates.
        page: Host and port of the page, port 0 for any; None: no page.
        screen: Whether the terminal has a table.

    Raises:
        OSError: The port is in use.
        ModuleNotFoundError: aiohttp is not installed.
    """

    def __init__(self, title: str, page: Address | None, screen: bool) -> None:
        context = get_context("spawn")
        pipe, child_pipe = context.Pipe()
        arguments = title, page, screen, child_pipe
        self._process = context.Process(target=_run_process, args=arguments, daemon=True)
        self._process.start()
        child_pipe.close()
        try:
            reply = pipe.recv()
        except EOFError:
            reply = "the viewer ended before it began"
        if isinstance(reply, OSError):
            raise OSError(f"the page of port {page[1] if page else 0}: {reply.strerror}")
        if isinstance(reply, str):
            raise ModuleNotFoundError(reply)
        self.address, self.url = reply  # where the loop sends its datagrams; the page's

    def __exit__(self, *_: object) -> None:
        with Port() as port:
            port.send(self.address, DatagramKind.END, 0)
        self._process.join(3.0)
        self._process.kill()
