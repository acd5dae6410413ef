"""`sideslip tune estimator`: what it prints and writes, and each way to type it wrong."""

import sys
import tomllib
from functools import partial
from pathlib import Path

import pytest

from sideslip.benchmarks.tuning import estimator as tune_file
from sideslip.benchmarks.tuning import study as tune_study
from sideslip.estimators.design import options
from tests.benchmarks.conftest import Run

SCENARIO = "tie-vision-fig8"
ENTRY = {"estimator": "dakf", "sensors": "gps", "command": "", "q": {"beta": 1e-9}}
pytest.importorskip("optuna")


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call `sideslip tune estimator` in an empty folder; gives (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    return partial(run, "tune", "estimator")


FEW = ("--trials", 8, "--seeds", 1, "--test-seeds", 2, "--jobs", 1)


def test_the_command_prints_and_writes_what_it_found(run: Run, tmp_path: Path) -> None:
    arguments = ("bicycle-kf", "--scenario", SCENARIO, *FEW, "--out", "found.toml")
    status, out, _ = run(*arguments, "--note", "a remark")
    assert status == 0 and "2 test seeds" in out and "q_beta" in out
    (entry,) = tomllib.loads((tmp_path / "found.toml").read_text())["tuning"]
    assert entry["command"] == (
        f"sideslip tune estimator bicycle-kf --scenario {SCENARIO} --trials 8 --seeds 1"
    )
    assert set(entry["q"]) == {"beta", "gamma"} and entry["note"] == "a remark"
    assert (tmp_path / "sideslip-tune.db").exists()
    run(*arguments)
    assert options.read_tunings(tmp_path / "found.toml") == [entry]  # there was nothing left to do


def test_write_changes_the_shipped_file(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(options, "FILE", tmp_path / "shipped.toml")
    tune_file.update(options.FILE, ENTRY)
    assert run("bicycle-kf", "--scenario", SCENARIO, *FEW, "--write")[0] == 0
    assert [e["estimator"] for e in options.read_tunings(options.FILE)] == ["dakf", "bicycle-kf"]


FIG8 = ("bicycle-kf", "--scenario", SCENARIO)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("kalman", "--scenario", SCENARIO), "unknown estimator 'kalman'"),
        (("dafk", "--scenario", SCENARIO), "did you mean 'dakf'"),
        (("dakf", "--scenario", "moon"), "unknown scenario 'moon'"),
        (("dakf", "--scenario", "sine", "--env", "sideslip/YawVision-v0"), "slow sensor gps"),
        (("dakf", "--scenario", "sine", "--env", "sideslip/Nowhere-v0"), "Nowhere"),
        ((*FIG8, "--trials", "0"), "trials must be at least 1, got 0"),
        ((*FIG8, "--seeds", "0"), "seeds must be at least 1, got 0"),
        ((*FIG8, "--test-seeds", "0"), "test seeds are 1 to 1000, got 0"),
        ((*FIG8, "--target", "phi"), "bicycle-kf has no phi; a target is one of beta, gamma"),
        ((*FIG8, "--sampler", "grid"), "unknown sampler 'grid'; known: cma, tpe"),
        ((*FIG8, "--option", "q_beta"), "an option is NAME=VALUE, got 'q_beta'"),
        ((*FIG8, "--option", "colour=red"), "bicycle-kf: unknown option 'colour'"),
        ((*FIG8, "--search", "q_psi"), "bicycle-kf: unknown option 'q_psi'"),
        ((*FIG8, "--search", "q_beta=1"), "NAME or NAME=LOW:HIGH, got 'q_beta=1'"),
        ((*FIG8, "--search", "q_beta=2:1"), "0 < LOW < HIGH, got 2.0:1.0"),
        ((*FIG8, "--option", "q_beta=1", "--search", "q_beta"), "both held and searched"),
        ((*FIG8, "--noise", "gyro_noise", "--write"), "--out writes the others"),
        ((*FIG8, "--storage", "sqlite:////nowhere/at/all.db"), "unable to open database file"),
        (
            (*FIG8, "--storage", "moon://user:secret@host/x"),
            "storage failed (moon://user:***@host/x",
        ),
        ((*FIG8, "--out", "nowhere/found.toml"), "nowhere/found.toml"),
    ],
)
def test_a_mistake_is_one_line_that_names_it(
    run: Run, arguments: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    status, out, err = run(*FEW[2:], *arguments)
    assert status == 2
    assert said in " ".join(err.split()) and "secret" not in err
    assert err.count("\n") == 1 and "Traceback" not in out + err
    assert not list(tmp_path.glob("*.toml"))


def test_a_storage_that_is_no_database_is_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "study.db").write_bytes(b"not a database at all" * 100)
    status, _, err = run(*FIG8, "--storage", "study.db")
    assert status == 2 and "file is not a database" in err and err.count("\n") == 1


@pytest.mark.parametrize("missing", ["optuna", "cmaes"])
def test_without_the_extra_the_command_names_it(
    run: Run, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, tune_study.__name__)
    monkeypatch.setitem(sys.modules, missing, None)
    status, _, err = run(*FIG8, *FEW)
    assert status == 2 and "pip install 'sideslip[tune]'" in err
