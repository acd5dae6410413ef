"""The tables and numbers of README and docs/results/benchmark.md are those of their files."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.benchmarks import readme
from sideslip.benchmarks.control.run import NUMBERS, DriveResult
from sideslip.benchmarks.control.tasks import STEERING, TITLES, list_scored_tasks
from sideslip.benchmarks.harness.results import ResultRow, read_json
from sideslip.benchmarks.papers.ledger import join_numbers
from sideslip.benchmarks.papers.manoeuvres import BOUND, make_filters
from sideslip.benchmarks.report.study import LETTERS, LINES, Request
from sideslip.benchmarks.studies import estimation, traffic
from sideslip.envs.task import COLLISION, DEPARTURE, RUNNING, SPIN

ROOT = Path(readme.__file__ or "").resolve().parents[1]


def test_the_tables_are_made_from_their_files() -> None:
    rows, transfer = (read_json(ROOT / path) for path in (readme.ROWS, readme.TRANSFER))
    pages = {readme.README: readme._make_table(rows, transfer)}
    doubled = readme._make_doubled_table(rows)
    pages[readme.PAGE] = readme._make_task_table(rows)
    pages[readme.PAPERS] = readme._make_system_table(read_json(ROOT / readme.SYSTEM_ROWS))
    for path, made in pages.items():
        text = (ROOT / path).read_text()
        assert readme._replace_table(text, made) == text
        assert path != readme.PAGE or readme._replace_table(text, doubled) == text
        episodes = readme.SYSTEM_EPISODES if path == readme.PAPERS else readme.EPISODES
        assert re.search(rf"\b{episodes} (drives|seeds)\b", text)


def test_the_readme_is_a_door() -> None:
    """At most 900 words; its table has nine rows at most."""
    text = (ROOT / readme.README).read_text()
    assert len(text.split()) <= 900
    assert len(readme.ENTRIES) <= 9


def test_the_headline_numbers_of_the_readme_are_their_files() -> None:
    """`python -m sideslip.benchmarks.tuning.levels parts --out docs/next_car.json` writes one of
    them, `sideslip bench speed --json docs/speed.json` another."""
    table = json.loads((ROOT / "docs/next_car.json").read_text())
    key, speeds = ("YawFusion-v1 x 1024", "us_per_step"), read_json(ROOT / "docs/speed.json")
    (step,) = (row.value for row in speeds if (row.scenario, row.metric) == key)
    cells = readme._read_cells(read_json(ROOT / readme.ROWS))
    (best, best_lost), (tuned, tuned_lost) = (
        [
            [round(100.0 * cells[f"tier {tier}", *readme.ENTRIES[name][0], metric].value)
             for tier in ("road", "limit")]
            for metric in readme.METRICS[:2]
        ]
        for name in ("`adaptive-nmpc` on `joint`", "tuned LQG: `lqr` on `exact-kf`")
    )  # fmt: skip
    text = " ".join((ROOT / readme.README).read_text().split())
    for line in (
        f"costs {best[0]} % of untuned LQG on the road and {best[1]} % at the limit. Tuned LQG "
        f"costs {tuned[0]} and {tuned[1]} %. At the limit MPC loses {best_lost[1]} % of the "
        f"cars, tuned LQG {tuned_lost[1]} %.",
        f"On {table['n']} of them it errs {table['rows'][0]['rms / deg']:.2f} deg (RMS), and its "
        f"95 % interval holds {table['rows'][0]['in 95 % / %']:.0f} % of the time.",
        f"A 10 ms step takes {step:.1f} us of CPU time a car in a batch of 1,024.",
    ):
        assert line in text


def test_a_line_has_cost_and_cars_lost_in_every_tier_and_what_is_transferred() -> None:
    cost = ResultRow("control", "tier road", "cost_vs_nominal", 0.5, "", "none", 0.4, 0.6, 12)
    rows = [cost, replace(cost, metric="failure_rate", value=0.07)]
    rows += [replace(row, scenario="tier limit", controller="esc") for row in rows]
    far = replace(cost, scenario="fmvss-126 passenger-car", metric="amplitude", value=3.5)
    lines = readme._make_table(rows, [far]).splitlines()
    assert lines[0].startswith("| | small car, 18-28 km/h | road, ") and len(TITLES) == 3
    (line,) = (line for line in lines if line.startswith("| no control"))
    assert line == "| no control |  | 50 (7) |  | 3.5 |  |"
    assert any("`lqr` on" in line and line.endswith("| 100 |") for line in lines)
    with pytest.raises(ValueError, match="no table that begins with"):
        readme._replace_table("# a README", line)


def test_a_paper_filter_is_measured_as_its_own_simulation_has_it() -> None:
    """On the paper's ground its error is the ledger's, and the informed filter errs least."""
    system = next(x for x in readme.SYSTEMS if x.paper == "dual-rate")
    shown, joint, informed = system.measure(range(2), None)
    (drives,) = (x for x in system.simulations if x.name == "dual-rate-fig4")
    numbers = join_numbers(drives.run((0, 1)))
    np.testing.assert_array_equal(shown, numbers["pseudo measurement", "beta"])
    assert (informed < np.minimum(shown, joint)).all()


def test_a_task_has_a_line_with_intervals() -> None:
    task = next(task for task in list_scored_tasks() if task.env_id == STEERING)
    cost = ResultRow("control", task.name, "cost_vs_nominal", 0.5, "", "none", 0.4, 0.6, 12)
    rows = [cost, replace(cost, metric="failure_rate", value=0.07)]
    (line,) = (x for x in readme._make_task_table(rows).splitlines() if "50 [" in x)
    assert line.startswith(f"| {task.scenario} |") and "| 50 [40, 60] (7) |" in line


def test_an_entry_that_cannot_drive_makes_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = DriveResult(np.zeros((0, len(NUMBERS))), error="no action")
    monkeypatch.setattr(readme, "measure", lambda x, *_, **__: dict.fromkeys(x, wrong))
    with pytest.raises(ValueError, match=r"in .*: no action"):
        readme._measure_entries("ab12")


def _ratio(numbers: estimation.JoinedNumbers, of: str, to: str) -> float:
    return float(np.sqrt(numbers[of, "square"].mean() / numbers[to, "square"].mean()))


def test_dakf_beats_the_kalman_filter() -> None:
    """dakf-stability: DAKF < KF, at most 0.75 of its error."""
    numbers = join_numbers(estimation.EXPERIMENTS[1].simulation.run(range(8)))
    assert _ratio(numbers, "dakf", "course-kf") <= 0.75


@pytest.mark.long
def test_exact_filter_of_the_true_model_is_at_the_bound() -> None:
    """tie-vision-fig7: within 3 % of the bound; the others in the paper's order where true."""
    (numbers, _), _ = estimation.STUDY.measure(Request(episodes=40))
    assert _ratio(numbers, estimation.TRUE_MODEL, BOUND) == pytest.approx(1.0, rel=0.03)
    for other in ("single-rate-kf", "multirate-kf", "multirate-residual-kf"):
        assert _ratio(numbers, "bicycle-kf", other) >= 1.05
    assert _ratio(numbers, "multirate-residual-kf", "multirate-kf") <= 1.10


@pytest.mark.parametrize("experiment", estimation.EXPERIMENTS)
def test_an_experiments_filters_exist_at_its_speed(experiment: estimation.Experiment) -> None:
    base: Any = experiment.simulation.make_env().unwrapped
    assert base.held_speed == pytest.approx(25 / 3.6)
    made = make_filters(experiment.simulation.filters, base)
    assert list(made) == [each.label for each in experiment.simulation.filters]
    assert {"exact-kf", "joint"} < {each.name for each in made.values()}


pytest.importorskip("highway_env")


def made(*ends: int) -> np.ndarray:
    """(10, 3) of `simulate_swerve`: the ends first, then successes."""
    failures = np.array([*ends, *[RUNNING] * (10 - len(ends))], float)
    costs = np.where(failures == RUNNING, 1.0, 300.0)
    return np.stack([costs, failures, np.full(10, 0.1)], axis=1)


def test_an_episode_is_that_of_the_environment() -> None:
    """Everybody drives the same seeds; without control the first numbers are the env's own."""

    env = gym.make(traffic.ID, on_bad_action="fail")
    env.reset(seed=traffic.FIRST_SEED)
    cost, over = 0.0, False
    while not over:
        _, reward, terminated, truncated, info = env.step([0.0])
        cost, over = cost - float(reward), terminated or truncated
    ((found, failure, slip),) = traffic._simulate_swerve(("none", (0,)))
    assert (found, failure) == (cost, info["failure"])
    assert 0.0 < slip < 0.6


@pytest.mark.parametrize("who", traffic.CONTROLLERS)
def test_every_contestant_drives(who: str) -> None:
    numbers = traffic._simulate_swerve((who, (1,)))
    assert np.shape(numbers) == (1, 3) and np.isfinite(numbers).all()


def test_the_verdict_names_the_best_and_why_the_others_fail() -> None:
    swerves = {who: made(SPIN, DEPARTURE) for who in traffic.CONTROLLERS}
    swerves["none"] = made(SPIN, SPIN, COLLISION, DEPARTURE)
    swerves["lqr"], swerves[traffic.ORACLE] = made(COLLISION), made()
    lanes = {name: np.full((2, 5), 0.1 * (1 + i)) for i, name in enumerate(traffic.READERS)}
    text = traffic.STUDY.compose_verdict((swerves, lanes))
    lines = text.splitlines()
    assert len(lines) <= LINES and max(map(len, lines)) <= LETTERS
    assert "lqr 90 % [" in lines[1] and "none 60 % [" in lines[1]
    assert "spin 20 %, collision 10 %, departure 10 %" in lines[2] and "100 % [" in lines[2]
    assert "multirate-residual-kf holds 10 cm" in lines[3] and "30 cm" in lines[3]
