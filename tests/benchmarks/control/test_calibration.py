"""The clairvoyant's file: seeds of its own, stale entries refused by name, stopped runs go on."""

import dataclasses
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
    CalibrationRecord,
    ClairvoyantEpisode,
    _derive_seeds,
    _read_calibration,
    _update,
    calibrate,
    measure_foresight,
    read_current,
)
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import measure
from sideslip.benchmarks.control.tasks import NOMINAL, STATE, YAW, ControlTask

GUST = ControlTask("", YAW, "coms", "zero-slip", "gust")
SINE = ControlTask("", YAW, "coms", "zero-slip", "sine")


def solve(folder: Path, *tasks: ControlTask) -> list[CalibrationRecord]:
    """On two seeds, in this process."""
    return calibrate(folder / "made.json", tasks, 2, jobs=1)


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


@pytest.mark.parametrize("again", [(GUST, SINE), (SINE,)])
def test_a_stopped_run_goes_on(
    again: tuple[ControlTask, ...], asked: list[int], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Another run, of fewer tasks too, keeps what the stopped one finished."""
    path, seek = tmp_path / "made.json", calibration._solve

    def stopping(case: tuple[ControlTask, int]) -> ClairvoyantEpisode:
        if case[0] == SINE:
            raise KeyboardInterrupt
        return seek(case)

    monkeypatch.setattr(calibration, "_solve", stopping)
    with pytest.raises(KeyboardInterrupt):
        solve(tmp_path, GUST, SINE)
    assert not path.exists() and asked == _derive_seeds(GUST, 2)
    monkeypatch.setattr(calibration, "_solve", seek)
    records = solve(tmp_path, *again)
    assert asked == _derive_seeds(GUST, 2) + _derive_seeds(SINE, 2)  # each once
    written = _read_calibration(path)
    assert written[GUST].costs.tolist() == [seed % 10 for seed in _derive_seeds(GUST, 2)]
    assert written.keys() == {GUST, SINE} and [written[task] for task in again] == records
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match="an interval needs two seeds or more, got 1"):
        calibrate(path, [GUST], 1)


def test_a_file_keeps_other_entries(asked: list[int], tmp_path: Path) -> None:
    path = tmp_path / "clairvoyant.json"
    both = solve(tmp_path, GUST, SINE)
    _update(path, both)
    changed = dataclasses.replace(both[0], command="other")
    _update(path, [changed])
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
    _update(path, solve(tmp_path, GUST))
    spoiled = SPOILED[message](path.read_text())
    path.write_text(spoiled)
    stale = "is stale" in message
    for use in (
        (_read_calibration,) if stale else (_read_calibration, lambda path: _update(path, []))
    ):
        with pytest.raises(ValueError, match=message) as caught:
            use(path)
        assert str(caught.value).startswith(str(path)) and len(str(caught.value)) < 500
    assert path.read_text() == spoiled
    if stale:  # its other entries stay, and new ones can be written
        (made,) = solve(tmp_path, SINE)
        _update(path, [made])
        assert _read_calibration(path) == {SINE: made}


def test_where_the_plant_has_changed_the_file_is_stale(asked: list[int], tmp_path: Path) -> None:
    """Whatever its version: the uncontrolled car no longer costs what it did."""
    (entry,) = solve(tmp_path, GUST)
    path = tmp_path / "file"
    _update(path, [entry])
    assert read_current(path, [SINE]) == {}
    with pytest.raises(ValueError, match="file: gust, yaw is stale: the uncontrolled car costs"):
        read_current(path, [GUST])
    found = measure([(GUST, Entry("none"))], _derive_seeds(GUST, 2), jobs=1)
    none = found[GUST, Entry("none")].costs
    episodes = tuple(
        dataclasses.replace(episode, costs={"none": cost})
        for episode, cost in zip(entry.episodes, none.tolist(), strict=True)
    )
    _update(path, [dataclasses.replace(entry, episodes=episodes)])
    assert read_current(path, [GUST]).keys() == {GUST}


def test_oracle_state_is_paired_with_it_on_its_seeds() -> None:
    episodes = tuple(
        ClairvoyantEpisode(seed, 1.0 + seed % 10, "none", {}, {}, 0.0)
        for seed in _derive_seeds(GUST, 4)
    )
    made: dict[str, Any] = GUST.record | {"world_version": 1, "command": ""}
    entry = CalibrationRecord(**made, episodes=episodes)
    ahead = measure_foresight({GUST: entry}, jobs=1)
    case = ControlCase(GUST, Entry(STATE))
    costs = measure([case], _derive_seeds(GUST, 4), jobs=1)[case].costs
    expected = np.clip(np.log((costs + 0.001) / (entry.costs + 0.001)), -3.0, 3.0)
    assert ahead[GUST] == pytest.approx(expected)


@pytest.mark.long
def test_a_real_episode_is_no_dearer_than_the_rungs(tmp_path: Path) -> None:
    (entry,) = solve(tmp_path, SINE)
    for episode in entry.episodes:
        assert episode.cost == min(episode.costs.values())
        assert set(episode.costs) == {"none", NOMINAL, STATE, f"from {NOMINAL}", f"from {STATE}"}
