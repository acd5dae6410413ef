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
from ..harness.results import Row, Suite, Table
from ..harness.stats import Estimate, interval
from ..harness.verdict import percent, verdict
from .cases import ALONE, CONDITIONS, FILTER, ID, PPO, REPEATED, SEEDS, cases_of
from .measure import Found, Kept

NAME = "memory"
_TEXT = (
    "A linear car of known tyres whose sideslip angle a yaw moment keeps small, pictures every "
    "40 ms: the best policy and its cost are computed. Each kind of memory imitates the optimal "
    "filter's actions where it drives itself (DAgger), all with the same drives and passes; what "
    "is left is the price of what it does not remember, or has not learned. Gap: cost over the "
    "optimum, less one. An error of an action costs S (u - u*)^2, so the gap is their sum; beside "
    "it stands the plain difference of the costs to the optimal policy on the same seeds."
)

Results = Mapping[str, Mapping[str, Sequence[Found]]]
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
    cases = cases_of(quick, episodes, conditions, seeds)
    found = run_cases(Kept(keep and keep.absolute()), cases, NAME, jobs, console)
    results: dict[str, dict[str, list[Found]]] = {}
    for case, each in zip(cases, found, strict=True):
        results.setdefault(case.who, {}).setdefault(case.condition, []).append(each)
    suite.verdict = answer(results)
    _tabled(suite, results)
    _draw(suite, results)
    return suite


def pooled(found: Sequence[Found]) -> Found:
    """The mean over training seeds, episode by episode."""
    return Found(*(np.mean(each, axis=0) for each in zip(*found, strict=True)))


def answer(results: Results) -> str:
    """The verdict."""
    learners = [who for who in results if who not in (FILTER, PPO)]
    gaps = {
        who: {where: pooled(each).gap() for where, each in results[who].items()} for who in learners
    }
    mean = {who: float(np.mean([each.value for each in gaps[who].values()])) for who in learners}
    first, *others = sorted(learners, key=lambda who: mean[who])
    rest = ", ".join(f"{who} {100.0 * mean[who]:.0f} %" for who in others)
    hardest = max(gaps[first], key=lambda where: gaps[first][where].value)
    check = "; ".join(
        f"{where} {percent(lqg_gap(each[0]))}" for where, each in list(results[FILTER].items())[:2]
    )
    return verdict(
        f"Over the optimum: {first} {100.0 * mean[first]:.0f} %, {rest}.",
        f"Means of {len(gaps[first])} conditions; {first} is furthest from it at {hardest}: "
        f"{percent(gaps[first][hardest])}.",
        f"By rewards alone ppo, without memory: {percent(pooled(results[PPO][REPEATED]).gap())} at "
        f"{REPEATED}."
        if PPO in results
        else "",
        f"Check, the optimal policy's own costs over it: {check}.",
        "Not covered: longer training, larger networks, other sensors and cars.",
    )


def lqg_gap(found: Found) -> Estimate:
    """Of the optimum's own policy: its costs over the computed optimum, less one."""
    return interval(found.costs / found.best - 1.0)


def _shown(number: Estimate) -> str:
    return number.inline(100.0, ".1f")


def _tabled(suite: Suite, results: Results) -> None:
    conditions = list(results[FILTER])
    alone = {where: found[0] for where, found in results[FILTER].items()}
    gaps, trainings = [], []
    for who, mine in results.items():
        numbers = {
            where: lqg_gap(found[0]) if who == FILTER else pooled(found).gap()
            for where, found in mine.items()
        }
        gaps.append([who, *(_shown(numbers[w]) if w in numbers else "" for w in conditions)])
        for where, number in numbers.items():
            columns = {"scenario": where, "controller": who, "n": len(mine[where][0].costs)}
            common = {"suite": NAME, "salt": "fixed", "env_version": f"{ID} {__version__}"}
            suite.rows.append(Row.of("gap", number, **columns, **common))
        if who != FILTER:
            found = mine[REPEATED]
            seeds = ", ".join(f"{100.0 * each.gap().value:.1f}" for each in found)
            plain = _shown(pooled(found).plain(alone[REPEATED]))
            spent = np.mean([each.seconds for those in mine.values() for each in those])
            trainings.append([who, seeds, plain, f"{found[0].steps:.0f}", f"{spent:.0f}"])
    n = len(alone[REPEATED].costs) // ALONE
    optima = ", ".join(f"{where} {1e3 * found.best:.1f}" for where, found in alone.items())
    note = (
        f"Percent over the optimum, with 95 % intervals over {n} episodes, the same for all; "
        f"{FILTER}: the optimal policy's plain costs on {n * ALONE}. "
        f"The optimum in 10^-3: {optima}."
    )
    title = f"Trainings, at {REPEATED}"
    header = ("memory", "gap of each seed / %", "plain costs / %", "steps", "CPU-s")
    suite.tables += [
        Table("Cost over the optimum", ("memory", *conditions), gaps, note),
        Table(title, header, trainings, "CPU-s: mean of all conditions. plain costs: over lqg's."),
    ]


def _draw(suite: Suite, results: Results) -> None:
    """The gap over the delay; nothing where plotly is not installed or there is one delay only."""
    delays = {
        1e3 * camera["delays"][0]: where
        for where, camera in CONDITIONS.items()
        if "loss" not in camera and where in results[FILTER]
    }
    delays = dict(sorted(delays.items()))
    if find_spec("plotly") is None or len(delays) < 2:
        return
    from ..report.figures import curves

    series = {}
    for who in results:
        if set(delays.values()) <= set(results[who]) and who != FILTER:
            gaps = [pooled(results[who][where]).gap() for where in delays.values()]
            value, low, high = 100.0 * np.array(gaps).T
            series[who] = value, low, high
    labels = ("delay of the pictures / ms", "cost over the optimum / %")
    figure = curves(np.array(list(delays)), series, *labels, log="y")
    question = "How much of the optimum does each memory find?"
    suite.answers.append((question, figure, suite.verdict.splitlines()[0]))
