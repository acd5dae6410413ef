"""What tasks demand of a car, which decides what is scored, and what delay costs the baselines.

Tasks are scored where a car without control slips or is lost, never by
who gains: `python -m sideslip.benchmarks.control.baseline_gaps --write` measures all candidates on
tuning seeds and writes the file.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...envs.scenarios.world import WORLD_VERSION
from ..harness.results import write_text
from ..harness.stats import Estimate, geometric_mean
from . import tasks
from .entries import REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .run import Results, measure
from .score import PairedDrives, compute_log_ratios
from .tables import compute_gaps
from .tasks import NOMINAL, ORACLES, PARAMETERS, STATE, ControlTask, TaskMeasurement

DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)  # s, of camera and GPS alike, beside what the seed draws
# s between the frames of a late camera: 0.3 s late, 7 are in flight of `link.MAX_IN_FLIGHT`
_FRAME_PERIOD = 0.05
DELAY_TASK = ControlTask("small car", tasks.YAW, "coms", "zero-slip", "small-car-random")
_FILTERS = (REFERENCE_FILTER, "multirate-kf", "bicycle-kf")
DELAY_ENTRIES = (
    *(Entry(name) for name in (NOMINAL, ORACLES[PARAMETERS][0], ORACLES[STATE][0])),
    *(Entry(REFERENCE_CONTROLLER, name) for name in _FILTERS),
)


def measure_delay_cost(
    seeds: Sequence[int], **options: Any
) -> tuple[dict[Entry, list[Estimate]], list[tuple[float, Results]]]:
    """Drive `DELAY_ENTRIES` with camera and GPS late by each of `DELAYS`, all on the same seeds.

    Args:
        seeds: Seeds of the episodes.
        options: Options of `measure`.

    Returns:
        Costs over that of nominal with sensors in time, at each delay, by entry; episodes by delay.
    """
    late = []
    for delay in DELAYS:
        delays = {"camera_delays": [delay], "camera_jitter": 0.0, "gps_delays": [delay]}
        changes = {"scenario": {"base": DELAY_TASK.scenario, **delays}}
        task = replace(DELAY_TASK, changes=changes | {"camera": {"period": _FRAME_PERIOD}})
        late.append((delay, measure([(task, entry) for entry in DELAY_ENTRIES], seeds, **options)))
    in_time, costs = late[0][1][DELAY_TASK, Entry(NOMINAL)], dict[Entry, list[Estimate]]()
    for entry in DELAY_ENTRIES:
        for _, results in late:
            result, logs = results[DELAY_TASK, entry], np.empty(0)
            if not (result.error or in_time.error):
                mask = in_time.survived[: len(result.costs)]
                logs = -compute_log_ratios(in_time.costs[: len(mask)], result)[mask]
            costs.setdefault(entry, []).append(geometric_mean(logs))
    return costs, late


EPISODES = 32
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
    write: bool = False, episodes: int = EPISODES, jobs: int | None = None, keep: Path | None = None
) -> None:
    """Measure which tasks are scored: what they demand of a car, on tuning seeds (2 or more)."""
    console = Console()
    short = {"lead_in": tasks.QUICK_LEAD_IN}  # what a manoeuvre demands does not depend on it
    candidates = [replace(task, changes=short) for task in tasks.list_candidates()]
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
    import typer

    typer.run(_main)
