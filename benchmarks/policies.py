"""Question: what does a learned policy cost, against no control and the best classical line?

All drive the same seeds in the env that the policy was trained on, which are made from its weights:
nobody can have trained on them.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from .. import __version__
from ..agents.learned.card import JsonMap
from ..agents.learned.files import Policy, load_policy, save_policy
from ..agents.rollout import compute_cost_ratios
from ..envs.record import Array
from .control.cells import ControlEntry
from .control.contests import ControlTask
from .control.episodes import Chunk, DriveResult, run_chunk
from .control.seeds import make_salted_seeds
from .control.tables import make_spec
from .harness.parallel import run_cases
from .harness.results import ResultRow, ResultTable, Suite
from .harness.stats import compute_win_rate, geometric_mean, interval
from .harness.verdict import format_percent, format_verdict

CLASSICAL, FILTER = "lqr", "exact-kf"


@dataclass
class PolicyEvaluation:
    """The contestants' episodes on the same seeds: the policy's first.

    salt: of the seeds, "" where the caller chose them. reference: of the env. driven: by
    contestant. left_out: why a contestant is not among them.
    """

    policy: Policy
    salt: str
    seeds: list[int]
    reference: str
    entries: dict[str, ControlEntry]
    drives: dict[str, DriveResult]
    left_out: dict[str, str]

    def costs(self, name: str) -> Array:
        """(seeds,) of a contestant."""
        return self.drives[name].costs


def evaluate_policy(
    policy: str,
    episodes: int = 256,
    *,
    env_id: str | None = None,
    scenario: str | None = None,
    seed: int | None = None,
) -> PolicyEvaluation:
    """Drive a policy, the uncontrolled car, and the classical line.

    policy: a shipped name or a path. env_id: another env than the policy's own, with that id's
    options. scenario: a name, instead of the env's own. seed: of the first episode, the next ones
    count up; default: seeds made from the weights.

    Raises ValueError where the policy cannot drive the env, and what `load_policy` raises.
    """
    loaded = load_policy(policy)
    home, shown, reference, options = _describe_task(loaded, env_id, scenario)
    salt = loaded.salt if seed is None else ""
    seeds = (
        make_salted_seeds(salt, episodes) if seed is None else list(range(seed, seed + episodes))
    )
    rivals = {f"{CLASSICAL} on {FILTER}": (FILTER, CLASSICAL), "none": ("", "none")}
    if loaded.name in rivals:
        raise ValueError(f"the policy's file is called {loaded.name!r}, as what it is held against")
    contestants = {loaded.name: (loaded.card.estimator, policy)} | rivals
    entries = {
        name: ControlEntry(ControlTask(env_id=home, scenario=shown), estimator, controller, options)
        for name, (estimator, controller) in contestants.items()
    }
    chunks = [Chunk(entry, tuple(seeds), keep=True) for entry in entries.values()]
    results = dict(zip(entries, run_cases(run_chunk, chunks, loaded.name, jobs=1), strict=True))
    errors = {name: outcome.error for name, outcome in results.items() if outcome.error}
    for needed in (loaded.name, "none"):
        if needed in errors:
            raise ValueError(f"{needed} cannot drive {home}: {errors[needed]}")
    drives = {name: outcome for name, outcome in results.items() if name not in errors}
    return PolicyEvaluation(loaded, salt, seeds, reference, entries, drives, errors)


def _describe_task(
    policy: Policy, env_id: str | None, scenario: str | None
) -> tuple[str, str, str, JsonMap]:
    """(env's id, what its scenario is called, its reference, its options)."""
    card = policy.card
    options = dict(card.env_options) if env_id in (None, card.env_id) else {}
    if scenario is not None:
        options["scenario"] = scenario
    home = env_id or card.env_id
    base: Any = gym.make(home, **options).unwrapped
    return home, base.scenario.name, base.reference, options


def summarise_evaluation(result: PolicyEvaluation) -> dict[str, Any]:
    """For a card: the seeds' salt, and each contestant's mean cost with its 95 % interval."""
    costs = {}
    for name in result.drives:
        mean, low, high = (round(number, 6) for number in interval(result.costs(name)))
        costs[name] = {"mean": mean, "low": low, "high": high}
    return {"salt": result.salt, "episodes": len(result.seeds), "cost": costs}


def record_evaluation(path: str | Path, episodes: int = 256) -> PolicyEvaluation:
    """Drive a policy's test seeds in its own env and write what it costs into its card."""
    result = evaluate_policy(str(path), episodes)
    policy = result.policy
    save_policy(path, policy.network, replace(policy.card, evaluation=summarise_evaluation(result)))
    return result


def make_suite(result: PolicyEvaluation) -> Suite:
    """Table and rows; the first episode over time and in motion."""
    name, card = result.policy.name, result.policy.card
    entry = result.entries[name]
    text = (
        f"{len(result.seeds)} episodes of {entry.task.scenario}, the same seeds for all. "
        f"{name} was trained by {card.algorithm or 'an unnamed algorithm'} on {card.steps} "
        f"steps of {card.env_id} (reference: {card.reference}) in {card.cpu_seconds:.0f} CPU-s."
    )
    reference = result.reference
    if reference != card.reference:
        text += f" Here it is judged by another reference, {reference}: by another cost."
    suite = Suite(
        "enjoy", f"{name} on {entry.task.env_id}", text, _make_rows(result), [_make_table(result)]
    )
    from .control.figures import make_time_explorer

    series: dict[tuple[str, ...], Array] = {
        (label,): outcome.series
        for label, outcome in result.drives.items()
        if outcome.series is not None
    }
    suite.explorers.append(make_time_explorer("The first seed, side by side", (), series, name))
    suite.verdict = _compose_verdict(result)
    return suite


def _compose_verdict(result: PolicyEvaluation) -> str:
    """What the policy costs over each of the others, and how often it fails."""
    name, others = (
        result.policy.name,
        [label for label in result.drives if label != result.policy.name],
    )
    fails = 100.0 * np.mean(result.drives[name]["failure"] != 0.0)
    lines = []
    for other in others:
        logs = np.log(compute_cost_ratios(result.costs(name), result.costs(other)))
        lines.append(
            f"{name} costs {format_percent(geometric_mean(logs))} of {other}, seed by seed."
        )
    limits = f"Not said: other cars, scenarios and seeds than these {len(result.seeds)}."
    return format_verdict(*lines, f"It fails in {fails:.0f} % of the episodes. {limits}")


def _make_table(result: PolicyEvaluation) -> ResultTable:
    first = result.policy.name
    costs, cells = result.costs(first), []
    for name, outcome in result.drives.items():
        rival = name != first
        ratio = (
            format_percent(geometric_mean(np.log(compute_cost_ratios(costs, outcome.costs))))
            if rival
            else ""
        )
        cells.append(
            [
                name,
                ratio,
                f"{100.0 * compute_win_rate(costs, outcome.costs).value:.0f} %" if rival else "",
                f"{1e3 * outcome['rms_slip'].mean():.2f}",
                f"{outcome['largest_step'].mean():.0f}",
                f"{100.0 * np.mean(outcome['failure'] != 0.0):.1f} %",
            ]
        )
    header = (f"{first} costs, of it", "better", "RMS slip", "step", "fails")
    note = (
        f"{first}'s cost over each other's: paired geometric means with 95 % intervals. "
        f"better: share of the seeds on which {first} costs less. Slip in mrad. step: "
        "the largest between two decisions, in N m."
    )
    left_out = [f"{name} was not driven: {error}." for name, error in result.left_out.items()]
    return ResultTable("What it costs", ("controller", *header), cells, " ".join([note, *left_out]))


def _make_rows(result: PolicyEvaluation) -> list[ResultRow]:
    rows = []
    for name, outcome in result.drives.items():
        entry, is_policy = result.entries[name], name == result.policy.name
        labels = {
            "estimator": entry.estimator,
            "controller": name if is_policy else entry.controller,
        }
        seeds: dict[str, Any] = {
            "n": len(result.seeds),
            "salt": result.salt,
            "spec": make_spec(entry),
        }
        common = {"suite": "enjoy", "env_version": f"{entry.task.env_id} {__version__}"}
        for metric in ("cost", "rms_slip", "peak_slip", "effort", "largest_step"):
            columns = {"scenario": entry.task.scenario, **common, **labels, **seeds}
            rows.append(ResultRow.from_estimate(metric, interval(outcome[metric]), **columns))
    return rows
