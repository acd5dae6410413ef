"""The user's row is the one that the matrix would give, on seeds that are whose they should be."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sideslip
from sideslip.agents.baselines import GRIP, STEER_WEIGHT
from sideslip.benchmarks.control.entries import (
    REFERENCE_FILTER,
    ControlCase,
    Entry,
    select_quick_tasks,
)
from sideslip.benchmarks.control.run import NUMBERS, Chunk, DriveResult, Results, run_chunk
from sideslip.benchmarks.control.tables import make_main_table
from sideslip.benchmarks.control.tasks import (
    NOMINAL,
    STEERING,
    YAW,
    ControlTask,
    Seeds,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
)
from sideslip.benchmarks.entrants import challenge as challenge_module
from sideslip.benchmarks.entrants import score
from sideslip.benchmarks.entrants.challenge import (
    EPISODES,
    ComparisonRequest,
    make_user_entries,
    make_user_entry,
)
from sideslip.benchmarks.entrants.score import _compose_verdict, _make_sentence
from sideslip.envs.scenarios.manoeuvres import SCENARIOS
from tests.benchmarks.conftest import Run
from tests.policies import VISION

COST, FAILURE = NUMBERS.index("cost"), NUMBERS.index("failure")
PD = """
class Pd:
    def __init__(self, env):
        pass
"""
Driven = list[tuple[ControlCase, tuple[int, ...]]]


def wrapped(folder: Path, options: dict[str, Any]) -> str:
    """A user's file around the shipped LQR."""
    path = folder / "mine.py"
    path.write_text(
        "from sideslip.agents import Lqr\n\n\nclass Mine:\n"
        f"    def __init__(self, env):\n        self.inner = Lqr(env, **{options!r})\n\n"
        "    def predict(self, *observed, deterministic=True):\n"
        "        return self.inner.predict(*observed, deterministic=deterministic)\n"
    )
    return f"{path}:Mine"


@pytest.mark.long
def test_a_wrapped_controller_has_the_shipped_ones_row(tmp_path: Path, run: Run) -> None:
    """Bit for bit, by command and by `score`: LQR as it is designed is nominal."""
    contest = ControlTask("", YAW, "coms", "zero-slip", "gust")
    shipped, time = Entry(NOMINAL), SCENARIOS["gust"].disturbance_time
    mine = wrapped(tmp_path, {"disturbance_time": time, "grip": GRIP, "steer_weight": STEER_WEIGHT})
    rows = tmp_path / "rows.json"
    arguments = ("--scenario", "gust", "--env", YAW, "--episodes", 4, "--jobs", 1, "--json", rows)
    status, out, error = run("bench", "control", "--agent", mine, *arguments)
    assert status == 0, error
    number = {
        row["metric"]: row["value"]
        for row in json.loads(rows.read_text())
        if row["controller"] == mine and row["scenario"] == contest.name
    }
    seeds = tuple(make_task_seeds(make_salt(), 4)(contest))
    costs = run_chunk(Chunk(contest, shipped, seeds)).costs
    assert number["cost"] == np.mean(costs)
    assert number["score"] == 0.0 and number["cost_vs_nominal"] == 1.0
    words = " ".join(out.split())
    assert "costs 100 % [100, 100] of nominal where both finish, and wins 50 % of these" in words
    assert "Not publishable: 1 task x 4 episodes" in words
    found = sideslip.score(mine, YAW, scenarios="gust", episodes=4, jobs=1)
    assert (found.score.value, found.cost.value, found.won.value) == (0.0, 1.0, 0.5)
    assert (found.n, found.error) == (4, "") and f"{mine} on {REFERENCE_FILTER}" in repr(found)
    frame = found.to_pandas()
    assert isinstance(frame, pd.DataFrame)
    assert frame["cost"].tolist() == [number["cost_vs_nominal"]]
    assert frame["failures"].tolist() == [number["failure_rate"]]


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch) -> Driven:
    """Every cell that is to be driven with its seeds; none is. Whom the user brings costs half."""
    asked: Driven = []

    def stand_in(cells: Sequence[ControlCase], seeds: Seeds, **_: Any) -> Results:
        mine = [(c, tuple(seeds(c[0]) if callable(seeds) else seeds)) for c in cells]
        asked.extend(mine)
        return {cell: episodes(cell[1], len(each)) for cell, each in mine}

    monkeypatch.setattr(score, "measure", stand_in)
    monkeypatch.setattr(challenge_module, "measure", stand_in)
    return asked


def episodes(entry: Entry, n: int) -> DriveResult:
    levels = {NOMINAL: 4.0, "oracle-state": 1.0, "none": 20.0}
    numbers = np.zeros((n, len(NUMBERS)))
    numbers[:, COST] = levels.get(entry.agent, 2.0) * (1.0 + 0.1 * np.arange(n) % 3)
    numbers[: n // 3, FAILURE] = entry.agent.endswith("e.py")
    if "broken" in entry.agent:
        nothing = np.full_like(numbers, np.nan)
        return DriveResult(nothing, error="ValueError: no (pd.py, line 3)")
    return DriveResult(numbers)


def on_default(agent: str) -> Entry:
    return make_user_entry(agent, REFERENCE_FILTER)


def challenge(folder: Path, **options: Any) -> ComparisonRequest:
    (folder / "pd.py").write_text(PD)
    return ComparisonRequest((on_default(f"{folder}/pd.py:Pd"),), **options)


def on_file(folder: Path, monkeypatch: pytest.MonkeyPatch, change: float = 1.0) -> None:
    """A file of baselines with 8 episodes of a salt of its own, their costs times `change`."""
    monkeypatch.setattr(challenge_module, "FILE", folder / "baselines.json")
    monkeypatch.setattr(challenge_module, "EPISODES", 8)
    monkeypatch.setattr(challenge_module, "make_salt", lambda: "abcd")
    challenge_module._write_baselines(folder / "baselines.json")
    text = json.loads((folder / "baselines.json").read_text())
    for entry in text:
        entry["costs"] = [change * cost for cost in entry["costs"]]
    (folder / "baselines.json").write_text(json.dumps(text))


def salted(salt: str, n: int, cell: ControlCase) -> tuple[int, ...]:
    """A contest's test seeds."""
    return tuple(make_task_seeds(salt, n)(cell[0]))


def test_committed_baselines_serve_where_a_sample_costs_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driven: Driven
) -> None:
    on_file(tmp_path, monkeypatch)
    del driven[:]
    found = score._compare(challenge(tmp_path, episodes=8))
    assert found.on_file and found.salt == "abcd"
    mine = [(cell, seeds) for cell, seeds in driven if cell[1].is_users]
    assert mine and all(seeds == salted("abcd", 8, cell) for cell, seeds in mine)
    again = [(cell, seeds) for cell, seeds in driven if not cell[1].is_users]
    assert again and all(seeds == salted("abcd", 2, cell) for cell, seeds in again)
    assert {entry.agent for (_, entry), _ in again} == {NOMINAL, "oracle-state", "none", "esc"}
    assert "on file, a sample driven again" in _compose_verdict(found)


@pytest.mark.parametrize("why", ["costs", "episodes", "vehicle", "scenario", "seeds", "fresh"])
def test_otherwise_they_drive_anew_on_everybodys_seeds(
    why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driven: Driven
) -> None:
    on_file(tmp_path, monkeypatch, change=1.01 if why == "costs" else 1.0)
    changes: dict[str, dict[str, Any]] = {
        "episodes": {"episodes": 9},
        "vehicle": {"vehicle": {"base": "passenger-car", "mass": 900.0}},
        "scenario": {"scenarios": ({"base": "gust", "speed": 9.0},)},
        "seeds": {"seeds": (5, 6, 7)},
        "fresh": {"fresh": True},
    }
    options = changes.get(why, {})
    del driven[:]
    found = score._compare(challenge(tmp_path, **{"episodes": 8} | options))
    assert not found.on_file
    everyone = {cell: seeds for cell, seeds in driven}  # the last time
    assert set(everyone) == set(found.results)
    contests = {task for task, _ in everyone}
    assert len(set(everyone.values())) == (1 if why == "seeds" else len(contests))
    if why in ("costs", "episodes", "vehicle", "scenario"):
        salt = make_salt()
        assert all(seeds == salted(salt, len(seeds), cell) for cell, seeds in everyone.items())
    if why == "seeds":
        assert set(everyone.values()) == {(5, 6, 7)} and found.salt == ""
    if why == "vehicle":
        cars = [
            ControlCase(task, entry).env_options[car]
            for task, entry in everyone
            for car in ("vehicle", "nominal")
        ]
        assert {car["mass"] for car in cars} == {900.0}
    assert ("Publishable" in _compose_verdict(found)) == (why == "fresh")


def test_fresh_seeds_are_nobodys_to_foresee_and_can_be_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driven: Driven
) -> None:
    """Other ones each time; with the bytes that the driver drew, others for another file."""
    rehearsed = frozenset({str((tmp_path / "pd.py").resolve())})
    monkeypatch.setattr(score, "_find_opened_files", lambda *_: rehearsed)
    found = [score._compare(challenge(tmp_path, fresh=True)) for _ in range(2)]
    assert found[0].salt != found[1].salt
    again = score._compare(challenge(tmp_path, salt=found[0].salt))
    assert again.salt == found[0].salt and "Not publishable" in _compose_verdict(again)
    assert f"--salt {found[0].salt} repeats them" in _compose_verdict(found[0])
    mine = [seeds for cell, seeds in driven if cell[1].is_users]
    third = len(mine) // 3
    assert mine[:third] == mine[2 * third :] != mine[third : 2 * third]
    monkeypatch.setattr("secrets.token_hex", lambda n: "0" * 2 * n)
    salts = set()
    for text in (PD, PD + "# better\n"):
        (tmp_path / "pd.py").write_text(text)
        request = ComparisonRequest((on_default(f"{tmp_path}/pd.py"),), fresh=True)
        salts.add(score._compare(request).salt)
    assert len(salts) == 2


def test_the_verdict_has_a_sentence_each_in_five_lines(tmp_path: Path, driven: Driven) -> None:
    pairs = [on_default(f"{tmp_path}/{name}.py") for name in ("a", "broken", "c", "d", "e")]
    for pair in pairs:
        Path(pair.agent).write_text(PD)
    found = score._compare(ComparisonRequest(tuple(pairs), seeds=(1, 2, 3)))
    lines = _compose_verdict(found).splitlines()
    assert len(lines) == 5 and "2 more stand in the table" in lines[3]
    mine, fails, broken = (
        _make_sentence(next(x for x in found.overall if x.entry == pairs[i])) for i in (0, 4, 1)
    )
    assert lines[0] == f"Place 3 of 9: {mine}."
    assert "score 0.60 [0.60, 0.61], surely above nominal's 0, loses" in lines[0]
    assert "costs 50 % [50, 50] of nominal where both finish" in lines[0]
    assert "loses 0.0 % of the cars (nominal 0.0 %)," in lines[0]
    assert "loses 33.3 % of the cars (nominal 0.0 %), surely more" in fails
    assert "not driven: " in broken and broken.endswith("ValueError: no (pd.py, line 3)")
    cells = make_main_table("", found.overall, pairs).cells
    assert sum(line["label"].startswith("> ") for line in cells) == 5
    assert len(cells) == 5 + 4 + 1  # the line above who surely loses more


def test_an_agent_drives_on_the_estimators_and_these_under_lqr() -> None:
    assert make_user_entries(["esc"], []) == [on_default("esc")]
    found = make_user_entries(["esc", "two-dof"], ["dakf", ""])
    assert [(pair.agent, pair.estimator) for pair in found] == [
        *(("esc", "dakf"), ("esc", ""), ("two-dof", "dakf"), ("two-dof", "")),
        ("lqr", "dakf"),
    ]
    assert make_user_entries([VISION], [])[0].estimator == ""
    assert make_user_entries(["adaptive-lqr"], [])[0].estimator == "joint"


def test_contests_are_those_of_the_id() -> None:
    esc = (on_default("esc"),)
    assert ComparisonRequest(esc).tasks == select_quick_tasks(list_scored_tasks())
    steering = ComparisonRequest(esc, env_id=STEERING).tasks
    assert {contest.env_id for contest in steering} == {STEERING} and len(steering) == 3
    dirty = STEERING.replace("-v0", "-v1")  # the tasks' own world: the same tasks
    assert ComparisonRequest(esc, env_id=dirty).tasks == steering
    vision = list(ComparisonRequest(esc, env_id="sideslip/YawVision-v0").tasks)
    assert {contest.env_id for contest in vision} == {"sideslip/YawVision-v0"}
    assert [contest.tier for contest in vision] == ["small car", "road", "limit"]
    scored = list(ComparisonRequest(esc, scenarios=("road-slalom",)).tasks)
    assert scored and set(scored) <= set(list_scored_tasks())
    own = ComparisonRequest(esc, vehicle="passenger-car", scenarios=("gust",)).tasks
    assert {contest.reference for contest in own} == {"lagged"}
    gusts = [{"base": "gust", "name": name, "duration": s} for name, s in (("a", 1.0), ("b", 2.0))]
    assert len(ComparisonRequest(esc, scenarios=tuple(gusts)).tasks) == 4
    with pytest.raises(ValueError, match="two scenarios are called 'b': give each a name"):
        assert ComparisonRequest(esc, scenarios=(*gusts, gusts[0] | {"name": "b"})).tasks


def test_a_users_agent_has_nominals_filter_and_no_tuned_options() -> None:
    mine = on_default("my.py:Pd")
    case, nominal = ControlCase(ControlTask(), mine), ControlCase(ControlTask(), on_default("lqr"))
    assert case.options == {"filter": {}, "controller": {}}
    assert case.estimate_options == nominal.estimate_options
    assert mine.is_users and not on_default("esc").is_users and not on_default(NOMINAL).is_users


@pytest.mark.parametrize("name", ["nominal", "none", "lqr", "truth"])
@pytest.mark.parametrize("part", ["agent", "estimator"])
def test_an_object_called_as_the_packages_does_not_get_its_results(name: str, part: str) -> None:
    """Results are by name: nominal's class scored 0 whatever it did, truth's what oracles do."""
    parts: dict[str, Any] = {"agent": "lqr", "estimator": ""} | {part: type(name, (), {})}
    with pytest.raises(ValueError, match=f"{part} '{name}' is one of the package's: rename"):
        ComparisonRequest((make_user_entry(**parts),))


def test_trust_of_a_name_does_not_take_its_tuned_options_away() -> None:
    task, trusted = list_scored_tasks()[0], make_user_entry("lqr", REFERENCE_FILTER, trust=True)
    assert ControlCase(task, trusted).options == ControlCase(task, on_default("lqr")).options
    assert make_user_entry("model.zip", "", trust=True).trust


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "agent": ({"entries": (on_default("lqrr"),)}, "unknown agent 'lqrr'"),
    "estimator": ({"entries": (Entry("lqr", "dakff"),)}, "unknown estimator 'dakff'"),
    "truth": ({"entries": (Entry("lqr", "truth"),)}, "truth is what oracles are told"),
    "zip": ({"entries": (on_default("mine.zip"),)}, "mine.zip"),
    "file": ({"entries": (on_default("mine.py:A"),)}, "there is no file mine.py"),
    "id": ({"env_id": "YawFusion"}, "env"),
    "one episode": ({"episodes": 1}, "two episodes"),
    "no files": ({"fresh": True}, "there is none"),
    "vehicle": ({"vehicle": "comss"}, "comss"),
    "scenario": ({"scenarios": ({"bas": "gust"},)}, "bas"),
    "limit": ({"limit": 0.0}, "above 0"),
    "salt": ({"salt": "xyz"}, "hexadecimal"),
    "salt beside seeds": ({"salt": "ab", "seeds": (1, 2)}, "no others beside it"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_challenge_that_cannot_be_driven_is_refused_before_it_is(case: str) -> None:
    options, message = WRONG[case]
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=message):
        ComparisonRequest(**{"entries": (on_default("esc"),)} | options)


@pytest.mark.long
def test_the_baselines_on_file_still_cost_the_same() -> None:
    """Else: `python -m sideslip.benchmarks.entrants.challenge`."""
    cells = challenge_module.make_baseline_cases(select_quick_tasks(list_scored_tasks()))
    assert len(challenge_module._read_baselines()) == len(cells)
    assert challenge_module.find_baselines(cells, EPISODES) is not None
