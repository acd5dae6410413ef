"""Which contests are scored: where the rungs of the ladder lie apart, on tuning seeds.

`python -m sideslip.benchmarks.control.choice --write` measures all candidates and writes the file.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ... import __version__
from ..harness.stats import Estimate, geometric_mean
from .cells import Cell
from .contests import (
    LIMIT,
    NOMINAL,
    ORACLES,
    PARAMETERS,
    STATE,
    Contest,
    Measured,
    candidates,
    write_contests,
)
from .episodes import Array, Driven
from .run import Results, measure
from .scores import Yardstick, survived
from .seeds import tuning_seeds

EPISODES = 64
GAP, LEAST, FAILING = 0.3, 0.2, 0.1
"""A contest is scored whose gap is above the first, its lower limit above the second, and in which
nominal fails in less than this share (at the limit in any, but never always)."""


def rungs_of(contest: Contest) -> list[Cell]:
    """Nominal and the candidates for the oracles."""
    return [Cell(contest, "", name) for name in (NOMINAL, *ORACLES[PARAMETERS], *ORACLES[STATE])]


def judged(results: Results, contest: Contest) -> Measured:
    """A candidate's numbers; the better oracle is that of fewer failures, then of the larger gap.

    A rung that could not be computed, and cars that all fail, leave a gap of 0 and the reason.
    """
    nominal = results.of(contest, NOMINAL)
    errors = [f"{NOMINAL}: {nominal.error}"] if nominal.error else []
    failing = 1.0 if nominal.error else float(np.mean(~survived(nominal)))
    knowing, _, _, _ = _better(results, contest, PARAMETERS, nominal)
    name, gap, kept, more = _better(results, contest, STATE, nominal)
    errors += more
    return Measured(
        **asdict(contest),
        env_version=__version__,
        oracle=name,
        knowing=knowing,
        gap=round(gap.value, 4),
        low=round(gap.low, 4),
        high=round(gap.high, 4),
        failing=round(failing, 4),
        judged=kept,
        n=len(nominal.costs),
        verdict="; ".join(errors)
        if nominal.error or len(more) == len(ORACLES[STATE])
        else _verdict(contest, gap, failing, kept),
    )


def _better(
    results: Results, contest: Contest, rung: str, nominal: Driven
) -> tuple[str, Estimate, int, list[str]]:
    """(name, gap to nominal, episodes judged) of the better candidate, and what went wrong."""
    found: list[tuple[bool, float, str, Estimate, int]] = []
    errors = []
    for name in ORACLES[rung]:
        oracle = results.of(contest, name)
        if oracle.error:
            errors.append(f"{name}: {oracle.error}")
        elif not nominal.error:
            own = Yardstick(nominal, oracle).paired(oracle)[1]
            gap, failing = _gap(own), float(np.mean(~survived(oracle)))
            found.append((failing > FAILING, -gap.value, name, gap, len(own)))
    nothing = (True, 0.0, ORACLES[rung][0], Estimate(0.0, 0.0, 0.0), 0)
    _, _, name, gap, kept = min(found) if found else nothing
    return name, gap, kept, errors


def _gap(own: Array) -> Estimate:
    """The mean of r with its interval, 0 where no episode or only one is left."""
    if len(own) < 2:
        return Estimate(0.0, 0.0, 0.0)
    return Estimate(*(math.log(each) for each in geometric_mean(own)))


def _verdict(contest: Contest, gap: Estimate, failing: float, kept: int) -> str:
    if kept < 2:
        return "no episode that nominal and oracle-state survive"
    if failing >= FAILING and contest.tier not in LIMIT:
        return f"nominal fails in {100.0 * failing:.0f} %"
    if not (gap.value > GAP and gap.low > LEAST):
        return f"too little to win: {gap.value:.2f} [{gap.low:.2f}, {gap.high:.2f}]"
    return "scored"


def choose(
    among: Sequence[Contest] | None = None,
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
) -> list[Measured]:
    """Measure candidates (default: all); one that cannot be driven is not scored, with why."""
    among = candidates() if among is None else among
    cells = [cell for contest in among for cell in rungs_of(contest)]
    results = measure(cells, tuning_seeds(episodes), jobs=jobs, console=console)
    return [judged(results, contest) for contest in among]


def main(
    write: Annotated[bool, typer.Option(help="Replace the package's file.")] = False,
    episodes: Annotated[int, typer.Option(min=2, help="Tuning seeds a contest.")] = EPISODES,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes.")] = None,
) -> None:
    """Which contests are scored: where the rungs of the ladder lie apart, on tuning seeds."""
    console = Console()
    found = choose(None, episodes, jobs, console)
    columns = "tier", "contest", *ORACLES, "gap", "nominal fails / %", "verdict"
    table = Table(*columns)
    for each in found:
        gap = f"{each.gap:.2f} [{each.low:.2f}, {each.high:.2f}]"
        failing = f"{100.0 * each.failing:.1f}"
        table.add_row(
            each.tier, each.contest.name, each.knowing, each.oracle, gap, failing, each.verdict
        )
    console.print(table)
    if write:
        write_contests(found)


if __name__ == "__main__":
    typer.run(main)
