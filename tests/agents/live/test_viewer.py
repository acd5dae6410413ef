"""What the loop sends is on the page and in the table, and nowhere but on this machine."""

import io
import json
import math
import re
import shutil
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

pytest.importorskip("aiohttp")

from sideslip.agents.live.loop import LOOPBACK, Port
from sideslip.agents.live.messages import DatagramKind, LoopStatus
from sideslip.agents.live.peers import Viewer, _make_event, _make_table, _ViewerProtocol
from tests.agents.live.both_ends import encode

NAMES = ("beta", "gamma", "F_d")
STATUS = LoopStatus(ticks=1000.0, misses=3.0, held=2.0, bad=5.0, lost=1.0, deadlines=998.0)


def send(port: Port, to: Any, samples: int = 50) -> None:
    for i in range(samples):
        t = 0.01 * i
        values = (0.1 * math.sin(t), math.cos(t), 100.0, 0.01, 0.02, 3.0)
        port.send(to, DatagramKind.ESTIMATE, round(1e6 * t), values, NAMES)
    port.send(to, DatagramKind.STATUS, 0, STATUS)


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with Viewer("<b>mine</b>", (LOOPBACK, 0), screen=False) as found, Port() as port:
        send(port, found.address)
        yield found


def events(url: str, enough: int) -> list[dict[str, Any]]:
    """Server-sent events until there are so many samples."""
    found: list[dict[str, Any]] = []
    with urllib.request.urlopen(f"{url}events", timeout=10.0) as stream:
        for line in stream:
            if line.startswith(b"data: "):
                found.append(json.loads(line[6:]))
            if sum(len(each["samples"]) for each in found) >= enough:
                return found
    return found


def test_the_page_has_all_and_the_events_what_is_new(viewer: Viewer) -> None:
    assert viewer.url.startswith("http://127.0.0.1:") and viewer.address[0] == LOOPBACK
    found = events(viewer.url, 50)
    samples = [sample for each in found for sample in each["samples"]]
    assert len(samples) == 50 and found[0]["all"]
    assert found[-1]["names"] == [["beta", "deg"], ["gamma", "deg/s"], ["F_d", "N"]]
    assert samples[-1][1] == pytest.approx(math.degrees(0.1 * math.sin(0.49)))
    assert samples[-1][3:] == pytest.approx([100.0, math.degrees(0.01), math.degrees(0.02), 3.0])
    with urllib.request.urlopen(viewer.url, timeout=10.0) as page:
        text, policy = page.read().decode(), page.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "connect-src 'self'" in policy
    (nonce,) = set(re.findall(r"nonce-([\w-]+)", policy))
    assert text.count(f'nonce="{nonce}"') == 2 and "unsafe-inline" not in policy
    assert "&lt;b&gt;mine" in text and "<b>mine" not in text
    assert not re.search(r"https?://|src=|href=", text)


@pytest.mark.parametrize(
    ("header", "value"), [("Host", "evil.example:80"), ("Origin", "http://evil.example")]
)
@pytest.mark.parametrize("path", ["", "events"])
def test_another_page_gets_nothing(viewer: Viewer, path: str, header: str, value: str) -> None:
    """Neither one whose name resolves to this address nor one from elsewhere."""
    request = urllib.request.Request(f"{viewer.url}{path}", headers={header: value})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=10.0)


def test_markup_in_a_name_is_shown_as_it_is() -> None:
    seen = _ViewerProtocol()
    seen.datagram_received(encode(DatagramKind.ESTIMATE, 0, 0, (1.0, 0.1), ("[/red]",)), None)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(_make_table(seen, "[/bold]"))
    text = console.export_text()
    assert "[/red]" in text and "[/bold]" in text


def test_the_browser_draws_every_strip(viewer: Viewer, tmp_path: Path) -> None:
    if (browser := shutil.which("chromium")) is None:
        pytest.skip("no chromium on the PATH")
    events(viewer.url, 50)  # they are there
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--timeout=2000",
               f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", viewer.url]  # fmt: skip
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert not [line for line in run.stderr.splitlines() if "CONSOLE" in line]
    assert len(re.findall("<canvas", run.stdout)) == 3
    assert "beta / deg" in run.stdout and "100.000 ± 3.000" in run.stdout
    assert "<dt>deadlines missed</dt><dd>3</dd>" in run.stdout


def test_a_port_in_use_is_an_error(viewer: Viewer) -> None:
    number = int(viewer.url.rstrip("/").rpartition(":")[2])
    with pytest.raises(OSError, match=f"the page of port {number}"):
        Viewer("second", (LOOPBACK, number), screen=False)


def test_the_table_has_estimates_and_counts() -> None:
    seen, console = _ViewerProtocol(), Console(width=80, record=True)
    console.print(_make_table(seen, "mine"))
    assert "no inertial data yet" in console.export_text()
    values = (0.1, 0.2, 30.0, 0.01, 0.02, 3.0)
    seen.datagram_received(b"garbage", None)
    seen.datagram_received(encode(DatagramKind.ESTIMATE, 0, 2_500_000, values, NAMES), None)
    seen.datagram_received(encode(DatagramKind.STATUS, 0, 0, STATUS), None)
    console.print(_make_table(seen, "mine"))
    text = console.export_text()
    assert "+5.730" in text and "deg/s" in text and "t 2.5 s" in text
    assert "3 of 998 deadlines missed" in text and "5 datagrams bad, 1 lost" in text
    assert "is lost" not in text
    lost = STATUS._replace(healthy=0.0)
    seen.datagram_received(encode(DatagramKind.STATUS, 0, 0, lost), None)
    console.print(_make_table(seen, "mine"))
    assert "the estimator is lost" in console.export_text()


def test_nothing_of_a_name_ends_the_pages_script() -> None:
    seen = _ViewerProtocol()
    name = "</script><script>alert(1)"
    seen.datagram_received(encode(DatagramKind.ESTIMATE, 0, 0, (1.0, 2.0), (name,)), None)
    text, count = _make_event(seen, 0)
    assert count == 1 and name in json.loads(text)["names"][0]
