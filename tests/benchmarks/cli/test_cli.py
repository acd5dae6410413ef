"""The command line: what a newcomer types, and each way to type it wrong."""

import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from sideslip.benchmarks.cli import main as cli
from sideslip.benchmarks.cli.common import show_episode
from sideslip.benchmarks.cli.names import KINDS, complete
from sideslip.benchmarks.control import calibration
from sideslip.benchmarks.control.calibration import (
    CalibrationRecord,
    ClairvoyantEpisode,
    _derive_seeds,
    _read_calibration,
)
from sideslip.benchmarks.control.tasks import list_scored_tasks
from sideslip.benchmarks.suites import SUITES
from tests.benchmarks.conftest import Run

LQR = ("run", "--agent", "lqr", "--estimator", "exact-kf")


@pytest.mark.parametrize("kind", KINDS)
def test_there_is_a_line_on_each_name(run: Run, kind: str, monkeypatch: Any) -> None:
    """In 80 columns a name is whole, and shells complete it."""
    monkeypatch.setattr(cli, "console", Console(width=80))
    status, out, _ = run("list", kind)
    lines = KINDS[kind]()
    assert status == 0 and lines and all(len(line) > 3 for line in lines.values())
    assert {name for name in lines if f"\n{name}  " in out} == set(lines)
    assert max(map(len, out.splitlines())) <= 80
    first = next(iter(lines))
    assert (first, lines[first]) in list(complete(kind)(first[:-1]))
    assert not list(complete(kind)("no such"))


def test_run_takes_files_and_options(run: Run, tmp_path: Path) -> None:
    car, scenario = tmp_path / "car.toml", tmp_path / "short.json"
    car.write_text('base = "coms"\nfront_stiffness_axle = 11000.0\n')
    scenario.write_text('{"base": "gust", "duration": 0.2}')
    status, out, _ = run(
        *LQR, "--vehicle", car, "--scenario", scenario, "--option", "reference=model",
        "--agent-option", "grip=0.6", "--estimator-option", "q_beta=1e-4",
    )  # fmt: skip
    assert status == 0 and "on sideslip/YawVision-v0\nshort: 0.20 s" in out


def test_the_papers_own_pair_runs(run: Run, tmp_path: Path) -> None:
    """model-following reads dakf's disturbances and steers: neither needs to be asked for."""
    scenario = tmp_path / "short.toml"
    scenario.write_text('base = "dakf-fig6"\nduration = 0.2\n')
    status, out, err = run(
        "run", "--agent", "model-following", "--estimator", "dakf", "--scenario", scenario
    )
    assert status == 0 and "on sideslip/AfsYawFusion-v0\nshort: 0.20 s" in out
    assert "Warning" not in err


@pytest.mark.smoke
def test_list_names_everything(run: Run) -> None:
    status, out, _ = run("list")
    assert status == 0
    for name in ("sideslip/YawGps-v0", "tie-vision-fig7", "coms", "dakf", "two-dof", "estimation"):
        assert name in out


def test_an_episodes_line_stays_one_on_a_narrow_screen() -> None:
    class Drive(dict[str, Any]):
        log, cost, failed = SimpleNamespace(name="a-long-name"), 1.0, True

    written = io.StringIO()
    drive: Any = Drive(beta=np.zeros(2), t=np.ones(2))
    show_episode(Console(file=written, width=40), drive, "me")
    assert written.getvalue().splitlines()[0].endswith("mrad, FAILED")


def test_run_drives_an_episode_and_draws_it(run: Run, tmp_path: Path) -> None:
    picture, table = tmp_path / "drive.png", tmp_path / "drive.parquet"
    status, out, _ = run(
        "run", "--agent", "two-dof", "--estimator", "multirate-kf", "--scenario", "lane-change",
        "--plot", picture, "--parquet", table,
    )  # fmt: skip
    assert status == 0 and "lane-change" in out and "peak" in out
    assert f"wrote {picture}\nwrote {table}\n" in out
    assert picture.read_bytes()[:4] == b"\x89PNG" and table.exists()


def test_run_films_a_drive_with_another_beside(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    path, scenario = tmp_path / "drive.gif", tmp_path / "short.json"
    scenario.write_text('{"base": "low-friction", "duration": 0.5}')
    driven = ("run", "--agent", "feedforward", "--scenario", scenario, "--beside", "none")
    status, out, _ = run(*driven, "--video", path)
    assert status == 0 and "wrote " in out and "cost" in out
    assert path.read_bytes()[:6] == b"GIF89a" and len(list(tmp_path.iterdir())) == 2


def test_bench_without_a_name_runs_all_suites(run: Run, monkeypatch: Any) -> None:
    names: list[str] = []

    def run_suites(some: list[str], request: Any, study: Any) -> list[Any]:
        names.extend(some)
        return []

    monkeypatch.setattr(cli, "run_suites", run_suites)
    status, _, _ = run("bench", "--quick")
    assert status == 0 and {*SUITES} - {*names} == {"logs"}  # nothing was downloaded
    names.clear()
    status, _, _ = run("bench", "--quick", "--data", ".")
    assert status == 0 and names == list(SUITES)


@pytest.mark.long
def test_quick_bench_gives_rows_tables_and_report(run: Run, tmp_path: Path) -> None:
    names = {"--json": "rows.json", "--html": "report.html"}
    files = [part for flag, name in names.items() for part in (flag, tmp_path / name)]
    status, out, _ = run("bench", "estimation", "highway", "--episodes", 4, *files)
    assert status == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert {row["suite"] for row in rows} == {"estimation", "highway"}
    assert all(row["n"] >= 1 and row["value"] is not None for row in rows)
    assert "the bound" in out and "single-rate" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names.values())


FIRST = list_scored_tasks()[0]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder; the package's file is another one; nothing is solved."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(calibration, "FILE", tmp_path / "package" / "clairvoyant.json")
    (tmp_path / "package").mkdir()

    def stand_in(case: Any) -> ClairvoyantEpisode:
        return ClairvoyantEpisode(case[1], 1.0, "from none", {"none": 2.0}, {"none": "ok"}, 0.0)

    monkeypatch.setattr(calibration, "_solve", stand_in)
    return tmp_path


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        ((), "clairvoyant.json"),
        (("mine.json",), "mine.json"),
        (("--write",), "package/clairvoyant.json"),
    ],
)
def test_it_writes_beside(arguments: tuple[str, ...], written: str, run: Run, here: Path) -> None:
    status, out, _ = run("calibrate", *arguments, "--contest", FIRST.name, "--seeds", 2, "-j", 1)
    assert status == 0 and "wrote " in out
    assert files(here) == [written]
    (entry,) = _read_calibration(here / written).values()
    assert entry.task == FIRST and [e.seed for e in entry.episodes] == _derive_seeds(FIRST, 2)
    assert entry.command.startswith("sideslip calibrate")


def test_the_matrix_refuses_a_stale_file_before_it_drives(run: Run, here: Path) -> None:
    old = CalibrationRecord(*(FIRST.tier, FIRST.env_id, FIRST.vehicle, FIRST.reference,
                              FIRST.scenario),
                0, "by hand", ())  # fmt: skip
    (here / "old.json").write_text(json.dumps([vars(old)]))
    status, _, err = run("bench", "control", "--quick", "--clairvoyant", "old.json")
    assert status == 2
    assert f"{FIRST.name}, is stale: of world 0" in " ".join(err.split())
