"""The command line: what a newcomer types, and each way to type it wrong."""

import json
from pathlib import Path

import pytest

from sideslip.benchmarks.suites import SUITES
from tests.benchmarks.conftest import Run


@pytest.mark.smoke
def test_list_names_everything(run: Run) -> None:
    status, out, _ = run("list")
    assert status == 0
    for name in ("sideslip/YawGps-v0", "tie-vision-fig7", "coms", "dakf", "two-dof", "estimation"):
        assert name in out


def test_run_drives_an_episode_and_draws_it(run: Run, tmp_path: Path) -> None:
    picture, table = tmp_path / "drive.png", tmp_path / "drive.parquet"
    status, out, _ = run(
        "run", "--agent", "two-dof", "--estimator", "multirate-kf", "--scenario", "lane-change",
        "--plot", picture, "--parquet", table,
    )  # fmt: skip
    assert status == 0 and "lane-change" in out and "peak" in out
    assert picture.read_bytes()[:4] == b"\x89PNG" and table.exists()


def test_run_films_a_drive_with_another_beside(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    path = tmp_path / "drive.gif"
    status, out, _ = run(
        "run", "--agent", "feedforward", "--scenario", "low-friction", "--beside", "none",
        "--video", path,
    )  # fmt: skip
    assert status == 0 and "film: " in out and "cost" in out
    assert path.read_bytes()[:6] == b"GIF89a" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run", "--video", "film.avi"), "a film ends in .mp4 or .gif, got 'film.avi'"),
        (("run", "--beside", "none"), "'none' can only drive beside in a film: --video"),
        (("enjoy", "ppo-yaw-vision", "--video", "film.avi"), "a film ends in .mp4 or .gif"),
        (("run", "--scenario", "moon"), "unknown scenario 'moon'"),
        (("run", "--agent", "pid"), "unknown agent 'pid'"),
        (("run", "--estimator", "dakf"), "dakf needs the slow sensor gps"),
        (("run", "--agent", "two-dof"), "beta_hat"),
        (("bench", "weather"), "unknown suite weather"),
        (("replay", "nowhere.csv"), "nowhere.csv"),
        (("bench", "--log", "nowhere.csv"), "nowhere.csv"),
    ],
)
def test_a_mistake_is_one_line_that_names_it(
    run: Run, arguments: tuple[str, ...], said: str
) -> None:
    status, out, err = run(*arguments)
    assert status == 2
    assert said in " ".join(err.split()) and "Traceback" not in out + err


def test_an_unwritable_result_leaves_nothing(run: Run, tmp_path: Path) -> None:
    status, _, err = run("bench", "speed", "--json", tmp_path / "none" / "rows.json")
    assert status == 2 and "rows.json" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_quick_bench_gives_rows_tables_report_and_picture(run: Run, tmp_path: Path) -> None:
    names = {"--json": "rows.json", "--html": "report.html", "--picture": "bench.png"}
    files = [part for flag, name in names.items() for part in (flag, tmp_path / name)]
    status, out, _ = run("bench", "--quick", *files)
    assert status == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert {row["suite"] for row in rows} == set(SUITES)
    assert all(row["n"] >= 1 for row in rows)
    judged = [row for row in rows if row["suite"] != "procedures"]  # a spin has no ratio
    assert all(row["value"] is not None for row in judged)
    assert "the bound" in out and "single-rate" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names.values())
