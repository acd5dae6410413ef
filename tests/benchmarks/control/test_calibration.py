"""The clairvoyant's file: seeds of its own, stale entries refused by name, stopped runs go on."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("casadi")
pytest.importorskip("osqp")
from sideslip.agents import baselines
from sideslip.agents.clairvoyant import plan as clairvoyant
from sideslip.agents.clairvoyant.plan import ClairvoyantResult
from sideslip.benchmarks.control import calibration
from sideslip.benchmarks.control.calibration import (
    Calibration,
    CalibrationRecord,
    _derive_seeds,
    _read_calibration,
    measure_regrets,
    read_current,
    update,
)
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import measure
from sideslip.benchmarks.control.tasks import NOMINAL, STATE, YAW, ControlTask

GUST = ControlTask("", YAW, "coms", "zero-slip", "gust")
SINE = ControlTask("", YAW, "coms", "zero-slip", "sine")


def calibrate(folder: Path, *tasks: ControlTask) -> list[CalibrationRecord]:
    """On two seeds, in this process."""
    return Calibration(tasks, folder / "cases", 2).run(jobs=1)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds that a ceiling was sought for; its cost is the seed's last digit."""
    seeds: list[int] = []

    def stand_in(env: Any, seed: int, starts: Any) -> ClairvoyantResult:
        assert set(starts) == {NOMINAL, STATE}
        seeds.append(seed)
        cost = float(seed % 10)
        costs, actions = {"none": 20.0, "from none": cost}, np.zeros((1, 1), np.float32)
        return ClairvoyantResult(actions, cost, "from none", costs, {"none": "ok"}, 0.0)

    monkeypatch.setattr(clairvoyant, "compute_clairvoyant", stand_in)
    monkeypatch.setattr(clairvoyant, "record_actions", lambda *_: np.zeros((1, 1)))
    monkeypatch.setattr(baselines, "make_oracle", lambda *_, **__: (None, None))
    return seeds


def test_seeds_are_its_own_and_follow_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    few, many = _derive_seeds(GUST, 4), _derive_seeds(GUST)
    assert many[:4] == few and len(set(many)) == 64
    assert min(many) > 10**6
    assert not set(many) & set(_derive_seeds(SINE))
    monkeypatch.setattr(calibration, "WORLD_VERSION", 999)
    assert not set(many) & set(_derive_seeds(GUST))


def test_a_stopped_run_goes_on(asked: list[int], tmp_path: Path) -> None:
    folder = tmp_path / "cases"
    Calibration([GUST], folder, 3).run(jobs=1)
    (entry,) = Calibration([GUST], folder, 5).run(jobs=1)
    assert asked == _derive_seeds(GUST, 5)  # each once
    assert entry.costs.tolist() == [seed % 10 for seed in asked]
    Calibration([SINE], folder, 3).run(jobs=1)
    assert len(asked) == 8  # another question
    Calibration([GUST], folder, 5).remove_cases()
    assert len(list(folder.iterdir())) == 3  # the other question's
    Calibration([SINE], folder, 3).remove_cases()
    assert not folder.exists()


def test_a_file_keeps_other_entries(asked: list[int], tmp_path: Path) -> None:
    path = tmp_path / "clairvoyant.json"
    both = calibrate(tmp_path, GUST, SINE)
    update(path, both)
    changed = dataclasses.replace(both[0], command="other")
    update(path, [changed])
    assert _read_calibration(path) == {GUST: changed, SINE: both[1]}


SPOILED: dict[str, Callable[[str], str]] = {
    "is no JSON, or is cut short": lambda text: text[: len(text) // 2],
    "expected a JSON list of objects": lambda text: text[1:-2],
    "entry 1: unknown asked": lambda text: text.replace('"command"', '"asked"'),
    "episode 1: missing winner": lambda text: text.replace('"winner": "from none",', ""),
    "entry 1: episodes is no list": lambda text: text.replace('"episodes"', '"others"'),
    "entry 1, gust, yaw, is stale: of world 99": lambda text: text.replace(
        '"world_version": ', '"world_version": 99'
    ),
    "slalom, yaw, is stale: its seeds are not": lambda text: text.replace("gust", "slalom"),
}


@pytest.mark.parametrize("message", SPOILED)
def test_a_file_that_does_not_fit_is_refused(
    message: str, asked: list[int], tmp_path: Path
) -> None:
    path = tmp_path / "clairvoyant.json"
    update(path, calibrate(tmp_path, GUST))
    spoiled = SPOILED[message](path.read_text())
    path.write_text(spoiled)
    stale = "is stale" in message
    for use in (
        (_read_calibration,) if stale else (_read_calibration, lambda path: update(path, []))
    ):
        with pytest.raises(ValueError, match=message) as caught:
            use(path)
        assert str(caught.value).startswith(str(path)) and len(str(caught.value)) < 500
    assert path.read_text() == spoiled
    if stale:  # its other entries stay, and new ones can be written
        (made,) = calibrate(tmp_path, SINE)
        update(path, [made])
        assert _read_calibration(path) == {SINE: made}


def test_where_the_plant_has_changed_the_file_is_stale(asked: list[int], tmp_path: Path) -> None:
    """Whatever its version: the uncontrolled car no longer costs what it did."""
    (entry,) = calibrate(tmp_path, GUST)
    path = tmp_path / "file"
    update(path, [entry])
    assert read_current(path, [SINE]) == {}
    with pytest.raises(ValueError, match="file: gust, yaw is stale: the uncontrolled car costs"):
        read_current(path, [GUST])
    found = measure([(GUST, Entry("none"))], _derive_seeds(GUST, 2), jobs=1)
    none = found[GUST, Entry("none")].costs
    episodes = tuple(
        dataclasses.replace(episode, costs={"none": cost})
        for episode, cost in zip(entry.episodes, none.tolist(), strict=True)
    )
    update(path, [dataclasses.replace(entry, episodes=episodes)])
    assert read_current(path, [GUST]).keys() == {GUST}


def test_everybody_is_paired_with_it_on_its_seeds(asked: list[int], tmp_path: Path) -> None:
    (entry,) = Calibration([GUST], tmp_path, 4).run(jobs=1)
    none = ControlCase(GUST, Entry("none"))
    changed = dataclasses.replace(GUST, changes={"reference": "model"})
    cases = [ControlCase(changed, Entry("none")), ControlCase(SINE, Entry("none"))]
    regrets, there = measure_regrets({GUST: entry}, cases, jobs=1)
    assert list(there) == [none]
    costs = measure([none], _derive_seeds(GUST, 4), jobs=1)[GUST, Entry("none")].costs
    expected = np.clip(np.log((costs + 0.001) / (entry.costs + 0.001)), -3.0, 3.0)
    assert regrets[none] == pytest.approx(expected)


@pytest.mark.parametrize(
    "content",
    [
        *("", "{", "[]", "null", "{}", "[" * 99999),
        *(("winner", None), ("seed", 7), ("cost", "1"), ("cost", float("nan")), ("costs", {})),
    ],
    ids=range(11),
)
def test_a_damaged_case_is_sought_again(content: Any, asked: list[int], tmp_path: Path) -> None:
    first = calibrate(tmp_path, GUST)
    path = next((tmp_path / "cases").iterdir())
    if isinstance(content, tuple):
        key, value = content
        content = json.dumps(json.loads(path.read_text()) | {key: value})
    path.write_text(content)
    assert calibrate(tmp_path, GUST) == first
    assert len(asked) == 3
    assert calibrate(tmp_path, GUST) == first
    assert len(asked) == 3  # the file is whole again


@pytest.mark.long
def test_a_real_episode_is_no_dearer_than_the_rungs(tmp_path: Path) -> None:
    (entry,) = calibrate(tmp_path, SINE)
    for episode in entry.episodes:
        assert episode.cost == min(episode.costs.values())
        assert set(episode.costs) == {"none", NOMINAL, STATE, f"from {NOMINAL}", f"from {STATE}"}
