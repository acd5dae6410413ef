"""`sideslip train-estimator`: what it leaves, and each way to type it wrong."""

from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("torch")
from sideslip.envs.sensors.slow import SENSOR_SETS
from sideslip.estimators import make_estimator
from sideslip.estimators.learned.correction_file import load_correction
from tests.benchmarks.conftest import Run


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call `sideslip train-estimator` in an empty folder; gives (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    return partial(run, "train-estimator")


def test_the_file_names_its_filter_and_its_command(run: Run) -> None:
    tiny = ("--scenarios", "sine-with-dwell", "--episodes", 1, "--epochs", 1)
    status, out, err = run("mine", *tiny, "--base", "joint", "--option", "force_sd=30", "--seed", 3)
    assert status == 0, err
    assert "rmse on held-out seeds" in out and "mine.safetensors" in out
    card = load_correction("mine.safetensors").card
    assert (card.base, card.seed, *card.scenarios) == ("joint", 3, "sine-with-dwell")
    assert "front_tyres" in card.states and card.base_options["force_sd"] == 30.0
    assert card.command.endswith("--base joint --option force_sd=30 --seed 3")
    both = SENSOR_SETS["fusion"]
    found = make_estimator("learned", file="mine.safetensors", sensors=both)
    assert "rear_tyres" in found.names
