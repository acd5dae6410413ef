"""The search for a contestant's options: a bad start is left, failures cost, it may be stopped."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("optuna")

from sideslip.agents.baselines import FILE, get_tuned_options, read_tuned
from sideslip.benchmarks.control.entries import ControlCase
from sideslip.benchmarks.control.run import NUMBERS, DriveResult
from sideslip.benchmarks.control.tasks import QUICK_LEAD_IN, ControlTask, make_tuning_seeds
from sideslip.benchmarks.tuning import controllers
from sideslip.benchmarks.tuning.controllers import (
    KINDS,
    SPACES,
    ControllerTuning,
    SearchNumber,
    _compute_objective,
    _run_entry,
    tune,
    write_tuned,
)
from sideslip.benchmarks.tuning.levels import (
    PARTS,
    _compare_parts,
    _convert_levels,
    _draw_drive,
    _get_levels,
    _run_filter,
    _search,
)
from sideslip.benchmarks.tuning.search import SearchOptions
from tests.benchmarks.conftest import Run

SHORT = ControlTask(scenario="sine-with-dwell")
SEEDS = tuple(make_tuning_seeds(2))


def task(
    *numbers: SearchNumber, name: str = "two-dof", seeds: tuple[int, ...] = SEEDS
) -> ControllerTuning:
    return ControllerTuning(name, "coms-model", (SHORT,), seeds, numbers)


def storage(folder: Path) -> str:
    return f"sqlite:///{folder}/study.db"


def test_a_planted_bad_weight_is_found_and_left(tmp_path: Path) -> None:
    """An LQR that may use a hundredth of the tyres' grip does nothing: the search leaves it."""
    planted = task(SearchNumber("grip", 0.01, 0.01, 1.0), name="lqr")
    log = tune(planted, SearchOptions(12, storage(tmp_path), jobs=1))
    assert len(log["trials"]) == 12
    assert log["trials"][0]["numbers"] == {"grip": 0.01}  # the start is the first trial
    assert log["start"] == log["trials"][0]["objective"]
    assert log["best"]["objective"] < log["start"] - 0.5
    assert log["best"]["numbers"]["grip"] > 0.1
    objective = _compute_objective(planted, SEEDS, log["options"]["controller"])
    assert objective == pytest.approx(log["best"]["objective"], abs=1e-4)
    assert "score" in controllers.make_suite(planted, log).text


def test_a_search_stopped_in_its_first_batch_begins_at_the_start_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Else a trial at random is reported as the start."""
    stops = iter([True, False])

    def fake(*_: Any) -> float:
        if next(stops, False):
            raise KeyboardInterrupt
        return 1.0

    monkeypatch.setattr(controllers, "_compute_objective", fake)
    monkeypatch.setattr(controllers, "_run_entry", lambda *_: DriveResult(np.zeros((1, 1))))
    search = task(SearchNumber("gain", 1.0, 0.1, 10.0)), SearchOptions(9, storage(tmp_path), jobs=1)
    with pytest.raises(KeyboardInterrupt):
        tune(*search)
    assert tune(*search)["trials"][0]["numbers"] == {"gain": 1.0}


def test_the_objective_is_minus_the_mean_score() -> None:
    gain = task(SearchNumber("gain", 1.0, 0.1, 10.0))
    nothing: dict[str, dict[str, Any]] = {"filter": {}, "controller": {}}
    costs = _run_entry(SHORT, "two-dof", nothing | {"controller": {"gain": 3.0}}, SEEDS).costs
    nominal = _run_entry(SHORT, "nominal", nothing, SEEDS).costs
    floor = SHORT.cost_floor
    wanted = np.log((costs + floor) / (nominal + floor)).mean()
    assert _compute_objective(gain, SEEDS, {"gain": 3.0}) == pytest.approx(wanted, rel=1e-12)


def test_an_adaptive_contestant_is_tuned_on_its_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which takes no option, and drives after a short lead-in."""
    asked: list[ControlCase] = []
    monkeypatch.setattr(controllers, "run_chunk", lambda x: asked.append(x.case))
    tuning = controllers.make_controller_tuning("adaptive-nmpc", "car-yaw", (1,))
    _run_entry(tuning.tasks[0], tuning.name, tuning._make_options(tuning.start), (1,))
    (case,) = asked
    assert case.entry.estimator == "joint" and case.estimate_options["options"] == {}
    assert case.agent_options["horizon"] == 0.5
    assert case.env_options["lead_in"] == QUICK_LEAD_IN


def test_a_drive_that_is_lost_alone_counts_two(monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(contest: ControlTask, name: str, *_: Any) -> DriveResult:
        numbers = np.zeros((2, len(NUMBERS)))
        numbers[:, NUMBERS.index("cost")] = [0.5, 900.0] if name == "two-dof" else 1.0
        numbers[:, NUMBERS.index("failure")] = [0.0, 1.0] if name == "two-dof" else 0.0
        return DriveResult(numbers)

    monkeypatch.setattr(controllers, "_run_entry", fake)
    controllers._drive_nominal.cache_clear()
    found = _compute_objective(task(SearchNumber("gain", 1.0, 0.1, 10.0)), SEEDS, {"gain": 1.0})
    controllers._drive_nominal.cache_clear()
    floor = SHORT.cost_floor
    assert found == pytest.approx(0.5 * (math.log((0.5 + floor) / (1.0 + floor)) + 2.0))


def test_what_cannot_be_designed_is_infinitely_dear(monkeypatch: pytest.MonkeyPatch) -> None:
    bad = task(SearchNumber("pole", 1.0, 0.1, 10.0))
    assert _compute_objective(bad, SEEDS, {"pole": -1.0}) == math.inf


def test_of_slow_entries_half_stops_early(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The rest goes on with new seeds, and is judged by the mean of all that it has driven."""
    asked: list[tuple[int, ...]] = []

    def fake(task: ControllerTuning, seeds: tuple[int, ...], found: dict[str, float]) -> float:
        asked.append(seeds)
        return abs(math.log(found["grip"] / 0.5)) + float(seeds[0] == first)

    monkeypatch.setattr(controllers, "_compute_objective", fake)
    monkeypatch.setattr(controllers, "_run_entry", lambda *_: DriveResult(np.zeros((1, 1))))
    slow = task(SearchNumber("grip", 0.9, 0.3, 1.0), name="mpc", seeds=tuple(make_tuning_seeds(16)))
    first = slow.seeds[0]
    log = tune(slow, SearchOptions(16, storage(tmp_path), jobs=1))
    parts = [slow.seeds[low:high] for low, high in ((0, 2), (2, 4), (4, 8), (8, 16))]
    assert [asked.count(part) for part in parts] == [16, 8, 4, 2]
    assert [row["seeds"] for row in log["trials"]].count(16) == 2
    assert log["trials"][0]["seeds"] < 16 and asked.count(slow.seeds) == 1
    assert log["start"] == pytest.approx(math.log(0.9 / 0.5) + 1.0, abs=1e-4)  # on all seeds
    best = log["best"]
    assert best["seeds"] == 16
    wanted = abs(math.log(best["numbers"]["grip"] / 0.5)) + 2 / 16
    assert best["objective"] == pytest.approx(wanted, abs=2e-3)  # numbers have three digits
    nearest = min(log["trials"], key=lambda row: abs(math.log(row["numbers"]["grip"] / 0.5)))
    assert best["numbers"] == nearest["numbers"]  # the best trial is never stopped


@pytest.mark.parametrize("kind", KINDS)
def test_every_class_has_contests_and_every_start_lies_within(kind: str) -> None:
    for name in SPACES:
        tuning = controllers.make_controller_tuning(name, kind, (1,))
        assert len(tuning.tasks) >= 3
        numbers = tuning.numbers
        assert all(0.0 < each.low <= each.start <= each.high for each in numbers)
        steers = any(each.steering for each in numbers)
        assert not (steers and kind not in controllers.STEERING)


def test_numbers_become_options() -> None:
    bandwidths = [SearchNumber(f"bandwidth.{i}", 5.0, 1.0, 9.0) for i in (0, 1)]
    numbers = (*bandwidths, SearchNumber("horizon", 30, 10, 60, is_integer=True))
    found = {"bandwidth.0": 2.0, "bandwidth.1": 3.0, "horizon": 20.4}
    task = controllers.ControllerTuning("lqr", "car-yaw", (), (0,), numbers)
    options = {"bandwidth": [2.0, 3.0], "horizon": 20}
    assert task._make_options(found) == {"filter": {}, "controller": options}


def test_options_are_written_beside_others_and_read(tmp_path: Path) -> None:
    path = tmp_path / "tuned.toml"
    options: dict[str, Any] = {"filter": {"force_sd": 1e-05}, "controller": {"bandwidth": [1, 2]}}
    write_tuned(path, "car-yaw", "lqr", options)
    write_tuned(path, "car-yaw", "model-following", {"filter": {}, "controller": {"grip": 0.5}})
    write_tuned(path, "car-yaw", "lqr", options | {"filter": {"force_sd": 2.5}})
    assert read_tuned(path)["car-yaw"] == {
        "lqr": {"filter": {"force_sd": 2.5}, "controller": {"bandwidth": [1, 2]}},
        "model-following": {"controller": {"grip": 0.5}},
    }
    for text in ("[", "a = 1", "[a.b]\nc = 1", "[a.b.filters]\nc = 1"):
        bad = tmp_path / f"{len(text)}.toml"
        bad.write_text(f"world_version = 1\n{text}")
        with pytest.raises(ValueError, match=rf"{len(text)}\.toml"):
            read_tuned(bad)


def test_what_was_tuned_in_another_world_is_refused(tmp_path: Path) -> None:
    for head, world in (("world_version = 7", 7), ("", 0)):
        path = tmp_path / f"{world}.toml"
        path.write_text(f"{head}\n[a.lqr.controller]\ngrip = 0.5\n")
        with pytest.raises(ValueError, match=rf"tuned in world {world}, this is 1: tune anew"):
            read_tuned(path)


def test_defaults_stand_where_nothing_was_tuned() -> None:
    assert get_tuned_options("coms-model", "nobody") == {"filter": {}, "controller": {}}
    for kind, names in read_tuned(FILE).items():
        for name, parts in names.items():
            log = json.loads((controllers.LOGS / f"{kind}.{name}.json").read_text())
            assert (log["class"], log["contestant"]) == (kind, name)
            assert {part: held for part, held in log["options"].items() if held} == parts
            whole = [row for row in log["trials"] if row["seeds"] == len(log["seeds"])]
            known = [row["objective"] for row in whole if row["objective"] is not None]
            assert log["best"]["objective"] == min(known) <= (log["start"] or math.inf)


def test_the_command_writes_both(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(controllers, "list_scored_tasks", lambda: [SHORT])
    few = ("--class", "coms-model", "--trials", 2, "--seeds", 1, "--jobs", 1)
    status, out, _ = run("tune", "controller", "two-dof", *few, "--out", "t.toml", "--log", "logs")
    assert status == 0 and "tuning seeds: score" in " ".join(out.split())
    log = json.loads(Path("logs/coms-model.two-dof.json").read_text())
    assert len(log["trials"]) == 2 and log["seeds"] == make_tuning_seeds(1)
    held = {part: options for part, options in log["options"].items() if options}
    assert read_tuned(Path("t.toml"))["coms-model"]["two-dof"] == held


def test_a_seed_is_a_drive_and_five_seeds_are_all_kinds_of_sensors() -> None:
    first, again = (_draw_drive(3, 4.0) for _ in range(2))
    assert np.array_equal(first.log.record.fast, again.log.record.fast)
    drives = [_draw_drive(seed, 4.0) for seed in range(5)]
    sensors = [" ".join(sorted(x.log.slow)) for x in drives]
    assert sensors == ["camera", "gps", "camera gps", "gps", ""]
    assert [x.log.record.dt for x in drives] == [0.001] * 3 + [0.01] * 2
    assert all(x.facts["vehicle"] != drives[0].facts["vehicle"] for x in drives[1:])
    for drive in drives:  # the levels in use are the defaults
        error, deviation = _run_filter(drive, _convert_levels(_get_levels(), drive.log))
        assert np.isfinite(error).all() and (deviation > 0.0).all()


def test_every_part_can_be_left_out() -> None:
    drive = _draw_drive(2, 3.0)
    whole = _run_filter(drive, {})[0]
    for name, options in list(PARTS.items())[1:]:
        assert not np.array_equal(_run_filter(drive, options)[0], whole), name


@pytest.mark.long
def test_levels_that_are_far_off_are_left(tmp_path: Path) -> None:
    start = _get_levels() | {"gyro_noise": 0.1, "force_share": 0.5}
    _, found, before = _search(start, 10, SearchOptions(36, storage(tmp_path), seed=1, jobs=1))
    assert found < before - 0.1


@pytest.mark.long
def test_the_table_of_parts_is_written(tmp_path) -> None:  # type: ignore[no-untyped-def]
    _compare_parts(3, tmp_path / "table.json", 1)
    assert "without tyres" in (tmp_path / "table.json").read_text()
