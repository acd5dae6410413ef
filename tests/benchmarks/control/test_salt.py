"""The salt: it follows whoever could have tuned on the test seeds, and its seeds are driven."""

import hashlib
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.agents.learned.network import SUFFIX
from sideslip.agents.rollout import rollout
from sideslip.benchmarks import readme
from sideslip.benchmarks.control import calibration, run, tasks
from sideslip.benchmarks.control.entries import ControlCase, Entry
from sideslip.benchmarks.control.run import NUMBERS, DriveResult, measure
from sideslip.benchmarks.control.tasks import (
    ControlTask,
    list_candidates,
    list_scored_tasks,
    make_salt,
    make_salted_seeds,
    make_task_seeds,
    make_tuning_seeds,
)
from sideslip.benchmarks.report import study
from sideslip.benchmarks.suites import SALTED, SUITES, Request, run_suites

ONE, OTHER = "0123456789abcdef", "fedcba9876543210"
SHORT = {"base": "gust", "duration": 0.5}
GUST = ControlTask(scenario="gust")
SHORTENED = ControlTask(scenario="gust", changes={"scenario": SHORT})
NONE, SLOW = (ControlCase(SHORTENED, Entry(who)) for who in ("none", "mpc"))


@pytest.mark.parametrize("salt", [ONE, OTHER])
def test_the_episodes_are_those_of_the_salt(salt: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order and across chunks: each costs what the env alone does on that seed."""
    monkeypatch.setattr(run, "CHUNK", 3)
    costs = measure([NONE], make_salted_seeds(salt, 5), jobs=1)[NONE].costs
    env = gym.make(GUST.env_id, scenario=SHORT)
    alone = [rollout(env, None, seed).cost for seed in make_salted_seeds(salt, 5)]
    assert costs == pytest.approx(alone, rel=1e-12)
    assert len(set(costs)) == 5


def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The cases that are to be driven from now on; none is, and all numbers are 1."""
    cases: list[Any] = []

    def stand_in(function: Any, chunks: Any, *_: Any) -> list[DriveResult]:
        cases.extend((function, chunk) for chunk in chunks)
        return [DriveResult(np.ones((len(chunk.seeds), len(NUMBERS)))) for chunk in chunks]

    monkeypatch.setattr(run, "run_cases", stand_in)
    return cases


def test_everybody_drives_the_same_seeds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Slow controllers the first ones."""
    cases = asked(monkeypatch)
    first = make_salted_seeds(ONE, 300)
    measure([NONE, SLOW], first, keep=tmp_path)
    driven: dict[ControlCase, list[int]] = {}
    for kept, chunk in cases:
        driven.setdefault(chunk.case, []).extend(chunk.seeds)
        assert kept.folder == tmp_path
    assert driven == {NONE: first, SLOW: first[:64]}


def test_contests_share_no_car(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interval over contests takes them for independent, and a seed draws the car."""
    cases = asked(monkeypatch)
    scored = list_scored_tasks()[:6]
    cells = [(each, Entry(who)) for each in scored for who in ("none", "nominal")]
    measure(cells, make_task_seeds(ONE, 50))
    driven: dict[ControlTask, set[tuple[int, ...]]] = {}
    for _, chunk in cases:
        driven.setdefault(chunk.task, set()).add(chunk.seeds)
    assert all(len(mine) == 1 for mine in driven.values())  # in a contest everybody the same
    every = [seed for mine in driven.values() for own in mine for seed in own]
    assert len(set(every)) == len(every) == 6 * 50


@pytest.mark.parametrize("name", [*SALTED, "readme"])
def test_a_suite_drives_the_salt_it_is_given(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows from before and after a change of the sources compare; without one it follows them."""
    found: list[list[int]] = []

    def stand_in(cells: list[ControlCase], seeds: Any, **_: Any) -> None:
        found.append(seeds(GUST)[:4])
        raise StopIteration

    module = import_module(SUITES.get(name, ".readme"), "sideslip.benchmarks")
    monkeypatch.setattr(module, "measure", stand_in)
    monkeypatch.setattr(study, "find_spec", lambda _: True)
    monkeypatch.setattr(module, "read_current", lambda *_: {}, raising=False)
    for salt in (ONE, OTHER, ""):
        with pytest.raises(StopIteration):
            if module is readme:
                readme._measure_entries(salt or make_salt())
            run_suites([name], Request(quick=True, episodes=4, salt=salt))
    salts = (ONE, OTHER, make_salt())
    assert found == [make_salted_seeds(salt, 4, GUST.seed_text) for salt in salts]


def test_the_salt_follows_entries_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contestants = (
        *("estimators/core/a.py", "estimators/b.toml", "agents/c/d.py"),
        *(f"agents/e{SUFFIX}", f"estimators/learned/h{SUFFIX}"),
    )
    others = ("envs/f.py", "benchmarks/g.py", "agents/notes.md")
    for name in contestants + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("one")
    monkeypatch.setattr(tasks, "_PACKAGE", tmp_path)
    salts = [make_salt()]
    for name in contestants:
        (tmp_path / name).write_text("two")
        salts.append(make_salt())
    assert len(set(salts)) == 1 + len(contestants)
    for name in others:
        (tmp_path / name).write_text("two")
    assert make_salt() == salts[-1]
    (tmp_path / contestants[0]).rename(tmp_path / "estimators/core/renamed.py")
    assert make_salt() not in salts


def test_the_contestants_are_this_packages() -> None:
    """Where `tasks.py` lies must not decide it."""
    assert Path(sideslip.__file__ or "").resolve().parent == tasks._PACKAGE
    for folder in tasks._ENTRY_SOURCES:
        assert (tasks._PACKAGE / folder / "__init__.py").is_file()


@pytest.mark.parametrize("salt", ["", "not a salt", "0xab", "AB", "-1"])
def test_a_salt_that_is_none_is_refused(salt: str) -> None:
    with pytest.raises(ValueError, match="a salt is hexadecimal digits, got"):
        make_salted_seeds(salt, 3)


def test_seeds_follow_the_salt_and_only_grow() -> None:
    salt = make_salt()
    assert salt == make_salt() and salt != make_salt("more")
    assert make_salted_seeds(salt, 10) == make_salted_seeds(salt, 30)[:10]
    assert make_salted_seeds(make_salt("more"), 10) != make_salted_seeds(salt, 10)
    assert len(set(make_salted_seeds(salt, 1000))) == 1000
    assert not set(make_salted_seeds(salt, 1000)) & set(make_tuning_seeds(64))


def digest(seeds: list[list[int]]) -> str:
    """A hash of seeds with their type and shape."""
    array = np.array(seeds, np.uint32)
    typed = f"{array.dtype.str}{array.shape}".encode() + array.tobytes()
    return hashlib.sha256(typed).hexdigest()[:16]


def test_seeds_stay_whatever_the_fields_of_a_contest_are_called() -> None:
    """The files of calibrations and baselines hold costs on these seeds."""
    every = [ControlTask(), *list_candidates()]
    drawn = [make_task_seeds(ONE, 4)(each) for each in every]
    assert digest(drawn) == "e42c9b2fc4da0ad9"
    assert digest([calibration._derive_seeds(each, 4) for each in every]) == "b87f03b3d2e8a2ff"


def test_tuning_seeds_are_nobody_elses() -> None:
    """Suites and users count theirs from 0: what they look at, nobody tuned on."""
    tuned = make_tuning_seeds(4096)
    assert tuned[:64] == make_tuning_seeds(64) and len(set(tuned)) == 4096
    for first in (0, calibration._FIRST):
        assert set(tuned).isdisjoint(range(first, first + 2**20))
