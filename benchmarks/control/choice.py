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
from ...envs.record import Array
from ..harness.stats import Estimate, geometric_mean
from .cells import ControlEntry
from .contests import (
    LIMIT,
    NOMINAL,
    ORACLES,
    PARAMETERS,
    STATE,
    ControlTask,
    TaskMeasurement,
    list_candidates,
    write_tasks,
)
from .episodes import DriveResult
from .run import Results, measure
from .scores import ScoreScale, survival_mask
from .seeds import make_tuning_seeds

EPISODES = 64
GAP, MIN_LOW, FAILING = 0.3, 0.2, 0.1
"""A contest is scored whose gap is above the first, its lower limit above the second, and in which
nominal fails in less than this share (at the limit in any, but never always)."""


def make_oracle_entries(task: ControlTask) -> list[ControlEntry]:
    """Nominal and the candidates for the oracles."""
    return [
        ControlEntry(task, "", name) for name in (NOMINAL, *ORACLES[PARAMETERS], *ORACLES[STATE])
    ]


def measure_task(results: Results, task: ControlTask) -> TaskMeasurement:
    """A candidate's numbers; the better oracle is that of fewer failures, then of the larger gap.

    A rung that could not be computed, and cars that all fail, leave a gap of 0 and the reason.
    """
    nominal = results.select(task, NOMINAL)
    errors = [f"{NOMINAL}: {nominal.error}"] if nominal.error else []
    failing = 1.0 if nominal.error else float(np.mean(~survival_mask(nominal)))
    knowing, _, _, _ = _select_oracle(results, task, PARAMETERS, nominal)
    name, gap, n_compared, oracle_errors = _select_oracle(results, task, STATE, nominal)
    errors += oracle_errors
    return TaskMeasurement(
        **asdict(task),
        env_version=__version__,
        oracle=name,
        knowing=knowing,
        gap=round(gap.value, 4),
        low=round(gap.low, 4),
        high=round(gap.high, 4),
        failing=round(failing, 4),
        judged=n_compared,
        n=len(nominal.costs),
        verdict="; ".join(errors)
        if nominal.error or len(oracle_errors) == len(ORACLES[STATE])
        else _describe_verdict(task, gap, failing, n_compared),
    )


def _select_oracle(
    results: Results, task: ControlTask, oracle_kind: str, nominal: DriveResult
) -> tuple[str, Estimate, int, list[str]]:
    """(name, gap to nominal, episodes judged) of the better candidate, and what went wrong."""
    options: list[tuple[bool, float, str, Estimate, int]] = []
    errors = []
    for name in ORACLES[oracle_kind]:
        oracle = results.select(task, name)
        if oracle.error:
            errors.append(f"{name}: {oracle.error}")
        elif not nominal.error:
            log_ratios = ScoreScale(nominal, oracle).compute_paired_ratios(oracle)[1]
            gap, failing = _compute_gap(log_ratios), float(np.mean(~survival_mask(oracle)))
            options.append((failing > FAILING, -gap.value, name, gap, len(log_ratios)))
    nothing = (True, 0.0, ORACLES[oracle_kind][0], Estimate(0.0, 0.0, 0.0), 0)
    _, _, name, gap, n_compared = min(options) if options else nothing
    return name, gap, n_compared, errors


def _compute_gap(log_ratios: Array) -> Estimate:
    """The mean of r with its interval, 0 where no episode or only one is left."""
    if len(log_ratios) < 2:
        return Estimate(0.0, 0.0, 0.0)
    return Estimate(*(math.log(number) for number in geometric_mean(log_ratios)))


def _describe_verdict(task: ControlTask, gap: Estimate, failing: float, n_compared: int) -> str:
    if n_compared < 2:
        return "no episode that nominal and oracle-state survive"
    if failing >= FAILING and task.tier not in LIMIT:
        return f"nominal fails in {100.0 * failing:.0f} %"
    if not (gap.value > GAP and gap.low > MIN_LOW):
        return f"too little to win: {gap.value:.2f} [{gap.low:.2f}, {gap.high:.2f}]"
    return "scored"


def choose_tasks(
    among: Sequence[ControlTask] | None = None,
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
) -> list[TaskMeasurement]:
    """Measure candidates (default: all); one that cannot be driven is not scored, with why."""
    among = list_candidates() if among is None else among
    entries = [entry for task in among for entry in make_oracle_entries(task)]
    results = measure(entries, make_tuning_seeds(episodes), jobs=jobs, console=console)
    return [measure_task(results, task) for task in among]


def main(
    write: Annotated[bool, typer.Option(help="Replace the package's file.")] = False,
    episodes: Annotated[int, typer.Option(min=2, help="Tuning seeds a contest.")] = EPISODES,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes.")] = None,
) -> None:
    """Which contests are scored: where the rungs of the ladder lie apart, on tuning seeds."""
    console = Console()
    measurements = choose_tasks(None, episodes, jobs, console)
    columns = "tier", "contest", *ORACLES, "gap", "nominal fails / %", "verdict"
    table = Table(*columns)
    for measurement in measurements:
        gap = f"{measurement.gap:.2f} [{measurement.low:.2f}, {measurement.high:.2f}]"
        failing = f"{100.0 * measurement.failing:.1f}"
        table.add_row(
            measurement.tier,
            measurement.task.name,
            measurement.knowing,
            measurement.oracle,
            gap,
            failing,
            measurement.verdict,
        )
    console.print(table)
    if write:
        write_tasks(measurements)


if __name__ == "__main__":
    typer.run(main)
