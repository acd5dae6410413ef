"""The gaps between the baselines: nominal, oracle-parameters, oracle-state and clairvoyant.

Each knows more than the one before: nominal the data sheet, oracle-parameters the true car,
friction and biases, oracle-state the state and the disturbances too, the clairvoyant also what is
ahead. From the gaps follow the scales of scores, what each step of knowledge and delay costs, and
which tasks (contests in the tables) are scored: those where the baselines lie apart on tuning
seeds. `python -m sideslip.benchmarks.control.baseline_gaps --write` measures all candidates and
writes the file.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from ... import __version__
from ...envs.record import Array
from ...envs.task import FAILURES
from ..harness.results import ResultTable
from ..harness.stats import Estimate, average, compute_p_value, geometric_mean, holm
from .entries import ORACLE_NAMES, REFERENCE_CONTROLLER, REFERENCE_FILTER, ControlEntry
from .run import DriveResult, Results, measure
from .score import MIN_GAP, ScoreScale, Standing, compute_log_ratios, survival_mask
from .tasks import (
    LIMIT,
    NOMINAL,
    ORACLES,
    PARAMETERS,
    STATE,
    TITLES,
    YAW,
    ControlTask,
    TaskMeasurement,
    find_oracle,
    list_candidates,
    make_tuning_seeds,
    write_tasks,
)

_CAR_OUTCOMES = ("none", "spin", "off-road")  # how an episode ends by the car's own motion
DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)  # s, of camera and GPS alike, beside what the seed draws
# s between the frames of a late camera: 0.3 s late, 7 are in flight of `link.MAX_IN_FLIGHT`
_FRAME_PERIOD = 0.05
DELAY_TASK = ControlTask("1", YAW, "coms", "zero-slip", "coms-random")
_FILTERS = (REFERENCE_FILTER, "multirate-kf", "bicycle-kf")
CONTESTANTS = (
    *((NOMINAL, ""), (ORACLES[PARAMETERS][0], ""), (ORACLES[STATE][0], "")),
    *((REFERENCE_CONTROLLER, filter_name) for filter_name in _FILTERS),
)


def make_score_scales(
    results: Results, tasks: Sequence[ControlTask]
) -> dict[ControlTask, ScoreScale]:
    """Make the scale of scores of each task in which both baselines were driven.

    Args:
        results: Episodes of the entries.
        tasks: Tasks to make scales for.

    Returns:
        Scales by task.
    """
    scales = {}
    for task in tasks:
        nominal, oracle = (results.select(task, name) for name in (NOMINAL, STATE))
        if not nominal.error and not oracle.error:
            scales[task] = ScoreScale(nominal, oracle)
    return scales


def make_oracle_table(
    results: Results, tasks: Sequence[ControlTask], foresight: Mapping[ControlTask, Array]
) -> ResultTable:
    """Make the table of every task's baselines, and of whether they fall in cost.

    Args:
        results: Episodes of the entries.
        tasks: Tasks, a row each.
        foresight: log(J_oracle-state / J_clairvoyant) of the calibrated tasks, shape (n,) each.

    Returns:
        Table.
    """
    scales, cells = make_score_scales(results, tasks), []
    for task in tasks:
        if task not in scales:
            errors = [results.select(task, oracle).error for oracle in (NOMINAL, STATE)]
            cells.append([task.name, *[""] * 6, "; ".join(filter(None, errors))])
            continue
        scale = scales[task]
        oracle_ratios = scale.compute_paired_ratios(scale.oracle)[1]
        parameters, parameters_text = results.select(task, PARAMETERS), ""
        if not parameters.error:
            ratios = scale.compute_paired_ratios(parameters)[0]
            parameters_text = f"{ratios.mean() if len(ratios) else math.nan:.2f}"
        log_ratios = foresight.get(task)
        fails = 100.0 * (1.0 - survival_mask(scale.nominal).mean())
        beyond = "" if log_ratios is None else f"{log_ratios.mean():.2f}"
        counted = f"{len(oracle_ratios)} of {len(scale.mark_compared(len(scale.oracle.costs)))}"
        falls = _describe_order(scale, oracle_ratios, log_ratios)
        texts = (average(oracle_ratios).inline(), parameters_text, beyond, counted, falls)
        cells.append([task.name, f"{fails:.1f}", find_oracle(task), *texts])
    header = (
        *("contest", "nominal fails / %", "oracle-state is", "its gap", "oracle-parameters"),
        *("clairvoyant beyond", "episodes", "falls"),
    )
    note = "Mean of log(J_nominal / J), 0.69 for half the cost; the score's 1 is the gap."
    if not foresight:
        note += " The clairvoyant is not calibrated: its column is empty (`sideslip calibrate`)."
    return ResultTable("The ladder", header, cells, note, keyed=False)


def _describe_order(scale: ScoreScale, oracle_ratios: Array, foresight: Array | None) -> str:
    """Describe whether each baseline costs less than the one that knows less."""
    if not len(oracle_ratios):
        return "no episode that nominal and oracle-state survive"
    if scale.gap < MIN_GAP:
        return "nothing to win here"
    if foresight is not None and foresight.mean() <= 0.0:
        return "clairvoyant does not"
    return "yes" if average(oracle_ratios).low > 0.0 else "not surely"


def describe_findings(standings: Sequence[Standing]) -> list[str]:
    """Describe the entries that cost less than oracle-state over their tier, Holm-corrected.

    Args:
        standings: Entries of a tier.

    Returns:
        Sentences.
    """
    others = [
        item
        for item in standings
        if item.entry.controller not in ORACLE_NAMES
        and np.isfinite(item.overall.get("score", Estimate(math.nan)).value)
    ]
    excess = [
        np.concatenate([oracle_ratios - ratios for ratios, oracle_ratios in item.pairs.values()])
        for item in others
    ]  # log(J / J_oracle-state): below 0 where the entry is better
    sure = holm([compute_p_value(item) for item in excess])
    better = [item for item, is_sure in zip(others, sure, strict=True) if is_sure]
    return [
        f"Finding: {item.label} costs less than oracle-state in tier {item.tier} "
        f"(score {item.overall['score'].value:.2f})."
        for item in better
    ]


def find_below_optimum(names: Sequence[str], regrets: Sequence[Array]) -> list[str]:
    """Find which surely cost less than the clairvoyant, Holm-corrected.

    Args:
        names: Names of the entries.
        regrets: log(J / J_clairvoyant) of each, shape (n,).

    Returns:
        Names of those.
    """
    sure = holm([compute_p_value(logs) for logs in regrets])
    return [name for name, is_sure in zip(names, sure, strict=True) if is_sure]


def make_knowledge_table(results: Results, tiers: Mapping[str, Sequence[ControlTask]],
                    foresight: Mapping[ControlTask, Array]) -> ResultTable:  # fmt: skip
    """Make the table of what not knowing costs in each tier: ratios of neighbouring baselines.

    Args:
        results: Episodes of the entries.
        tiers: Tasks by tier.
        foresight: log(J_oracle-state / J_clairvoyant) of the calibrated tasks, shape (n,) each.

    Returns:
        Table.
    """
    cells = []
    for tier, tasks in tiers.items():
        scales = make_score_scales(results, tasks)
        steps: list[list[Array]] = [[], [], [c for k, c in foresight.items() if k in tasks]]
        for task, scale in scales.items():
            parameters = results.select(task, PARAMETERS)
            if not parameters.error and scale.mark_compared(len(parameters.costs)).any():
                ratios, oracle_ratios = scale.compute_paired_ratios(parameters)
                steps[0].append(ratios)
                steps[1].append(oracle_ratios - ratios)
        texts = (geometric_mean(*logs).inline() if logs else "" for logs in steps)
        cells.append([f"{tier}: {TITLES[tier]}", *texts])
    knowledge = ("car, friction, biases (model)", "state and disturbances (sensing)")
    header = ("tier", *knowledge, "what is ahead (foresight)")
    note = (
        "Cost without over cost with the knowledge: nominal / oracle-parameters, oracle-parameters "
        "/ oracle-state, oracle-state / clairvoyant. Paired geometric means."
    )
    return ResultTable("What not knowing costs", header, cells, note, keyed=False)


def list_failures(results: Results, late: float = 0.0) -> list[list[str]]:
    """List where a failure is not the car's, such as a NaN.

    Args:
        results: Episodes of the entries.
        late: Delay of the sensors (s) in results of `measure_delay_cost`.

    Returns:
        Tier, task, entry and what happened of each.
    """
    lines, more = [], f", sensors {1e3 * late:.0f} ms late" if late else ""
    for entry, result in results.outcomes.items():
        where = [entry.task.tier, entry.task.name + more, entry.label]
        if result.error:
            lines.append([*where, f"not driven: {result.error}"])
            continue
        codes = result["failure"].astype(int)
        ended = [
            f"{name} {100.0 * (codes == code).mean():.1f} %"
            for code, name in enumerate(FAILURES)
            if name not in _CAR_OUTCOMES and (codes == code).any()
        ]
        if ended:
            lines.append([*where, ", ".join(ended)])
        elif (codes != 0).all():
            lines.append([*where, "every car fails"])
    return lines


@dataclass
class DelayCost:
    """A contestant's cost over that of nominal with sensors in time, at each delay."""

    entry: ControlEntry
    over: list[Estimate]


def _make_late_entries(delay: float) -> list[ControlEntry]:
    """Make the contestants' entries with camera (every `_FRAME_PERIOD`) and GPS `delay` s late."""
    delays = {"camera_delays": [delay], "camera_jitter": 0.0, "gps_delays": [delay]}
    scenario = {"base": DELAY_TASK.scenario, **delays}
    options = {"scenario": scenario, "camera": {"period": _FRAME_PERIOD}}
    return [
        ControlEntry(DELAY_TASK, estimator, controller, options)
        for controller, estimator in CONTESTANTS
    ]


def measure_delay_cost(
    seeds: Sequence[int],
    *,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> tuple[list[DelayCost], list[Results]]:
    """Drive every contestant at each of DELAYS, all on the same seeds.

    Args:
        seeds: Seeds of the episodes, the same for each delay.
        jobs: Processes, None for all processors.
        console: Where progress is shown.
        keep: Folder in which finished cases stay.

    Returns:
        Costs of the contestants, and the results by delay.
    """
    delay_results = [
        measure(_make_late_entries(d), seeds, jobs=jobs, console=console, keep=keep) for d in DELAYS
    ]
    in_time = delay_results[0].select(DELAY_TASK, NOMINAL)
    prices = []
    for controller, estimator in CONTESTANTS:
        price = DelayCost(ControlEntry(DELAY_TASK, estimator, controller), [])
        for results in delay_results:
            result, logs = results.select(DELAY_TASK, controller, estimator), np.empty(0)
            if not (result.error or in_time.error):
                mask = survival_mask(in_time)[: len(result.costs)]
                logs = -compute_log_ratios(in_time.costs[: len(mask)], result)[mask]
            price.over.append(geometric_mean(logs))
        prices.append(price)
    return prices, delay_results


def make_cost_lines(prices: Sequence[DelayCost]) -> Mapping[str, tuple[Array, Array, Array]]:
    """Make the lines of cost over delay, of those that drove at all delays.

    Args:
        prices: Costs of the contestants.

    Returns:
        Value, lower and upper bound, shape (DELAYS,) each, by name.
    """
    complete = [price for price in prices if np.isfinite(price.over).all()]
    return {price.entry.label: (*np.array(price.over).T,) for price in complete}


EPISODES = 64
_GAP = 0.3  # a scored task's mean of log(J_nominal / J_oracle) is above it: 26 % of the cost
_MIN_LOW = 0.2  # and the lower limit of its 95 % interval above this one
# of the episodes: nominal fails in less of a scored task's (but for the tiers `LIMIT`), and an
# oracle that fails in more is worse than one that does not
_FAILING = 0.1


def _make_oracle_entries(task: ControlTask) -> list[ControlEntry]:
    """Make the entries of nominal and of the candidates for the oracles."""
    names = (NOMINAL, *ORACLES[PARAMETERS], *ORACLES[STATE])
    return [ControlEntry(task, "", name) for name in names]


def _measure_task(results: Results, task: ControlTask) -> TaskMeasurement:
    """Measure a candidate with the better oracle of each kind.

    That one fails in at most `_FAILING` of the episodes, and among those it has the larger gap. A
    baseline that could not be computed, and cars that all fail, leave a gap of 0 and the reason.
    """
    nominal = results.select(task, NOMINAL)
    errors = [f"{NOMINAL}: {nominal.error}"] if nominal.error else []
    failing = 1.0 if nominal.error else float(np.mean(~survival_mask(nominal)))
    parameter_oracle, _ = _select_oracle(results, task, PARAMETERS, nominal)
    state_oracle, oracle_errors = _select_oracle(results, task, STATE, nominal)
    gap, n_compared = state_oracle.gap, state_oracle.n_compared
    errors += oracle_errors
    is_unknown = bool(nominal.error) or len(oracle_errors) == len(ORACLES[STATE])
    verdict = _describe_verdict(task, gap, failing, n_compared)
    facts = asdict(task) | {"env_version": __version__}
    facts |= {"oracle": state_oracle.name, "knowing": parameter_oracle.name}
    facts |= {"judged": n_compared, "n": len(nominal.costs)}
    numbers = zip(("gap", "low", "high", "failing"), (*gap, failing), strict=True)
    facts |= {key: round(number, 4) for key, number in numbers}
    return TaskMeasurement(**facts, verdict="; ".join(errors) if is_unknown else verdict)


class _OracleCandidate(NamedTuple):
    """A candidate for an oracle; of several the smallest tuple is the best."""

    often_fails: bool  # in more than `_FAILING` of the episodes
    minus_gap: float
    name: str
    gap: Estimate  # mean of log(J_nominal / J) over the compared episodes
    n_compared: int  # episodes that nominal and the candidate survive


def _select_oracle(
    results: Results, task: ControlTask, oracle_kind: str, nominal: DriveResult
) -> tuple[_OracleCandidate, list[str]]:
    """Select the better candidate for an oracle; return also what went wrong."""
    candidates: list[_OracleCandidate] = []
    errors = []
    for name in ORACLES[oracle_kind]:
        oracle = results.select(task, name)
        if oracle.error:
            errors.append(f"{name}: {oracle.error}")
        elif not nominal.error:
            log_ratios = ScoreScale(nominal, oracle).compute_paired_ratios(oracle)[1]
            gap, failing = Estimate(0.0, 0.0, 0.0), float(np.mean(~survival_mask(oracle)))
            if len(log_ratios) > 1:
                gap = Estimate(*(math.log(number) for number in geometric_mean(log_ratios)))
            rank = failing > _FAILING, -gap.value
            candidates.append(_OracleCandidate(*rank, name, gap, len(log_ratios)))
    undriven = _OracleCandidate(True, 0.0, ORACLES[oracle_kind][0], Estimate(0.0, 0.0, 0.0), 0)
    return min(candidates) if candidates else undriven, errors


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
    entries = [entry for task in candidates for entry in _make_oracle_entries(task)]
    results = measure(entries, make_tuning_seeds(episodes), jobs=jobs, console=console)
    measurements = [_measure_task(results, task) for task in candidates]
    columns = "tier", "contest", *ORACLES, "gap", "nominal fails / %", "verdict"
    table = Table(*columns)
    for m in measurements:
        gap = f"{m.gap:.2f} [{m.low:.2f}, {m.high:.2f}]"
        failing = f"{100.0 * m.failing:.1f}"
        table.add_row(m.tier, m.task.name, m.knowing, m.oracle, gap, failing, m.verdict)
    console.print(table)
    if write:
        write_tasks(measurements)


if __name__ == "__main__":
    import typer

    typer.run(main)
