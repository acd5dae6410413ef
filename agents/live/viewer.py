"""What a loop's estimates look like: a table in the terminal, a page in the browser.

A process of its own, which the loop sends datagrams: drawing would cost it its deadlines.
"""

import asyncio
import json
import os
import secrets
import signal
from collections import deque
from contextlib import suppress
from functools import partial
from html import escape
from ipaddress import ip_address
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ...estimators.design.models import FOREIGN_STATE, STATES
from .datagrams import Bad, Kind, Message, Status, decode
from .port import LOOPBACK, Port

PAGE = Path(__file__).with_name("page.html")
SECONDS = 20.0  # of the strips
_DEGREES = 57.29577951308232
_POLICY = (
    "default-src 'none'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; connect-src 'self'; "
    "frame-ancestors 'none'"
)


class Seen(asyncio.DatagramProtocol):
    """The newest datagrams. samples: (s, estimates, standard deviations), in degrees where states
    are angles; count: of all so far."""

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.samples: deque[list[float]] = deque(maxlen=round(100 * SECONDS))
        self.status, self.count, self.over = Status(), 0, asyncio.Event()

    def datagram_received(self, data: bytes, _: Any) -> None:
        """Take a datagram of the loop."""
        message = decode(data)
        if isinstance(message, Bad):
            return
        if message.kind == Kind.ESTIMATE:
            self._estimate(message)
        elif message.kind == Kind.STATUS:
            self.status = Status(*message.values)
        elif message.kind == Kind.END:
            self.over.set()

    def _estimate(self, message: Message) -> None:
        if message.names != self.names:
            self.names = message.names
            self.samples.clear()
        factors = [_DEGREES if unit_of(name)[0] == "d" else 1.0 for name in self.names] * 2
        values = [a * b for a, b in zip(message.values, factors, strict=True)]
        self.samples.append([message.stamp * 1e-6, *values])
        self.count += 1


def unit_of(name: str) -> str:
    """The unit in which a state is shown."""
    return STATES.get(name, FOREIGN_STATE).unit.replace("rad", "deg")


def table_of(seen: Seen, title: str) -> Any:
    """The estimates, and what the loop has counted."""
    from rich.table import Table
    from rich.text import Text

    table = Table("state", "estimate", "std", "unit", title=Text(title), title_justify="left")
    n = len(seen.names)
    newest = seen.samples[-1] if seen.samples else []
    for name, x, std in zip(seen.names, newest[1 : 1 + n], newest[1 + n :], strict=False):
        table.add_row(Text(name), f"{x:+.3f}", f"{std:.3f}", unit_of(name))
    counts = seen.status
    time = f"t {newest[0]:.1f} s; " if newest else "no inertial data yet; "
    table.caption = (
        f"{time}{counts.misses:.0f} of {counts.ticks:.0f} deadlines missed, "
        f"{counts.held:.0f} ticks held\n{counts.bad:.0f} datagrams bad, {counts.lost:.0f} lost; "
        f"jitter {counts.jitter:.0f} us, latency {counts.latency:.0f} us"
    )
    return table


def news_of(seen: Seen, sent: int) -> tuple[str, int]:
    """What came after the first `sent` samples as JSON, all of them where none were sent; and how
    many there are now."""
    new = min(seen.count - sent, len(seen.samples))
    news = {
        "all": sent == 0,
        "names": [[name, unit_of(name)] for name in seen.names],
        "samples": list(seen.samples)[len(seen.samples) - new :],
        "status": seen.status._asdict(),
    }
    return json.dumps(news), seen.count


async def _events(seen: Seen, request: Any) -> Any:
    """Server-sent events: what is new, twenty times a second."""
    from aiohttp import web

    response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
    await response.prepare(request)
    sent = 0
    with suppress(ConnectionError):
        while not seen.over.is_set():
            text, sent = news_of(seen, sent)
            await response.write(f"data: {text}\n\n".encode())
            await asyncio.sleep(0.05)
    return response


async def _page(title: str, seen: Seen, _: Any) -> Any:
    from aiohttp import web

    text, _ = news_of(seen, 0)  # so that it is drawn as soon as it is loaded
    nonce = secrets.token_urlsafe(16)
    page = PAGE.read_text(encoding="utf-8").replace("NONCE", nonce).replace("TITLE", escape(title))
    text = page.replace("FIRST", text.replace("<", "\\u003c"))
    headers = {"Content-Security-Policy": _POLICY.format(nonce), "Cache-Control": "no-store"}
    return web.Response(text=text, content_type="text/html", headers=headers)


def is_ours(host: str, origin: str | None) -> bool:
    """Say whether a request is for this server and from its own page.

    A page elsewhere that lets its name resolve to this address has that name as the host.

    Args:
        host: The request's Host, "name:port".
        origin: Its Origin, None where it has none.

    Returns:
        Whether both are of this server.
    """
    name = host.rpartition(":")[0].strip("[]") or host
    with suppress(ValueError):
        name = "localhost" if ip_address(name) else name
    return name == "localhost" and origin in (None, f"http://{host}")


async def _view(title: str, page: tuple[str, int] | None, screen: bool, pipe: Any) -> None:
    loop, runner, address = asyncio.get_running_loop(), None, ""
    transport, seen = await loop.create_datagram_endpoint(Seen, local_addr=(LOOPBACK, 0))
    if page is not None:
        from aiohttp import web

        @web.middleware
        async def guard(request: Any, handler: Any) -> Any:
            if not is_ours(request.host, request.headers.get("Origin")):
                raise web.HTTPForbidden(text="this page is served by its address, to itself alone")
            return await handler(request)

        app = web.Application(middlewares=[guard])
        app.router.add_get("/", partial(_page, title, seen))
        app.router.add_get("/events", partial(_events, seen))
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
        await runner.setup()
        await web.TCPSite(runner, *page).start()
        host, port = runner.addresses[0][:2]
        address = f"http://{host}:{port}/"
    pipe.send((transport.get_extra_info("sockname"), address))
    if screen:
        from rich.live import Live

        with Live(refresh_per_second=5, auto_refresh=False) as live:
            while not seen.over.is_set():
                live.update(table_of(seen, f"{title} {address}"), refresh=True)
                with suppress(TimeoutError):
                    await asyncio.wait_for(seen.over.wait(), 0.2)
    await seen.over.wait()
    transport.close()
    if runner is not None:
        await runner.cleanup()


def _main(title: str, page: tuple[str, int] | None, screen: bool, pipe: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the loop ends it, with its summary
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # whatever the loop's is
    os.nice(5)
    try:
        asyncio.run(_view(title, page, screen, pipe))
    except (OSError, ModuleNotFoundError) as error:
        missing = isinstance(error, ModuleNotFoundError)
        pipe.send("the page needs aiohttp: pip install 'sideslip[wires]'" if missing else error)


class Viewer:
    """The process that shows a loop's estimates.

    title: above them. page: (host, port) of the page, port 0 for any; None: without. screen:
    whether the terminal has a table. `address`: to which the loop sends. `url`: of the page.
    Raises OSError for a port in use, ModuleNotFoundError without aiohttp.
    """

    def __init__(self, title: str, page: tuple[str, int] | None, screen: bool) -> None:
        context = get_context("spawn")
        pipe, theirs = context.Pipe()
        arguments = title, page, screen, theirs
        self._process = context.Process(target=_main, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        try:
            found = pipe.recv()
        except EOFError:
            found = "the viewer ended before it began"
        if isinstance(found, OSError):
            raise OSError(f"the page of port {page[1] if page else 0}: {found.strerror}")
        if isinstance(found, str):
            raise ModuleNotFoundError(found)
        self.address, self.url = found

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        with Port() as port:
            port.send(self.address, Kind.END, 0)
        self._process.join(3.0)
        self._process.kill()
