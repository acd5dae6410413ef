"""`sideslip calibrate`: beside the user, never into the package unless asked; what it refuses."""

import json
from pathlib import Path
from typing import Any

import pytest

from sideslip.benchmarks.control import calibration
from sideslip.benchmarks.control.calibration import (
    CalibrationRecord,
    ClairvoyantEpisode,
    _derive_seeds,
    _read_calibration,
)
from sideslip.benchmarks.control.tasks import list_scored_tasks
from tests.benchmarks.conftest import Run

FIRST = list_scored_tasks()[0]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder; the package's file is another one; nothing is solved."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(calibration, "FILE", tmp_path / "package" / "clairvoyant.json")
    (tmp_path / "package").mkdir()

    def stand_in(case: Any) -> ClairvoyantEpisode:
        return ClairvoyantEpisode(case.seed, 1.0, "from none", {"none": 2.0}, {"none": "ok"}, 0.0)

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
