"""Tuning: what is found is the best of what was tried, a search goes on, files stay whole."""

import dataclasses
import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("optuna")
import optuna

from sideslip.benchmarks.harness.drives import LoggedEpisode
from sideslip.benchmarks.tuning import estimator as tuning
from sideslip.benchmarks.tuning.estimator import EstimatorTuning
from sideslip.benchmarks.tuning.search import SearchOptions, load_study
from sideslip.estimators import make_estimator
from sideslip.estimators.design import options

SCENARIO = "tie-vision-fig8"


@pytest.fixture(scope="module")
def task() -> EstimatorTuning:
    return tuning.make_estimator_tuning("bicycle-kf", SCENARIO, seeds=2)


@pytest.fixture(scope="module")
def drives(task: EstimatorTuning) -> list[LoggedEpisode]:
    return tuning._simulate(task, task.seeds, "", SearchOptions(1, jobs=1))


def storage(folder: Path) -> str:
    return f"sqlite:///{folder}/study.db"


def search(task: EstimatorTuning, drives: list[LoggedEpisode], url: str, trials: int) -> Any:
    return tuning._search(task, drives, SearchOptions(trials, url, jobs=1))


def load(task: EstimatorTuning, url: str) -> optuna.Study:
    return load_study(task.study, task.search, SearchOptions(1, url))


def tried(task: EstimatorTuning, url: str) -> list[Any]:
    return load(task, url).trials


def test_error_is_the_mean_square_from_two_seconds_on(
    task: EstimatorTuning, drives: list[LoggedEpisode]
) -> None:
    found = {"q_beta": 1e-3, "q_gamma": 1e-2}
    for i, drive in enumerate(drives):
        filter_ = make_estimator("bicycle-kf", **(drive.facts | found))
        error = filter_.run(drive.log)["beta"] - drive.log.truth["beta"]
        wanted = np.mean(error[drive.log.time > 1.9995] ** 2)
        assert tuning._compute_squares(task, drives, found)[0, i] == pytest.approx(
            wanted, rel=1e-12
        )


def test_angles_are_compared_on_the_circle(
    task: EstimatorTuning, drives: list[LoggedEpisode]
) -> None:
    log = drives[0].log
    turned = dataclasses.replace(log, truth={"beta": log.truth["beta"] + 4.0 * np.pi})
    there, back = (
        tuning._compute_squares(task, [LoggedEpisode(each, drives[0].facts)], {})
        for each in (log, turned)
    )
    assert back == pytest.approx(there, rel=1e-9)


def test_found_is_the_best_that_was_tried(
    task: EstimatorTuning, drives: list[LoggedEpisode], tmp_path: Path
) -> None:
    url = storage(tmp_path)
    found = search(task, drives, url, 12)
    trials = tried(task, url)
    assert len(trials) == 12
    best = min(trials, key=lambda trial: trial.value)
    for name, value in found.items():
        low, high = task.search[name]
        assert low <= value <= high
        assert value == pytest.approx(best.params[name], rel=5e-3)  # three digits
    error = np.sqrt(tuning._compute_squares(task, drives, best.params).mean())
    assert best.value == pytest.approx(error, rel=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("sampler", ["cma", "tpe"])
def test_the_search_is_the_same_for_any_number_of_jobs(
    task: EstimatorTuning, drives: list[LoggedEpisode], tmp_path: Path, sampler: str
) -> None:
    found = []
    for jobs in (1, 2):
        options = SearchOptions(40, storage(tmp_path) + str(jobs), sampler, jobs=jobs)
        found.append(tuning._search(task, drives, options))
    assert found[0] == found[1]


@pytest.mark.long
def test_the_shipped_tuning_of_the_bicycle_model_is_found_again(tmp_path: Path) -> None:
    """Other seeds, another sampler, fewer trials: the minimum is flat, its error is the same."""
    task = tuning.make_estimator_tuning("bicycle-kf", "tie-vision-fig7", seeds=8)
    drives = tuning._simulate(task, range(8), "", SearchOptions(1, jobs=1))
    options = SearchOptions(120, storage(tmp_path), "tpe", seed=1, jobs=1)
    found = tuning._search(task, drives, options)
    error, shipped = (
        tuning._compute_squares(task, drives, numbers).mean() for numbers in (found, {})
    )
    assert error == pytest.approx(shipped, rel=0.02)


def test_a_stopped_search_goes_on(
    task: EstimatorTuning,
    drives: list[LoggedEpisode],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url, count = storage(tmp_path), iter(range(12))
    score = tuning._evaluate_trial

    def stopping(*arguments: Any) -> Any:
        if next(count) == 11:
            raise KeyboardInterrupt
        return score(*arguments)

    monkeypatch.setattr(tuning, "_evaluate_trial", stopping)
    with pytest.raises(KeyboardInterrupt):
        search(task, drives, url, 16)
    monkeypatch.setattr(tuning, "_evaluate_trial", score)
    kept = [trial.params for trial in tried(task, url) if trial.value is not None]
    assert len(kept) == 8  # a whole batch
    search(task, drives, url, 16)
    finished = [trial.params for trial in tried(task, url) if trial.value is not None]
    assert len(finished) == 16 and finished[:8] == kept
    assert len({tuple(params.values()) for params in finished}) == 16  # nothing is tried twice
    monkeypatch.setattr(tuning, "_evaluate_trial", lambda *_: pytest.fail("all is done"))
    search(task, drives, url, 16)


def test_a_diverging_filter_is_infinitely_wrong_and_says_why(tmp_path: Path) -> None:
    task = tuning.make_estimator_tuning(
        "multirate-residual-kf",
        SCENARIO,
        options={"q_gamma": 0.57, "q_psi": 2e-4, "q_y_l": 7e-5},
        search={"q_beta": (0.11, 0.13)},
        seeds=1,
    )
    (drive,) = tuning._simulate(task, task.seeds, "", SearchOptions(1, jobs=1))
    fast = [LoggedEpisode(drive.log, drive.facts | {"speed": 40.0})]
    with pytest.raises(ValueError, match="its error grows by a factor"):
        search(task, fast, storage(tmp_path), 3)
    assert [trial.value for trial in tried(task, storage(tmp_path))] == [np.inf] * 3


def test_a_study_is_of_one_question(task: EstimatorTuning) -> None:
    others = [
        dataclasses.replace(task, scenarios=("sine",)),
        dataclasses.replace(task, options={"delay": "ignore"}),
        dataclasses.replace(task, search={"q_beta": (1e-8, 1e2)}),
        dataclasses.replace(task, seeds=(1000,)),
    ]
    assert len({each.study for each in [task, *others]}) == 5


def test_everything_not_held_is_searched_and_noise_on_demand() -> None:
    task = tuning.make_estimator_tuning(
        "multirate-kf", SCENARIO, options={"q_psi": 1e-6}, noises={"psi_noise": (1e-4, 1e-2)}
    )
    assert list(task.search) == ["q_beta", "q_gamma", "q_y_l", "psi_noise"]
    assert task.search["psi_noise"] == (1e-4, 1e-2)
    assert (task.env_id, task.sensors, task.unit) == ("sideslip/YawVision-v0", "camera", "rad")


def test_the_table_shows_both_tunings_and_marks_the_end_of_a_range(tmp_path: Path) -> None:
    held = {"q_gamma": 1e-2}
    task = tuning.make_estimator_tuning(
        "bicycle-kf", SCENARIO, options=held, search={"q_beta": (1e-12, 1.2e-12)}, seeds=2
    )
    suite, found = tuning.run(task, SearchOptions(8, storage(tmp_path), jobs=1), 3)
    comparison, numbers = suite.tables
    assert comparison.columns == ("tuning", "2 training seeds", "3 test seeds")
    assert [row[0] for row in comparison.cells] == ["default", "found"]
    assert numbers.cells[0][0] == "q_beta" and "over default" in comparison.note
    entry = tuning.make_entry(task, found, "a command")
    assert entry["q"] == {"gamma": 1e-2, "beta": found["q_beta"]}
    assert numbers.cells[0][3] == "at its end"


ENTRY = {"estimator": "dakf", "sensors": "gps", "command": 'say "x"', "q": {"beta": 1e-9}}


def test_an_entry_is_replaced_and_its_note_and_the_others_stay(tmp_path: Path) -> None:
    path = tmp_path / "found.toml"
    by_hand = ENTRY | {"note": "chosen by hand"}
    by_hand.pop("command")
    tuning.update(path, by_hand)
    tuning.update(path, ENTRY)
    assert options.read_tunings(path) == [ENTRY]
    tuning.update(path, ENTRY | {"note": "why: \\ \u00e4"})
    tuning.update(path, ENTRY | {"sensors": "camera", "noise": {"psi_noise": 1.0}})
    path.write_text("# a remark\n" + path.read_text())
    tuning.update(path, ENTRY | {"q": {"beta": 2.0}, "command": "again"})
    first, second = options.read_tunings(path)
    assert first == ENTRY | {"q": {"beta": 2.0}, "command": "again", "note": "why: \\ \u00e4"}
    assert second == ENTRY | {"sensors": "camera", "noise": {"psi_noise": 1.0}}
    assert path.read_text().startswith("# a remark\n")


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "found.toml"
    tuning.update(path, ENTRY)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        tuning.update(path, ENTRY | {"q": {"beta": 3.0}})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["tuning = 1", "[[tuning]]\nq = {}", "][", "[[tuning]]\nq = 1"])
def test_a_file_that_is_none_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"bad\.toml is no file of tunings"):
        options.read_tunings(path)


@pytest.mark.smoke
@pytest.mark.parametrize(
    "entry", options.read_tunings(), ids=lambda e: f"{e['estimator']} {e['sensors']}"
)
def test_a_shipped_tuning_says_how_it_was_found(entry: dict[str, Any]) -> None:
    assert options.TUNINGS[entry["estimator"], entry["sensors"]] == entry["q"]
    assert all(value >= 0.0 for value in entry["q"].values())
    if "command" not in entry:
        assert entry["note"]  # why there is none
        return
    words = entry["command"].split()
    assert words[:4] == ["sideslip", "tune", "estimator", entry["estimator"]]
    held = [words[i + 1] for i, word in enumerate(words) if word == "--option"]
    for each in held:
        name, _, value = each.partition("=")
        assert entry["q"][name.removeprefix("q_")] == float(value)


def test_a_study_that_is_damaged_or_none_is_refused(task: EstimatorTuning, tmp_path: Path) -> None:
    study = optuna.create_study(storage=storage(tmp_path), study_name=task.study)
    study.add_trial(optuna.trial.create_trial(value=1.0))
    with pytest.raises(ValueError, match="holds something else"):
        load(task, storage(tmp_path))
    with (tmp_path / "study.db").open("r+b") as database:
        database.seek(2000)
        database.write(b"?" * 20000)
    with pytest.raises(ValueError, match="malformed"):
        load(task, storage(tmp_path))


def test_several_scenarios_count_alike() -> None:
    """Rows are scenarios, each as if it were alone; the objective is their geometric mean."""
    names = ("tie-vision-fig8", "sine")
    task = tuning.make_estimator_tuning("bicycle-kf", names, seeds=2)
    drives = tuning._simulate(task, task.seeds, "", SearchOptions(1, jobs=1))
    both = tuning._compute_squares(task, drives, {})
    alone = []
    for name in names:
        single = dataclasses.replace(task, scenarios=(name,))
        own = tuning._simulate(single, task.seeds, "", SearchOptions(1, jobs=1))
        alone.append(tuning._compute_squares(single, own, {})[0])
    assert np.array_equal(both, alone)
    roots = np.sqrt(np.mean(alone, axis=1))
    objective, _ = tuning._evaluate_trial(task, drives, {})
    assert objective == pytest.approx(np.sqrt(roots[0] * roots[1]))
    assert task.study != dataclasses.replace(task, scenarios=names[::-1]).study
    with pytest.raises(ValueError, match="scenarios are one or more, each once, got sine, sine"):
        tuning.make_estimator_tuning("bicycle-kf", ("sine", "sine"))
