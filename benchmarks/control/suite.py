"""The suite `control`: which estimator and controller hold the car, and how far from the oracles?

All pairs of both drive the scored tasks of four tiers on salted seeds. `_Gains` are r of an entry's
drives, shape (n,), by task (see `score`). The cost of an entry over another's is exp(-r) in verdict
and figures, so that a loss that the other does not have counts e^2 times.
"""

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import typer
from rich.console import Console

from ...envs.record import Array
from ...envs.scenarios.world import GROUPS, World, make_world
from ...envs.vehicle.parameters import VEHICLES
from ..harness.results import Explorer, Suite
from ..harness.stats import Estimate, geometric_mean
from ..report.study import Request, Study, describe_leader, format_verdict, summarise_names
from . import entries
from .calibration import measure_foresight, read_current
from .entries import ControlCase, Entry
from .run import SIGNALS, Results, measure, measure_decision_time
from .score import Matrix, Standing, rank_entries
from .tables import compute_gaps, make_tables
from .tasks import (
    PARAMETERS,
    QUICK_LEAD_IN,
    STATE,
    TITLES,
    WORLD,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
)

_Gains = dict[ControlTask, Array]


def _measure(request: Request) -> Matrix:
    """Drive all tiers; unless it is quick, on the clairvoyant's seeds too."""
    shared: Any = {"jobs": request.jobs, "console": request.console, "keep": request.keep}
    salt, tasks = request.salt or make_salt(), list(list_scored_tasks())
    if request.quick:
        changes = {"lead_in": QUICK_LEAD_IN}
        tasks = [replace(task, changes=changes) for task in entries.select_quick_tasks(tasks, 1)]
    cases = list(entries.make_cases(tasks, request.quick))
    wanted = not request.quick or request.clairvoyant is not None
    records = read_current(request.clairvoyant, tasks) if wanted else {}
    seeds = make_task_seeds(salt, request.episodes or 0)  # `Study.run` has filled them in
    matrix = Matrix(measure(cases, seeds, **shared), salt, measure_foresight(records, **shared))
    driven = {x.entry: next(iter(x.drives)) for x in matrix.overall if x.drives}
    times = {x: measure_decision_time(ControlCase(task, x)) for x, task in driven.items()}
    for standing in itertools.chain(*matrix.by_tier.values()):
        if standing.drives:  # an entry takes as long in every tier
            standing.us = times[standing.entry]
    return matrix


def _add_tables(suite: Suite, matrix: Matrix) -> None:
    matrix.add_rows(suite)
    suite.tables = make_tables(matrix)


def _compose_verdict(matrix: Matrix) -> str:
    """Compose the verdict over all tiers: the best controller, the best estimator, and why."""
    filters, agents = (_rank(matrix.overall, name) for name in (_name_filter, _name_agent))
    complete, none, best = agents.complete, agents.gains.get("none", {}), agents.find_best()
    text = ""
    if best not in ("", "none") and none:
        ratio = _compute_cost_ratio(complete.gains[best], none)
        text = f", and {100.0 * ratio.value:.0f} % as much as no control"
    episodes = max((len(r) for gains in agents.gains.values() for r in gains.values()), default=0)
    return format_verdict(
        "Controllers drive on what estimators infer; cost: squared errors, a lost car 7.4-fold.",
        f"Of the controllers {complete.describe_first()}{text}.",
        f"Of the estimators, under one controller, {filters.describe_first()}.",
        _describe_reasons(matrix),
        f"{_describe_exceptions(matrix)}{_describe_resolution(matrix)}Not covered: other "
        f"cars and roads, and what {episodes} episodes a task are too few to show.",
    )


def _compute_cost_ratio(one: _Gains, other: _Gains) -> Estimate:
    """Compute exp(r_other - r) on the tasks and seeds of both; NaN where there are none."""
    both = [(r, other[task]) for task, r in one.items() if task in other]
    return geometric_mean(*(b[: len(a)] - a[: len(b)] for a, b in both))


def _compute_cost(gains: _Gains) -> Estimate:
    """Compute the cost over nominal's (%)."""
    return geometric_mean(*(-r for r in gains.values())).rescale(100.0)


@dataclass(frozen=True)
class _Ranking:
    """Names that are compared by the cost of what they drove."""

    gains: Mapping[str, _Gains]
    below: Collection[str] = ()  # names that surely lose more cars than nominal

    @property
    def complete(self) -> "_Ranking":
        """The names with every task that any name has: only they can be the best over all."""
        tasks = {task for gains in self.gains.values() for task in gains}
        complete = {name: gains for name, gains in self.gains.items() if gains.keys() == tasks}
        return _Ranking(complete, self.below)

    @cached_property
    def ranked(self) -> dict[str, dict[str, Estimate]]:
        """Names by fewest cheaper rivals, `below` last, with cost ratios over rivals by name."""
        ratios: dict[str, dict[str, Estimate]] = {}
        for name, one in self.gains.items():
            rivals = {x: _compute_cost_ratio(one, y) for x, y in self.gains.items() if x != name}
            ratios[name] = {x: ratio for x, ratio in rivals.items() if np.isfinite(ratio.value)}
        losses = {name: sum(x.value > 1.0 for x in ratios[name].values()) for name in self.gains}
        gained = {name: np.mean([r.mean() for r in x.values()]) for name, x in self.gains.items()}
        order = sorted(self.gains, key=lambda x: (x in self.below, losses[x], -gained[x]))
        return {x: dict(sorted(ratios[x].items(), key=lambda y: -y[1].value)) for x in order}

    def find_best(self) -> str:
        """Find the first of the names with every task, "" without any."""
        return next(iter(self.complete.ranked), "")

    def describe_first(self) -> str:
        """Describe in a clause which name leads, and by how much."""
        first = next(iter(self.ranked.items()), None)
        return describe_leader(*first, "cost") if first else "nobody has a score"


def _name_agent(entry: Entry) -> str:
    """Name an agent on its default filter; "" for others and for oracles."""
    return entry.agent * (entry.is_default and entry.agent not in entries.ORACLE_NAMES)


def _name_filter(entry: Entry) -> str:
    """Name an estimator under the reference controller; "" for others."""
    return entry.estimator * (entry.agent == entries.REFERENCE_CONTROLLER)


def _rank(standings: Sequence[Standing], name_entry: Callable[[Entry], str]) -> _Ranking:
    """Collect what each name drove; "" and the truth are left out."""
    driven = dict[str, Standing]()
    for standing in (x for x in standings if x.pairs):  # the best first, which stays
        driven.setdefault(name_entry(standing.entry).replace(", ", " with "), standing)
    for name in ("", entries.TRUTH):
        driven.pop(name, None)
    below = [name for name, x in driven.items() if x.loses_more]
    return _Ranking({name: x.scores for name, x in driven.items()}, below)


def _describe_resolution(matrix: Matrix) -> str:
    """Describe where nominal and oracle-state lie too close, if that is in half of the tasks."""
    pairs = next((x.pairs for x in matrix.overall if x.entry == Entry(STATE)), {})
    close = 0
    for task, pair in pairs.items():
        slip, yaw = compute_gaps(pair, task)
        lost = float(np.diff(1.0 - pair.finished.mean(axis=1))[0])
        close += not (slip > 0.2 or yaw > 1.0 or lost > 0.1)  # deg, deg/s, of the cars
    if 2 * close <= len(pairs):
        return ""
    saved = f"In {close} of {len(pairs)} tasks knowing everything saves less than"
    return f"{saved} 0.2 deg, 1 deg/s and 10 % of the cars. "


def _describe_exceptions(matrix: Matrix) -> str:
    """Describe the tiers in which another name surely leads, and agents of fewer tasks."""
    parts = []
    for tier, standings in matrix.by_tier.items():
        overall, in_tier = (
            (_rank(x, _name_filter).ranked, _rank(x, _name_agent).complete.ranked)
            for x in (matrix.overall, standings)
        )
        for everywhere, here in zip(overall, in_tier, strict=True):
            first, best = next(iter(everywhere), ""), next(iter(here), "")
            rivals = here.get(best, {})
            if best != first and first in rivals and rivals[first].high < 1.0:
                parts.append(f"{best} in tier {tier}")
    agents = _rank(matrix.overall, _name_agent)
    best_gains = agents.gains.get(agents.find_best(), {})
    partial = {x: y for x, y in agents.gains.items() if x not in agents.complete.gains}
    ratios = {name: _compute_cost_ratio(gains, best_gains) for name, gains in partial.items()}
    cheaper = sorted((ratio.value, name) for name, ratio in ratios.items() if ratio.high < 1.0)
    parts += [f"{name} on its own manoeuvres" for _, name in cheaper]
    return f"It costs less with {summarise_names(parts)}. " if parts else ""


def _describe_reasons(matrix: Matrix) -> str:
    """Describe what the oracles save by their knowledge."""
    scores = {x.entry.agent: x.scores for x in matrix.overall if x.entry.is_oracle}
    parameters, state = scores.get(PARAMETERS, {}), scores.get(STATE, {})
    both = [(r, state[task]) for task, r in parameters.items() if task in state]
    gained: dict[str, Collection[Array]] = {
        "the true car and road": parameters.values(),
        "its exact motion": [b[: len(a)] - a[: len(b)] for a, b in both],
        "what is ahead": matrix.foresight.values(),
    }  # r of each task's drives
    texts = [
        f"{what} saves {100.0 * (1.0 - geometric_mean(*(-r for r in logs)).value):.0f} %"
        for what, logs in gained.items()
        if logs
    ]
    return f"Knowing {', then '.join(texts)} of the cost." if parameters else ""


_PANELS = {
    "sideslip / mrad": (("beta", "true"), ("beta_ref", "reference")),
    "yaw rate / (rad/s)": (("gamma", "true"), ("gamma_ref", "reference")),
    "yaw moment / (N m)": (("yaw_moment", "delivered"),),
    "front steering / mrad": (("steer", "delivered"),),
}
_SCALES = {"beta": 1e3, "beta_ref": 1e3, "steer": 1e3}
_BODY = (1.5, 1.15)  # length and width of a car's body, over its wheelbase and its track
_COST = "exp(-r) / %: cost over nominal's, less is better"
_CAPTION = (
    "nominal: an LQG that knows the data sheet. A loss that nominal does not have counts as 7.4 "
    "times its cost. Whiskers: 95 % intervals. Hollow: a variant."
)


def _add_figures(suite: Suite, matrix: Matrix, draw: ModuleType) -> None:
    complete = _rank(matrix.overall, _name_agent).complete
    everywhere = {name: _compute_cost(complete.gains[name]) for name in complete.ranked}
    questions = (
        ("Which controller holds the car?", {"All tasks": everywhere}),
        ("Which controller holds it in each tier?", _group_costs(matrix, _name_agent)),
        ("Which estimator does a controller drive best with?", _group_costs(matrix, _name_filter)),
        ("What would knowing more save?", _group_oracles(matrix)),
    )
    suite.answers += [
        (title, draw.draw_groups(groups, _COST, {100.0: "nominal"}), _CAPTION)
        for title, groups in questions
        if any(groups.values())
    ]
    suite.explorers.append(_make_explorer(matrix))


def _group_costs(matrix: Matrix, name: Callable[[Entry], str]) -> dict[str, dict[str, Estimate]]:
    """Group costs over nominal's (%) by tier and name(entry), "" left out; the best is first."""
    groups = {}
    for tier, standings in matrix.by_tier.items():
        named = [(name(item.entry), item.scores) for item in standings if item.scores]
        costs = {label: _compute_cost(scores) for label, scores in named if label}
        title = f"Tier {tier}: {TITLES[tier]}"
        groups[title] = dict(sorted(costs.items(), key=lambda pair: pair[1].value))
    return {title: costs for title, costs in groups.items() if costs}


def _group_oracles(matrix: Matrix) -> dict[str, dict[str, Estimate]]:
    """Group the oracles' costs over nominal's (%) by tier, clairvoyant's from oracle-state's."""
    groups = _group_costs(matrix, lambda x: x.agent * (x.agent in entries.ORACLE_NAMES))
    for tier in matrix.by_tier:
        shown = groups.get(f"Tier {tier}: {TITLES[tier]}", {})
        logs = [value for task, value in matrix.foresight.items() if task.tier == tier]
        if logs and STATE in shown:
            ratio = geometric_mean(*(-value for value in logs))
            shown["clairvoyant"] = ratio.rescale(shown[STATE].value)
    return groups


def _make_explorer(matrix: Matrix) -> Explorer:
    """Make the view of every entry's first test seed, at first no control and the best."""
    best = _rank(matrix.overall, _name_agent).find_best()
    drives = matrix.results.items()
    series = {case: drive.series for case, drive in drives if drive.series is not None}
    keyed, bodies = dict[tuple[str, ...], Array](), dict[tuple[str, ...], tuple[float, float]]()
    for (task, entry), values in series.items():
        car = VEHICLES[task.vehicle or "coms"]
        keyed[task.tier, task.name, entry.label] = values
        bodies[task.tier, task.name] = (_BODY[0] * car.wheelbase, _BODY[1] * car.front_track)
    labels = (entry.label for _, entry in series if entry.agent == best and entry.is_default)
    shown = keyed, next(labels, ""), bodies
    return make_time_explorer("Any two side by side", ("tier", "task"), *shown)


def make_time_explorer(
    title: str, menus: Sequence[str], series: Mapping[tuple[str, ...], Array], best: str = "",
    bodies: Mapping[tuple[str, ...], tuple[float, float]] | None = None,
) -> Explorer:  # fmt: skip
    """Make a view of two episodes beside each other, at first `none` and the best.

    Args:
        title: Title of the figure.
        menus: Label of each part of a key but the entry's name.
        series: Time and SIGNALS, shape (k, 1 + SIGNALS), by key.
        best: Name of the entry beside `none`.
        bodies: Length and width of the car (m) by the key without the entry's name.
    """
    cells = {}
    for key, values in series.items():
        signals = dict(zip(("t", *SIGNALS), values.T, strict=True))
        cells[key] = {name: _SCALES.get(name, 1.0) * signal for name, signal in signals.items()}
    caption = (
        "The same seed in both: line the entry's, dashed the reference. The arrow is where "
        "the car goes in a quarter of a second, its angle to the body the sideslip."
    )
    return Explorer(title, menus, cells, _PANELS, caption, ("none", best), bodies or {})


# Whether the order of entries holds where a group of a world's errors is doubled or absent: `python
# -m sideslip.benchmarks.control.suite --keep cases` lists pairs that are surely ordered in the
# benchmark's world and surely the other way round in another. Designs are told the ranges of the
# world that they drive in, as by a data sheet.
_FILTERS = ("exact-kf, gps", "exact-kf, camera", "bicycle-kf", "dakf")
_ORDERED = (
    *map(Entry, (*entries.ORACLE_NAMES, "none")),
    *(Entry(name, entries.REFERENCE_FILTER) for name in ("esc", "two-dof")),
    *(Entry(name, entries.JOINT) for name in entries.ADAPTIVE),
    *(Entry(entries.REFERENCE_CONTROLLER, name) for name in _FILTERS),
)  # the entries whose order is checked
_FACTORS = (0.0, 2.0)  # of a group's ranges about the ideal
_CostRatios = dict[tuple[str, str], Estimate]


def _compare_entries(results: Results) -> _CostRatios:
    """Compute exp(-r) of each entry beside each other's, averaged, by their labels."""
    ranking = _Ranking({item.entry.label: item.scores for item in rank_entries(results, None)})
    rivals = ranking.ranked.items()
    return {(one, other): ratio for one, ratios in rivals for other, ratio in ratios.items()}


def _list_reversals(base: _CostRatios, other: _CostRatios) -> list[tuple[str, str]]:
    """List entries surely ordered, the better first, and surely the other way round elsewhere."""
    common = {names: ratio for names, ratio in base.items() if names in other}
    return [names for names, ratio in common.items() if ratio.high < 1.0 < other[names].low]


def _main(
    episodes: int = 16, tasks: int = 12, jobs: int | None = None, keep: Path | None = None
) -> None:
    """Drive all entries in the benchmark's world and in those of other ranges; list reversals."""
    console, scored = Console(), list_scored_tasks()
    chosen = [scored[i * len(scored) // tasks] for i in range(min(tasks, len(scored)))]
    seeds = make_task_seeds(make_salt(), episodes)

    def compare(world: World, title: str) -> _CostRatios:
        changes = {"lead_in": QUICK_LEAD_IN, "world": world.to_dict()}
        cases = [(replace(task, changes=changes), entry) for task in chosen for entry in _ORDERED]
        results = measure(cases, seeds, jobs=jobs, console=console, keep=keep, title=title)
        return _compare_entries(results)

    base = compare(make_world(WORLD), WORLD)
    sure = sum(ratio.high < 1.0 for ratio in base.values())
    console.print(f"{sure} of {len(base) // 2} pairs are surely ordered.")
    for group, factor in itertools.product(GROUPS, _FACTORS):
        other = compare(make_world(WORLD).scale(group, factor), f"{group} x {factor:g}")
        texts = [f"{better} above {worse}" for better, worse in _list_reversals(base, other)]
        console.print(f"{group} x {factor:g}: reversed: {'; '.join(texts) or 'none'}")


STUDY = Study(
    "control",
    "Which controller and estimator hold the car",
    """\
In a task everybody drives the same salted seeds, with errors of car and sensors that nobody is \
told, after 20 s of gentle driving (4 s in a quick run), and everything is paired by drive. \
`nominal` is the LQG that knows the nominal car, `oracle-parameters` knows car, friction and \
errors, `oracle-state` the state too. r is log((J_nominal + J_0) / (J + J_0)), where J_0 is the \
cost of 0.25 deg of slip and 0.5 deg/s, over drives that both finish; 2 where nominal alone loses \
the car, -2 where the entry alone does. The score is the mean r. Entries that surely lose more \
cars than nominal stand below a line. Intervals are 95 %. contests.json says what each task \
demands.""",
    (entries.EPISODES, entries.QUICK_EPISODES),
    _measure,
    _add_tables,
    _compose_verdict,
    _add_figures,
)

if __name__ == "__main__":
    typer.run(_main)
