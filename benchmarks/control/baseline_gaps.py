"""The gaps between the baselines: what delay costs them, and which tasks they make worth scoring.

Nominal knows the data sheet, oracle-parameters the true car, friction and biases, oracle-state the
state and the disturbances too. Tasks (contests in the tables) are scored where these lie apart on
tuning seeds: `python -m sideslip.benchmarks.control.baseline_gaps --write` measures all candidates
and writes the file.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from ... import __version__
from ..harness.results import write_text
from ..harness.stats import Estimate, geometric_mean
from .entries import REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .run import Results, measure
from .score import ScoreScale, compute_log_ratios
from .tasks import (
    FILE,
    LIMIT,
    NOMINAL,
    ORACLES,
    PARAMETERS,
    STATE,
    YAW,
    ControlTask,
    TaskMeasurement,
    list_candidates,
    make_tuning_seeds,
)

DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)  # s, of camera and GPS alike, beside what the seed draws
# s between the frames of a late camera: 0.3 s late, 7 are in flight of `link.MAX_IN_FLIGHT`
_FRAME_PERIOD = 0.05
DELAY_TASK = ControlTask("1", YAW, "coms", "zero-slip", "coms-random")
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


EPISODES = 64
_GAP = 0.3  # a scored task's mean of log(J_nominal / J_oracle) is above it: 26 % of the cost
_MIN_LOW = 0.2  # and the lower limit of its 95 % interval above this one
# of the episodes: nominal fails in less of a scored task's (but for the tiers `LIMIT`), and an
# oracle that fails in more is worse than one that does not
_FAILING = 0.1
_BASELINES = tuple(map(Entry, (NOMINAL, *ORACLES[PARAMETERS], *ORACLES[STATE])))


def _measure_task(results: Results, task: ControlTask) -> TaskMeasurement:
    """Measure a candidate with the better oracle of each kind.

    That one fails in at most `_FAILING` of the episodes, and among those it has the larger gap. A
    baseline that could not be computed, and cars that all fail, leave a gap of 0 and the reason.
    """
    nominal = results[task, Entry(NOMINAL)]
    errors = [f"{NOMINAL}: {nominal.error}"] if nominal.error else []
    failing = 1.0 if nominal.error else float(np.mean(~nominal.survived))
    parameter_oracle, _ = _select_oracle(results, task, PARAMETERS)
    state_oracle, oracle_errors = _select_oracle(results, task, STATE)
    gap, n_compared = state_oracle.gap, state_oracle.n_compared
    is_unknown = bool(nominal.error) or len(oracle_errors) == len(ORACLES[STATE])
    verdict = _describe_verdict(task, gap, failing, n_compared)
    facts: dict[str, Any] = {**task.record, "env_version": __version__}
    facts["oracle"] = state_oracle.name
    facts |= {"knowing": parameter_oracle.name, "judged": n_compared, "n": len(nominal.costs)}
    numbers = zip(("gap", "low", "high", "failing"), (*gap, failing), strict=True)
    facts |= {key: round(number, 4) for key, number in numbers}
    facts["verdict"] = "; ".join(errors + oracle_errors) if is_unknown else verdict
    return TaskMeasurement(**facts)


class _OracleCandidate(NamedTuple):
    """A candidate for an oracle; of several the smallest tuple is the best."""

    often_fails: bool  # in more than `_FAILING` of the episodes
    minus_gap: float
    name: str
    gap: Estimate  # mean of log(J_nominal / J) over the compared episodes
    n_compared: int  # episodes that nominal and the candidate survive


def _select_oracle(
    results: Results, task: ControlTask, oracle_kind: str
) -> tuple[_OracleCandidate, list[str]]:
    """Select the better candidate for an oracle; return also what went wrong."""
    nominal, candidates, errors = results[task, Entry(NOMINAL)], list[_OracleCandidate](), []
    for name in ORACLES[oracle_kind]:
        oracle = results[task, Entry(name)]
        if oracle.error:
            errors.append(f"{name}: {oracle.error}")
        elif not nominal.error:
            log_ratios = ScoreScale(nominal, oracle).compute_paired_ratios(oracle)[1]
            gap, failing = Estimate(0.0, 0.0, 0.0), float(np.mean(~oracle.survived))
            if len(log_ratios) > 1:
                gap = Estimate(*(math.log(number) for number in geometric_mean(log_ratios)))
            rank = failing > _FAILING, -gap.value
            candidates.append(_OracleCandidate(*rank, name, gap, len(log_ratios)))
    undriven = _OracleCandidate(True, 0.0, ORACLES[oracle_kind][0], Estimate(0.0, 0.0, 0.0), 0)
    return min(candidates, default=undriven), errors


def _describe_verdict(task: ControlTask, gap: Estimate, failing: float, n_compared: int) -> str:
    if n_compared < 2:
        return "no episode that nominal and oracle-state survive"
    if failing >= _FAILING and task.tier not in LIMIT:
        return f"nominal fails in {100.0 * failing:.0f} %"
    if not (gap.value > _GAP and gap.low > _MIN_LOW):
        return f"too little to win: {gap.value:.2f} [{gap.low:.2f}, {gap.high:.2f}]"
    return "scored"


def main(write: bool = False, episodes: int = EPISODES, jobs: int | None = None) -> None:
    """Measure which tasks are scored: where the baselines lie apart, on tuning seeds.

    Args:
        write: Whether the package's file is replaced.
        episodes: Tuning seeds a task, at least 2.
        jobs: Processes; None: one a processor.
    """
    console = Console()
    candidates = list_candidates()
    cases = [(task, entry) for task in candidates for entry in _BASELINES]
    results = measure(cases, make_tuning_seeds(episodes), jobs=jobs, console=console)
    measurements = [_measure_task(results, task) for task in candidates]
    columns = "tier", "contest", *ORACLES, "gap", "nominal fails / %", "verdict"
    table = Table(*columns)
    for m in measurements:
        gap = f"{m.gap:.2f} [{m.low:.2f}, {m.high:.2f}]"
        failing = f"{100.0 * m.failing:.1f}"
        table.add_row(m.tier, m.task.name, m.knowing, m.oracle, gap, failing, m.verdict)
    console.print(table)
    if write:
        write_text(FILE, json.dumps([asdict(m) for m in measurements], indent=1) + "\n")


if __name__ == "__main__":
    import typer

    typer.run(main)
