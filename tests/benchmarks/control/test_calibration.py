"""Calibration: seeds of its own, entries that say what made them, runs that can be stopped."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("casadi")
pytest.importorskip("osqp")
from sideslip.agents.clairvoyant import plan as clairvoyant
from sideslip.agents.clairvoyant.plan import Ceiling
from sideslip.benchmarks.control.calibration import (
    calibrate,
    calibration_seeds,
    cases_of,
    forget,
    read_calibration,
    update,
)

ID = "sideslip/YawFusion-v0"


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds that a ceiling was sought for; its cost is the seed's last digit."""
    seeds: list[int] = []

    def stand_in(env: Any, seed: int, starts: Any) -> Ceiling:
        seeds.append(seed)
        cost = float(seed % 10)
        costs = {"none": 20.0, "from none": cost}
        return Ceiling(np.zeros((1, 1), np.float32), cost, "from none", costs, {"none": "ok"}, 0.0)

    monkeypatch.setattr(clairvoyant, "ceiling", stand_in)
    return seeds


def test_seeds_are_its_own() -> None:
    few, many = calibration_seeds(ID, "gust", 4), calibration_seeds(ID, "gust", 64)
    assert many[:4] == few and len(set(many)) == 64
    assert min(many) > 10**6
    assert not set(many) & set(calibration_seeds(ID, "sine", 64))


def test_means_and_errors_over_the_seeds(asked: list[int], tmp_path: Path) -> None:
    (entry,) = calibrate(["gust"], tmp_path / "cases", seeds=5, start="none", jobs=1, command="c")
    costs = [seed % 10 for seed in calibration_seeds(ID, "gust", 5)]
    assert entry.clairvoyant == pytest.approx(np.mean(costs))
    assert entry.clairvoyant_error == pytest.approx(np.std(costs, ddof=1) / 5**0.5)
    assert (entry.none, entry.none_error) == (20.0, 0.0)
    assert not entry.stale and dataclasses.replace(entry, sources="other").stale
    assert [episode.seed for episode in entry.episodes] == asked


def test_a_stopped_run_goes_on(asked: list[int], tmp_path: Path) -> None:
    calibrate(["gust"], tmp_path / "cases", seeds=3, start="none", jobs=1)
    (entry,) = calibrate(["gust"], tmp_path / "cases", seeds=5, start="none", jobs=1)
    assert asked == calibration_seeds(ID, "gust", 5)  # each once
    calibrate(["gust"], tmp_path / "cases", seeds=3, start="none", estimator="", jobs=1)
    assert len(asked) == 8  # another question
    assert len(entry.episodes) == 5
    folder = tmp_path / "cases"
    forget(cases_of(["gust"], folder, ID, 5, "none", "exact-kf"))
    assert len(list(folder.iterdir())) == 3  # the other question's
    forget(cases_of(["gust"], folder, ID, 3, "none", ""))
    assert not folder.exists()


def test_a_file_keeps_other_entries(asked: list[int], tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    both = calibrate(["gust", "sine"], tmp_path / "cases", seeds=2, start="none", jobs=1)
    update(path, both)
    changed = dataclasses.replace(both[0], none=7.0)
    update(path, [changed])
    assert read_calibration(path) == {(ID, "gust"): changed, (ID, "sine"): both[1]}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: "", "is no JSON, or is cut short"),
        (lambda text: text[: len(text) // 2], "is no JSON, or is cut short"),
        (lambda text: text[1:-2], "expected a JSON list of objects"),
        (lambda text: text.replace('"salt"', '"salted"'), "entry 1: unknown salted"),
        (lambda text: text.replace('"none_error": 0.0,', ""), "entry 1: missing none_error"),
        (lambda text: text.replace('"none": 20.0,', '"none": "20",', 1), "none is '20', not float"),
        (lambda text: text.replace('"winner": "from none",', ""), "episode 1: missing winner"),
        (lambda text: text.replace('"episodes"', '"others"'), "entry 1: episodes is no list"),
    ],
)
def test_a_file_that_lacks_something_is_refused_with_its_path(
    spoil: Callable[[str], str], message: str, asked: list[int], tmp_path: Path
) -> None:
    path = tmp_path / "calibration.json"
    update(path, calibrate(["gust"], tmp_path / "cases", seeds=2, start="none", jobs=1))
    spoiled = spoil(path.read_text())
    path.write_text(spoiled)
    for use in (read_calibration, lambda path: update(path, [])):
        with pytest.raises(ValueError, match=message) as caught:
            use(path)
        assert str(caught.value).startswith(str(path)) and len(str(caught.value)) < 500
    assert path.read_text() == spoiled


@pytest.mark.parametrize(
    "content",
    [
        *("", "{", "[]", "null", "{}", "[" * 99999),
        *(("winner", None), ("seed", 7), ("cost", "1"), ("cost", float("nan")), ("costs", {})),
    ],
    ids=range(11),
)
def test_a_damaged_case_is_sought_again(content: Any, asked: list[int], tmp_path: Path) -> None:
    first = calibrate(["gust"], tmp_path / "cases", seeds=2, start="none", jobs=1)
    path = next((tmp_path / "cases").iterdir())
    if isinstance(content, tuple):
        key, value = content
        content = json.dumps(json.loads(path.read_text()) | {key: value})
    path.write_text(content)
    assert calibrate(["gust"], tmp_path / "cases", seeds=2, start="none", jobs=1) == first
    assert len(asked) == 3
    assert calibrate(["gust"], tmp_path / "cases", seeds=2, start="none", jobs=1) == first
    assert len(asked) == 3  # the file is whole again


@pytest.mark.long
def test_a_real_episode(tmp_path: Path) -> None:
    (entry,) = calibrate(["lane-change"], tmp_path / "cases", seeds=2, jobs=1)
    for episode in entry.episodes:
        assert episode.cost == min(episode.costs.values())
        assert set(episode.costs) == {"none", "two-dof", "from none", "from two-dof"}
    assert entry.clairvoyant < entry.none


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown scenario loop"):
        calibrate(["loop"], tmp_path / "cases")
    with pytest.raises(ValueError, match="two seeds or more, got 1"):
        calibrate(["gust"], tmp_path / "cases", seeds=1)
