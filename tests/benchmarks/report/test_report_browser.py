"""The report in a browser: every figure is drawn, nothing complains, a click sorts."""

import base64
import hashlib
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Suite
from sideslip.benchmarks.report.html import write_report

from .demo import COMMAND, HOSTILE, VERSIONS, control, drawn, estimation, matrix

pytestmark = pytest.mark.long

# Chromium's numbers for what a media query asks: hover 1 none, 2 hover; scheme 0 dark, 1 light.
FINGER, MOUSE = (f"primaryHoverType={n},availableHoverTypes={n}" for n in (1, 2))
DARK, LIGHT = (f"preferredColorScheme={n}" for n in (0, 1))

OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-quic",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--host-resolver-rules=MAP * ~NOTFOUND", "--enable-logging=stderr", "--v=0",
    "--virtual-time-budget=20000",
)  # fmt: skip

# Each runs when everything is drawn, and leaves what it found in the document.
OPEN = """
document.addEventListener("DOMContentLoaded", () => {
  for (const each of document.querySelectorAll("details")) each.open = true;
});
"""
CHOICES = """
const [manoeuvre, left, right] = document.querySelectorAll(".explorer select");
const names = (select) => [...select.options].map((option) => option.value).join("|");
const found = [names(manoeuvre), names(left), left.value, right.value];
manoeuvre.value = "step-steer";
manoeuvre.dispatchEvent(new Event("change"));
found.push(names(right), right.value);
right.value = "none";
right.dispatchEvent(new Event("change"));
const plots = [...document.querySelectorAll(".explorer .plot")];
found.push(...plots.map((plot) => plot.data.length), plots[1].data[0].y[0].toFixed(2));
found.push(String(plots[0].layout.yaxis.range) === String(plots[1].layout.yaxis.range));
document.body.dataset.found = found.join("; ");
"""
MOTION = """
const [canvas] = document.querySelectorAll(".explorer canvas");
const clock = document.querySelector(".explorer input");
const cursor = document.querySelector(".explorer .cursor");
const seen = [0.1, 0.1, 0.9].map((value) => {
  clock.value = value;
  clock.dispatchEvent(new Event("input"));
  return [canvas.toDataURL(), parseFloat(cursor.style.left)];
});
const [first, again, last] = seen;
document.body.dataset.found = [first[0] === again[0], first[0] !== last[0], last[1] > first[1],
  document.querySelector(".explorer output").textContent].join("; ");
"""
FOLDED = """
const folded = document.querySelector("details:has(figure)");
const drawn = () => folded.querySelectorAll(".main-svg").length > 0;
const before = drawn();
folded.open = true;
setTimeout(() => {
  document.body.dataset.found = `${before}; ${drawn()}`;
}, 4000);
"""
WIDTH = """
console.log(`width ${document.documentElement.scrollWidth} of ${window.innerWidth}`);
"""
CLICKS = """
const button = document.querySelectorAll("#suite-1 th button")[%d];
for (let i = 0; i < %d; i++) button.click();
const head = button.parentElement;
const rows = [...head.closest("table").tBodies[0].rows].map((row) => row.cells[0].textContent);
document.body.dataset.found = head.ariaSort + ": " + rows.join(", ");
"""


def add_script(page: Path, script: str, first: bool = False) -> None:
    """Let a script of the test run too, when everything is drawn or before anything is."""
    if not first:
        script = (
            "const wait = setInterval(() => {\n"
            'if (document.querySelector("[data-name]") && !document.body.dataset.drawn) return;\n'
            "clearInterval(wait);\n" + script + "}, 50);"
        )
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    text = page.read_text(encoding="utf-8")
    text = text.replace("script-src ", f"script-src 'sha256-{digest}' ")
    text = text.replace("<body>" if first else "</body>",
                        f"<body><script>{script}</script>" if first
                        else f"<script>{script}</script></body>")  # fmt: skip
    page.write_text(text, encoding="utf-8")


def found_by(page: Path, script: str, first: bool = False) -> str:
    """What a script left in the document; the console stays empty."""
    add_script(page, script, first)
    dom, messages = browse(page, "--dump-dom")
    assert messages == []
    found = re.search(r'data-found="(.*?)"', dom)
    return unescape(found[1]) if found else ""


def browse(page: Path, *options: str) -> tuple[str, list[str]]:
    """The page's document after its scripts ran in chromium, and its console's messages."""
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("no chromium on the PATH")
    command = [browser, *OPTIONS, f"--user-data-dir={page.parent / 'profile'}"]
    command += [*options, page.as_uri()]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return run.stdout, [line for line in run.stderr.splitlines() if "CONSOLE" in line]


def written(folder: Path, suites: list[Suite]) -> Path:
    target = folder / "report.html"
    write_report(target, suites, COMMAND, VERSIONS)
    return target


@pytest.mark.parametrize(
    ("width", "pointer"), [(1280, MOUSE), (500, FINGER)], ids=["desk", "phone"]
)
@pytest.mark.parametrize("scheme", [DARK, LIGHT], ids=["dark", "light"])
def test_browser_draws_every_figure(tmp_path: Path, width: int, pointer: str, scheme: str) -> None:
    page = written(tmp_path, [estimation(), control()])
    looks = f"--blink-settings={pointer},{scheme}"
    add_script(page, OPEN, first=True)
    dom, messages = browse(page, "--dump-dom", f"--window-size={width},900", looks)
    assert messages == []
    plots = re.findall(r'<div class="plot.*?</figure>', dom, flags=re.DOTALL)
    assert len(plots) == len(drawn()) + 1
    assert all('class="main-svg"' in plot for plot in plots)
    ink = "rgb(255, 255, 255)" if scheme == DARK else "rgb(0, 0, 0)"
    assert f"stroke: {ink}; stroke-opacity: 1; stroke-width: 2.6px" in plots[3]
    assert all(("modebar--hover" in plot) == (pointer == MOUSE) for plot in plots)
    assert not any("Share" in plot for plot in plots), "the page must offer no upload"
    picture = tmp_path / "report.png"
    _, messages = browse(page, f"--screenshot={picture}", f"--window-size={width},4000", looks)
    assert messages == []
    assert picture.stat().st_size > 50_000


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_wider_than_the_screen(tmp_path: Path, width: int) -> None:
    """In a frame of that width, since no window of chromium is as narrow as a phone."""
    page = written(tmp_path, [estimation(), matrix()])
    add_script(page, WIDTH)
    frame = tmp_path / "frame.html"
    style = f"width: {width}px; height: 800px; border: 0"
    frame.write_text(f'<body style="margin: 0"><iframe style="{style}" src="report.html">')
    _, messages = browse(frame, "--dump-dom", "--window-size=1300,900")
    (line,) = messages
    found = re.search(r"width (\d+) of (\d+)", line)
    assert found is not None and int(found[1]) <= int(found[2]) == width


def test_a_script_that_is_not_ours_does_not_run_and_nothing_is_loaded(tmp_path: Path) -> None:
    page = written(tmp_path, [control()])
    text = page.read_text(encoding="utf-8")
    foreign = (
        '<img src="https://example.org/a.png"><script>document.title = "taken"</script></body>'
    )
    page.write_text(text.replace("</body>", foreign), encoding="utf-8")
    dom, messages = browse(page, "--dump-dom")
    assert sum("Content Security Policy" in message for message in messages) == 2
    assert "<title>taken" not in dom


def test_a_browser_that_cannot_unpack_gets_a_sentence(tmp_path: Path) -> None:
    page = written(tmp_path, [estimation()])
    add_script(page, "delete window.DecompressionStream;", first=True)
    dom, messages = browse(page, "--dump-dom")
    assert messages == []
    assert re.search('<p class="note" id="unable">This browser cannot unpack', dom)
    assert 'id="unable" hidden' in written(tmp_path, [estimation()]).read_text(encoding="utf-8")


def test_what_is_folded_is_drawn_when_it_is_opened(tmp_path: Path) -> None:
    assert found_by(written(tmp_path, [estimation()]), FOLDED) == "false; true"


@pytest.mark.parametrize(
    ("column", "clicks", "order"),
    [
        (0, 1, "ascending: bicycle-kf, exact-kf, multirate-kf, single-rate-kf, the bound"),
        (1, 1, "ascending: the bound, exact-kf, multirate-kf, single-rate-kf, bicycle-kf"),
        (1, 2, "descending: bicycle-kf, single-rate-kf, multirate-kf, exact-kf, the bound"),
        (3, 1, "ascending: bicycle-kf, single-rate-kf, multirate-kf, exact-kf, the bound"),
        (3, 2, "descending: exact-kf, multirate-kf, single-rate-kf, bicycle-kf, the bound"),
        (3, 3, "none: exact-kf, multirate-kf, single-rate-kf, bicycle-kf, the bound"),
    ],
)
def test_browser_sorts_tables(tmp_path: Path, column: int, clicks: int, order: str) -> None:
    page = written(tmp_path, [estimation(figures=False)])
    assert found_by(page, CLICKS % (column, clicks)) == order


def test_two_cells_stand_beside_each_other_on_the_same_axes(tmp_path: Path) -> None:
    page = written(tmp_path, [matrix()])
    last = f"{3 * np.sin(3.0):.2f}"
    assert found_by(page, CHOICES) == (
        f"gust|step-steer; none|lqr; none; lqr; none|{HOSTILE}; {HOSTILE}; 2; 2; {last}; true"
    )


def test_the_cars_move(tmp_path: Path) -> None:
    page = written(tmp_path, [matrix()])
    assert found_by(page, MOTION) == "true; true; true; 7.20 s"
    picture = tmp_path / "matrix.png"
    _, messages = browse(page, f"--screenshot={picture}", "--window-size=1280,3600")
    assert messages == []
    assert picture.stat().st_size > 50_000
