"""What tasks demand of a car, which decides what is scored.

Tasks are scored where a car without control slips or is lost, never by who gains: `python -m
sideslip.benchmarks.control.baseline_gaps --write` measures all candidates on tuning seeds and
writes the file.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ...envs.scenarios.world import WORLD_VERSION
from ..harness.results import write_text
from . import tasks
from .entries import Entry
from .run import Results, measure
from .score import PairedDrives
from .tables import compute_gaps
from .tasks import NOMINAL, ORACLES, PARAMETERS, STATE, ControlTask, TaskMeasurement

_SHORT = {"lead_in": tasks.QUICK_LEAD_IN}  # what a manoeuvre demands does not depend on it
MIN_PEAK = 2.0  # deg, median peak of the slip angle without control; below it nobody needs help
MIN_LOST = 0.3  # of the cars without control, at the limit
MAX_SHARE = 0.5  # of these, that the best baseline may lose: what nobody saves separates nobody
_NUMBERS = ("peak_slip", "lost", "lost_nominal", "lost_oracle", "slip_gap", "yaw_rate_gap")
_NONE, _NOMINAL = Entry("none"), Entry(NOMINAL)
_BASELINES = (_NONE, _NOMINAL, *map(Entry, (*ORACLES[PARAMETERS], *ORACLES[STATE])))


def _measure_task(results: Results, task: ControlTask) -> TaskMeasurement:
    """Measure what a candidate demands; what could not be driven is in its verdict."""
    none, nominal = results[task, _NONE], results[task, _NOMINAL]
    errors = [f"{x}: {results[task, x].error}" for x in (_NONE, _NOMINAL) if results[task, x].error]
    best = dict[str, str]()
    for kind, candidates in ORACLES.items():
        driven = [name for name in candidates if not results[task, Entry(name)].error]
        if not driven:
            errors.append(f"{candidates[0]}: {results[task, Entry(candidates[0])].error}")
        best[kind] = candidates[0]
        if driven and not errors:
            drives = (results[task, Entry(name)] for name in driven)
            pairs = [PairedDrives(nominal, drive, task.cost_floor) for drive in drives]
            best[kind] = driven[int(np.argmax([pair.compute_scores().mean() for pair in pairs]))]
    facts: dict[str, Any] = {**task.record, "world_version": WORLD_VERSION}
    facts |= {"oracle": best[STATE], "knowing": best[PARAMETERS], "n": len(nominal.costs)}
    if errors:
        facts |= dict.fromkeys(_NUMBERS, 0.0)
        return TaskMeasurement(**facts, verdict="; ".join(errors))
    state = results[task, Entry(best[STATE])]
    slip, yaw = compute_gaps(PairedDrives(nominal, state, task.cost_floor), task)
    numbers = {"peak_slip": float(np.degrees(np.median(none["peak_slip"])))}
    for name, result in (("lost", none), ("lost_nominal", nominal), ("lost_oracle", state)):
        numbers[name] = float(np.mean(~result.survived))
    numbers |= {"slip_gap": slip, "yaw_rate_gap": yaw}
    facts |= {name: round(float(np.nan_to_num(x)), 4) for name, x in numbers.items()}
    references = (nominal, *(results[task, Entry(name)] for name in best.values()))
    lost_by_best = min(float(np.mean(~result.survived)) for result in references)
    verdict = _describe_verdict(task.tier, numbers["peak_slip"], numbers["lost"], lost_by_best)
    return TaskMeasurement(**facts, verdict=verdict)


def _describe_verdict(tier: str, peak: float, lost: float, lost_by_best: float) -> str:
    """Describe whether a candidate demands enough, and whether a baseline meets the demand."""
    if tier != tasks.LIMIT:
        low = f"the slip angle peaks at {peak:.1f} deg uncontrolled"
        return "scored" if peak > MIN_PEAK else low
    if lost < MIN_LOST:
        return f"{100.0 * lost:.0f} % of the cars are lost uncontrolled"
    if lost_by_best > MAX_SHARE * lost:
        return f"the best baseline loses {100.0 * lost_by_best:.0f} % of the cars"
    return "scored"


def _main(
    write: bool = False, episodes: int = 32, jobs: int | None = None, keep: Path | None = None
) -> None:
    """Measure which tasks are scored: what they demand of a car, on tuning seeds (2 or more)."""
    console = Console()
    candidates = [replace(task, changes=_SHORT) for task in tasks.list_candidates()]
    cases = [(task, entry) for task in candidates for entry in _BASELINES]
    seeds = tasks.make_tuning_seeds(episodes)
    results = measure(cases, seeds, jobs=jobs, console=console, keep=keep)
    measurements = [_measure_task(results, task) for task in candidates]
    table = Table("task", "peak slip / deg", "lost: none, nominal, oracle / %", "verdict")
    for m in measurements:
        lost = (f"{100.0 * share:.0f}" for share in (m.lost, m.lost_nominal, m.lost_oracle))
        table.add_row(m.task.name, f"{m.peak_slip:.1f}", ", ".join(lost), m.verdict)
    console.print(table)
    if write:
        write_text(tasks.FILE, json.dumps([asdict(m) for m in measurements], indent=1) + "\n")


if __name__ == "__main__":
    typer.run(_main)
