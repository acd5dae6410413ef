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
from ..agents.rollout import cost_ratios
from .control.cells import Cell
from .control.contests import Contest
from .control.episodes import Array, Chunk, Driven, drive
from .control.seeds import salted_seeds
from .control.tables import spec_of
from .harness.parallel import run_cases
from .harness.results import Row, Suite, Table
from .harness.stats import geometric_mean, interval, won
from .harness.verdict import percent, verdict

CLASSICAL, FILTER = "lqr", "exact-kf"


@dataclass
class Enjoyed:
    """The contestants' episodes on the same seeds: the policy's first.

    salt: of the seeds, "" where the caller chose them. reference: of the env. driven: by
    contestant. left_out: why a contestant is not among them.
    """

    policy: Policy
    salt: str
    seeds: list[int]
    reference: str
    cells: dict[str, Cell]
    driven: dict[str, Driven]
    left_out: dict[str, str]

    def costs(self, name: str) -> Array:
        """(seeds,) of a contestant."""
        return self.driven[name].costs


def enjoy(
    policy: str,
    episodes: int = 256,
    *,
    env_id: str | None = None,
    scenario: str | None = None,
    seed: int | None = None,
) -> Enjoyed:
    """Drive a policy, the uncontrolled car, and the classical line.

    policy: a shipped name or a path. env_id: another env than the policy's own, with that id's
    options. scenario: a name, instead of the env's own. seed: of the first episode, the next ones
    count up; default: seeds made from the weights.

    Raises ValueError where the policy cannot drive the env, and what `load_policy` raises.
    """
    loaded = load_policy(policy)
    home, shown, reference, options = _task(loaded, env_id, scenario)
    salt = loaded.salt if seed is None else ""
    seeds = salted_seeds(salt, episodes) if seed is None else list(range(seed, seed + episodes))
    rivals = {f"{CLASSICAL} on {FILTER}": (FILTER, CLASSICAL), "none": ("", "none")}
    if loaded.name in rivals:
        raise ValueError(f"the policy's file is called {loaded.name!r}, as what it is held against")
    contestants = {loaded.name: (loaded.card.estimator, policy)} | rivals
    cells = {
        name: Cell(Contest(env_id=home, scenario=shown), estimator, who, options)
        for name, (estimator, who) in contestants.items()
    }
    chunks = [Chunk(cell, tuple(seeds), keep=True) for cell in cells.values()]
    driven = dict(zip(cells, run_cases(drive, chunks, loaded.name, jobs=1), strict=True))
    errors = {name: each.error for name, each in driven.items() if each.error}
    for needed in (loaded.name, "none"):
        if needed in errors:
            raise ValueError(f"{needed} cannot drive {home}: {errors[needed]}")
    there = {name: each for name, each in driven.items() if name not in errors}
    return Enjoyed(loaded, salt, seeds, reference, cells, there, errors)


def _task(
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


def evaluation(found: Enjoyed) -> dict[str, Any]:
    """For a card: the seeds' salt, and each contestant's mean cost with its 95 % interval."""
    costs = {}
    for name in found.driven:
        mean, low, high = (round(each, 6) for each in interval(found.costs(name)))
        costs[name] = {"mean": mean, "low": low, "high": high}
    return {"salt": found.salt, "episodes": len(found.seeds), "cost": costs}


def evaluate(path: str | Path, episodes: int = 256) -> Enjoyed:
    """Drive a policy's test seeds in its own env and write what it costs into its card."""
    found = enjoy(str(path), episodes)
    policy = found.policy
    save_policy(path, policy.network, replace(policy.card, evaluation=evaluation(found)))
    return found


def suite_of(found: Enjoyed) -> Suite:
    """Table and rows; the first episode over time and in motion."""
    name, card = found.policy.name, found.policy.card
    cell = found.cells[name]
    text = (
        f"{len(found.seeds)} episodes of {cell.contest.scenario}, the same seeds for all. "
        f"{name} was trained by {card.algorithm or 'an unnamed algorithm'} on {card.steps} "
        f"steps of {card.env_id} (reference: {card.reference}) in {card.cpu_seconds:.0f} CPU-s."
    )
    judged = found.reference
    if judged != card.reference:
        text += f" Here it is judged by another reference, {judged}: by another cost."
    suite = Suite("enjoy", f"{name} on {cell.contest.env_id}", text, _rows(found), [_table(found)])
    from .control.figures import over_time

    series: dict[tuple[str, ...], Array] = {
        (who,): each.series for who, each in found.driven.items() if each.series is not None
    }
    suite.explorers.append(over_time("The first seed, side by side", (), series, name))
    suite.verdict = _verdict(found)
    return suite


def _verdict(found: Enjoyed) -> str:
    """What the policy costs over each of the others, and how often it fails."""
    name, others = found.policy.name, [each for each in found.driven if each != found.policy.name]
    fails = 100.0 * np.mean(found.driven[name]["failure"] != 0.0)
    lines = []
    for other in others:
        logs = np.log(cost_ratios(found.costs(name), found.costs(other)))
        lines.append(f"{name} costs {percent(geometric_mean(logs))} of {other}, seed by seed.")
    limits = f"Not said: other cars, scenarios and seeds than these {len(found.seeds)}."
    return verdict(*lines, f"It fails in {fails:.0f} % of the episodes. {limits}")


def _table(found: Enjoyed) -> Table:
    first = found.policy.name
    own, cells = found.costs(first), []
    for name, driven in found.driven.items():
        rival = name != first
        ratio = percent(geometric_mean(np.log(cost_ratios(own, driven.costs)))) if rival else ""
        cells.append(
            [
                name,
                ratio,
                f"{100.0 * won(own, driven.costs).value:.0f} %" if rival else "",
                f"{1e3 * driven['rms_slip'].mean():.2f}",
                f"{driven['largest_step'].mean():.0f}",
                f"{100.0 * np.mean(driven['failure'] != 0.0):.1f} %",
            ]
        )
    header = (f"{first} costs, of it", "better", "RMS slip", "step", "fails")
    note = (
        f"{first}'s cost over each other's: paired geometric means with 95 % intervals. "
        f"better: share of the seeds on which {first} costs less. Slip in mrad. step: "
        "the largest between two decisions, in N m."
    )
    left_out = [f"{name} was not driven: {error}." for name, error in found.left_out.items()]
    return Table("What it costs", ("controller", *header), cells, " ".join([note, *left_out]))


def _rows(found: Enjoyed) -> list[Row]:
    rows = []
    for name, driven in found.driven.items():
        cell, own = found.cells[name], name == found.policy.name
        who = {"estimator": cell.estimator, "controller": name if own else cell.controller}
        seeds: dict[str, Any] = {"n": len(found.seeds), "salt": found.salt, "spec": spec_of(cell)}
        what = {"suite": "enjoy", "env_version": f"{cell.contest.env_id} {__version__}"}
        for metric in ("cost", "rms_slip", "peak_slip", "effort", "largest_step"):
            columns = {"scenario": cell.contest.scenario, **what, **who, **seeds}
            rows.append(Row.of(metric, interval(driven[metric]), **columns))
    return rows
