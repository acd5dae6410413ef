"""Question: how much of what memory is worth does each kind of network find?

`sideslip/LinearYawVision-v0` with a picture every 40 ms, late or lost. All learn from the optimal
filter's actions with as many steps; PPO learns from rewards. The gap is what a policy costs over
the optimum, less one, from its actions' errors (`Optimum.excess`), which scatters little.
"""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from rich.console import Console

from ... import __version__
from ..harness.parallel import run_cases
from ..harness.results import ResultRow, ResultTable, Suite
from ..harness.stats import Estimate, interval
from ..harness.verdict import format_percent, format_verdict
from .cases import CONDITIONS, FILTER, ID, LQG_FACTOR, PPO, REPEATED, SEEDS, make_cases
from .measure import CaseCache, MemoryResult

NAME = "memory"
_TEXT = (
    "A linear car of known tyres whose sideslip angle a yaw moment keeps small, pictures every "
    "40 ms: the best policy and its cost are computed. Each kind of memory imitates the optimal "
    "filter's actions where it drives itself (DAgger), all with the same drives and passes; what "
    "is left is the price of what it does not remember, or has not learned. Gap: cost over the "
    "optimum, less one. An error of an action costs S (u - u*)^2, so the gap is their sum; beside "
    "it stands the plain difference of the costs to the optimal policy on the same seeds."
)

Results = Mapping[str, Mapping[str, Sequence[MemoryResult]]]
"""By who and condition, of each training seed."""


def run(
    quick: bool = False,
    episodes: int | None = None,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    conditions: Sequence[str] = (),
    seeds: int = SEEDS,
) -> Suite:
    """Everybody in every condition; quick: in one, with little training and without PPO.

    episodes: that judge a policy. keep: a folder in which finished cases stay. conditions: of
    `CONDITIONS`, none for all. seeds: trainings of each memory in `REPEATED`, which is always
    there.
    """
    suite = Suite(NAME, "Memory where the optimum is known", _TEXT)
    if find_spec("torch") is None:
        suite.verdict = 'Not trained: it needs torch, pip install "sideslip[train]".'
        return suite
    cases = make_cases(quick, episodes, conditions, seeds)
    outcomes = run_cases(CaseCache(keep and keep.absolute()), cases, NAME, jobs, console)
    results: dict[str, dict[str, list[MemoryResult]]] = {}
    for case, outcome in zip(cases, outcomes, strict=True):
        results.setdefault(case.learner, {}).setdefault(case.condition, []).append(outcome)
    suite.verdict = make_verdict(results)
    _add_tables(suite, results)
    _draw(suite, results)
    return suite


def average_seeds(runs: Sequence[MemoryResult]) -> MemoryResult:
    """The mean over training seeds, episode by episode."""
    return MemoryResult(*(np.mean(arrays, axis=0) for arrays in zip(*runs, strict=True)))


def make_verdict(results: Results) -> str:
    """The verdict."""
    learners = [learner for learner in results if learner not in (FILTER, PPO)]
    gaps = {
        learner: {
            condition: average_seeds(item).gap() for condition, item in results[learner].items()
        }
        for learner in learners
    }
    mean = {
        learner: float(np.mean([item.value for item in gaps[learner].values()]))
        for learner in learners
    }
    first, *others = sorted(learners, key=lambda learner: mean[learner])
    rest = ", ".join(f"{learner} {100.0 * mean[learner]:.0f} %" for learner in others)
    hardest = max(gaps[first], key=lambda condition: gaps[first][condition].value)
    check = "; ".join(
        f"{condition} {format_percent(compute_lqg_gap(item[0]))}"
        for condition, item in list(results[FILTER].items())[:2]
    )
    return format_verdict(
        f"Over the optimum: {first} {100.0 * mean[first]:.0f} %, {rest}.",
        f"Means of {len(gaps[first])} conditions; {first} is furthest from it at {hardest}: "
        f"{format_percent(gaps[first][hardest])}.",
        "By rewards alone ppo, without memory: "
        f"{format_percent(average_seeds(results[PPO][REPEATED]).gap())} at {REPEATED}."
        if PPO in results
        else "",
        f"Check, the optimal policy's own costs over it: {check}.",
        "Not covered: longer training, larger networks, other sensors and cars.",
    )


def compute_lqg_gap(result: MemoryResult) -> Estimate:
    """Of the optimum's own policy: its costs over the computed optimum, less one."""
    return interval(result.costs / result.best - 1.0)


def _format_gap(number: Estimate) -> str:
    return number.inline(100.0, ".1f")


def _add_tables(suite: Suite, results: Results) -> None:
    conditions = list(results[FILTER])
    reference = {condition: runs[0] for condition, runs in results[FILTER].items()}
    gaps, trainings = [], []
    for learner, learner_runs in results.items():
        numbers = {
            condition: compute_lqg_gap(runs[0]) if learner == FILTER else average_seeds(runs).gap()
            for condition, runs in learner_runs.items()
        }
        gaps.append(
            [learner, *(_format_gap(numbers[w]) if w in numbers else "" for w in conditions)]
        )
        for condition, number in numbers.items():
            columns = {
                "scenario": condition,
                "controller": learner,
                "n": len(learner_runs[condition][0].costs),
            }
            common = {"suite": NAME, "salt": "fixed", "env_version": f"{ID} {__version__}"}
            suite.rows.append(ResultRow.from_estimate("gap", number, **columns, **common))
        if learner != FILTER:
            runs = learner_runs[REPEATED]
            seeds = ", ".join(f"{100.0 * result.gap().value:.1f}" for result in runs)
            plain = _format_gap(average_seeds(runs).compute_paired_gap(reference[REPEATED]))
            spent = np.mean(
                [result.seconds for run_list in learner_runs.values() for result in run_list]
            )
            trainings.append([learner, seeds, plain, f"{runs[0].steps:.0f}", f"{spent:.0f}"])
    n = len(reference[REPEATED].costs) // LQG_FACTOR
    optima = ", ".join(
        f"{condition} {1e3 * runs.best:.1f}" for condition, runs in reference.items()
    )
    note = (
        f"Percent over the optimum, with 95 % intervals over {n} episodes, the same for all; "
        f"{FILTER}: the optimal policy's plain costs on {n * LQG_FACTOR}. "
        f"The optimum in 10^-3: {optima}."
    )
    title = f"Trainings, at {REPEATED}"
    header = ("memory", "gap of each seed / %", "plain costs / %", "steps", "CPU-s")
    suite.tables += [
        ResultTable("Cost over the optimum", ("memory", *conditions), gaps, note),
        ResultTable(
            title, header, trainings, "CPU-s: mean of all conditions. plain costs: over lqg's."
        ),
    ]


def _draw(suite: Suite, results: Results) -> None:
    """The gap over the delay; nothing where plotly is not installed or there is one delay only."""
    delays = {
        1e3 * camera["delays"][0]: condition
        for condition, camera in CONDITIONS.items()
        if "loss" not in camera and condition in results[FILTER]
    }
    delays = dict(sorted(delays.items()))
    if find_spec("plotly") is None or len(delays) < 2:
        return
    from ..report.figures import draw_curves

    series = {}
    for learner in results:
        if set(delays.values()) <= set(results[learner]) and learner != FILTER:
            gaps = [
                average_seeds(results[learner][condition]).gap() for condition in delays.values()
            ]
            value, low, high = 100.0 * np.array(gaps).T
            series[learner] = value, low, high
    labels = ("delay of the pictures / ms", "cost over the optimum / %")
    figure = draw_curves(np.array(list(delays)), series, *labels, log="y")
    question = "How much of the optimum does each memory find?"
    suite.answers.append((question, figure, suite.verdict.splitlines()[0]))
