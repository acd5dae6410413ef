"""The report in a browser: every figure is drawn, nothing complains, a click sorts."""

import base64
import re
import shutil
import subprocess
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
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--enable-logging=stderr",
    "--v=0",
    "--virtual-time-budget=20000",
)

MENUS = """<script>
setTimeout(() => {
  const [first, second] = document.querySelectorAll(".explorer select");
  const said = [[...second.options].map((option) => option.value).join("|")];
  first.value = "step-steer";
  first.dispatchEvent(new Event("change"));
  said.push([...second.options].map((option) => option.value).join("|"));
  second.value = second.options[1].value;
  second.dispatchEvent(new Event("change"));
  const plot = document.querySelector(".explorer .plot");
  said.push(plot.data.length, plot.data[0].y[0].toFixed(3));
  document.body.dataset.menus = said.join("; ");
}, 3000);
</script></body>"""
FRAMES = """<script>
setTimeout(() => {
  const plot = [...document.querySelectorAll("figure:not(.explorer) .plot")].at(-1);
  const front = () => plot._fullData.at(-1).x[0];
  const before = front();
  Plotly.animate(plot, ["8.00"], {
    mode: "immediate", transition: { duration: 0 }, frame: { duration: 0, redraw: false },
  });
  setTimeout(() => {
    document.body.dataset.moved = `${before.toFixed(2)} to ${front().toFixed(2)}`;
  }, 2000);
}, 3000);
</script></body>"""
CLICKS = """<script>
const button = document.querySelectorAll("#summary th button")[%d];
for (let i = 0; i < %d; i++) button.click();
const head = button.parentElement;
const rows = [...head.closest("table").tBodies[0].rows].map((row) => row.cells[0].textContent);
document.body.dataset.order = head.ariaSort + ": " + rows.join(", ");
</script></body>"""


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
    dom, messages = browse(page, "--dump-dom", f"--window-size={width},900", looks)
    assert messages == []
    plots = re.findall(r'<div class="plot.*?</figure>', dom, flags=re.DOTALL)
    assert len(plots) == len(drawn())
    assert all('class="main-svg"' in plot for plot in plots)
    ink = "rgb(255, 255, 255)" if scheme == DARK else "rgb(0, 0, 0)"
    assert f"stroke: {ink}; stroke-opacity: 1; stroke-width: 4px" in plots[2]
    assert all(("modebar--hover" in plot) == (pointer == MOUSE) for plot in plots)
    assert not any("Share" in plot for plot in plots), "the page must offer no upload"
    picture = tmp_path / "report.png"
    _, messages = browse(page, f"--screenshot={picture}", f"--window-size={width},4000", looks)
    assert messages == []
    assert picture.stat().st_size > 50_000


def test_browser_tells_of_errors_and_forbids_loading(tmp_path: Path) -> None:
    page = written(tmp_path, [control()])
    text = page.read_text(encoding="utf-8")
    image = '<img src="https://example.org/a.png"></body>'
    page.write_text(text.replace("</body>", image), encoding="utf-8")
    _, messages = browse(page, "--dump-dom")
    assert any("Content Security Policy" in message for message in messages)


@pytest.mark.parametrize(
    ("column", "clicks", "order"),
    [
        (0, 1, "ascending: bicycle-kf, exact-kf, multirate-kf, single-rate-kf, the bound"),
        (1, 1, "ascending: the bound, exact-kf, multirate-kf, single-rate-kf, bicycle-kf"),
        (1, 2, "descending: bicycle-kf, single-rate-kf, multirate-kf, exact-kf, the bound"),
        (4, 1, "ascending: bicycle-kf, single-rate-kf, multirate-kf, exact-kf, the bound"),
        (4, 2, "descending: exact-kf, multirate-kf, single-rate-kf, bicycle-kf, the bound"),
        (4, 3, "none: exact-kf, multirate-kf, single-rate-kf, bicycle-kf, the bound"),
    ],
)
def test_browser_sorts_tables(tmp_path: Path, column: int, clicks: int, order: str) -> None:
    page = written(tmp_path, [estimation(figures=False)])
    text = page.read_text(encoding="utf-8").replace("</body>", CLICKS % (column, clicks))
    page.write_text(text, encoding="utf-8")
    dom, messages = browse(page, "--dump-dom")
    assert messages == []
    assert f'data-order="{order}"' in dom


def test_browser_shows_any_cell(tmp_path: Path) -> None:
    page = written(tmp_path, [matrix()])
    text = page.read_text(encoding="utf-8").replace("</body>", MENUS)
    page.write_text(text, encoding="utf-8")
    dom, messages = browse(page, "--dump-dom")
    assert messages == []
    hostile = HOSTILE.replace("&", "&amp;")
    said = f'data-menus="none|lqr; none|{hostile}; 2; {4 * np.sin(4.0):.3f}"'
    assert said in dom.replace("&lt;", "<").replace("&gt;", ">")


def test_browser_moves_the_cars_and_offers_the_track(tmp_path: Path) -> None:
    page = written(tmp_path, [matrix()])
    text = page.read_text(encoding="utf-8").replace("</body>", FRAMES)
    page.write_text(text, encoding="utf-8")
    dom, messages = browse(page, "--dump-dom")
    assert messages == []
    moved = re.search(r'data-moved="([-.\d]+) to ([-.\d]+)"', dom)
    assert moved is not None and float(moved[2]) - float(moved[1]) == pytest.approx(80.0, abs=0.1)
    link = re.search(r'<a download="run.kml" href="data:[^;]+;base64,([^"]+)"', dom)
    assert link is not None and base64.b64decode(link[1]).decode() == HOSTILE
    picture = tmp_path / "matrix.png"
    _, messages = browse(page, f"--screenshot={picture}", "--window-size=1280,3600")
    assert messages == []
    assert picture.stat().st_size > 50_000
