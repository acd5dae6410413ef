"""`sideslip tune estimator`: what it prints and writes, and each way to type it wrong."""

import sys
import tomllib
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("optuna")
from sideslip.benchmarks.tuning import estimator as tune_file
from sideslip.estimators.design import options
from tests.benchmarks.conftest import Run

from .test_refusals import SCENARIO, make_cached_simulation

FIG8 = ("bicycle-kf", "--scenario", SCENARIO)
ENTRY = {"estimator": "dakf", "sensors": "gps", "command": "", "q": {"beta": 1e-9}}


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call `sideslip tune estimator` in an empty folder; gives (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tune_file, "_simulate_case", make_cached_simulation())
    return partial(run, "tune", "estimator")


FEW = ("--trials", 8, "--seeds", 1, "--test-seeds", 2, "--jobs", 1)


def test_the_command_prints_and_writes_what_it_found(run: Run, tmp_path: Path) -> None:
    arguments = (*FIG8, *FEW, "--out", "found.toml")
    status, out, _ = run(*arguments, "--note", "a remark")
    assert status == 0 and "2 test seeds" in out and "q_beta" in out
    (entry,) = tomllib.loads((tmp_path / "found.toml").read_text())["tuning"]
    assert entry["command"] == (
        f"sideslip tune estimator bicycle-kf --scenario {SCENARIO} --trials 8 --seeds 1"
    )
    assert set(entry["q"]) == {"beta", "gamma"} and entry["note"] == "a remark"
    assert (tmp_path / "sideslip-tune.db").exists()
    run(*arguments)
    (again,) = options.read_tunings(tmp_path / "found.toml")
    assert again["q"] == entry["q"]  # there was nothing left to do


def test_write_changes_ours(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(options, "FILE", tmp_path / "shipped.toml")
    tune_file.update(options.FILE, ENTRY)
    assert run(*FIG8, *FEW, "--write")[0] == 0
    assert [e["estimator"] for e in options.read_tunings(options.FILE)] == ["dakf", "bicycle-kf"]


@pytest.mark.parametrize("missing", ["optuna", "cmaes"])
def test_without_the_extra_the_command_names_it(
    run: Run, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("estimator", "search"):
        monkeypatch.delitem(sys.modules, f"sideslip.benchmarks.tuning.{module}", raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    status, _, err = run(*FIG8, *FEW)
    assert status == 2 and "pip install 'sideslip[tune]'" in err
