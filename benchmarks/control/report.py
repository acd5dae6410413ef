"""The verdict of the control benchmark, and its figures, tracks and side-by-side views.

`_Gains` are r of an entry's drives, shape (n,), by task (see `score`). The cost of an entry over
another's is exp(-r) here, so that a loss that the other does not have counts e^2 times."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from ...envs.record import Array
from ...envs.rendering.palette import find_colour
from ...envs.vehicle.parameters import VEHICLES
from ..harness.results import Suite
from ..harness.stats import Estimate, geometric_mean
from ..harness.verdict import Explorer, Panel, describe_leader, format_verdict, summarise_names
from ..report.film import make_track_kml
from .baseline_gaps import DELAY_TASK, DELAYS
from .entries import ORACLE_NAMES, REFERENCE_CONTROLLER, TRUTH, Entry
from .run import SIGNALS
from .score import CONSTANTS, Standing
from .tables import Matrix, compute_gaps, list_knowledge
from .tasks import NOMINAL, STATE, TITLES, ControlTask

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_Gains = dict[ControlTask, Array]
_ByTier = Mapping[str, Sequence[Standing]]


def compose_verdict(matrix: Matrix) -> str:
    """Compose the verdict over all tiers: the best controller, the best estimator, and why.

    Args:
        matrix: Measurements.

    Returns:
        Text of the verdict, a statement a line.
    """
    filters, agents = _group_filters(matrix.overall), _group_agents(matrix.overall)
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

    @property
    def costs(self) -> dict[str, Estimate]:
        """Cost over nominal's (%) of the names with every task, the best first."""
        complete = self.complete
        return {name: _compute_cost(complete.gains[name]) for name in complete.ranked}

    def find_best(self) -> str:
        """Find the first of the names with every task, "" without any."""
        return next(iter(self.complete.ranked), "")

    def describe_first(self) -> str:
        """Describe in a clause which name leads, and by how much."""
        first = next(iter(self.ranked.items()), None)
        return describe_leader(*first, "cost") if first else "nobody has a score"


def _group_filters(standings: Sequence[Standing]) -> _Ranking:
    """Rank the estimators under the reference controller, the truth left out."""
    return _rank(standings, lambda entry: (
        entry.estimator if entry.agent == REFERENCE_CONTROLLER and entry.estimator != TRUTH
        else ""))  # fmt: skip


def _group_agents(standings: Sequence[Standing]) -> _Ranking:
    """Rank the agents on their default filters, the oracles left out."""
    return _rank(standings, lambda x: x.agent * (x.is_default and x.agent not in ORACLE_NAMES))


def _rank(standings: Sequence[Standing], name_entry: Callable[[Entry], str]) -> _Ranking:
    """Collect what each name drove; "" is left out."""
    driven = dict[str, Standing]()
    for standing in (x for x in standings if x.pairs):  # the best first, which stays
        driven.setdefault(name_entry(standing.entry).replace(", ", " with "), standing)
    driven.pop("", None)
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
        for group in (_group_filters, lambda x: _group_agents(x).complete):
            overall, in_tier = (group(x).ranked for x in (matrix.overall, standings))
            first, best = next(iter(overall), ""), next(iter(in_tier), "")
            rivals = in_tier.get(best, {})
            if best != first and first in rivals and rivals[first].high < 1.0:
                parts.append(f"{best} in tier {tier}")
    agents = _group_agents(matrix.overall)
    best_gains = agents.gains.get(agents.find_best(), {})
    partial = {x: y for x, y in agents.gains.items() if x not in agents.complete.gains}
    ratios = {name: _compute_cost_ratio(gains, best_gains) for name, gains in partial.items()}
    cheaper = sorted((ratio.value, name) for name, ratio in ratios.items() if ratio.high < 1.0)
    parts += [f"{name} on its own manoeuvres" for _, name in cheaper]
    return f"It costs less with {summarise_names(parts)}. " if parts else ""


def _describe_reasons(matrix: Matrix) -> str:
    """Describe what the oracles save by their knowledge, and the cost of delay."""
    meanings = ("the true car and road", "its exact motion", "what is ahead")
    gained = list_knowledge(matrix.overall, list(matrix.foresight.values()))
    texts = [
        f"{what} saves {100.0 * (1.0 - geometric_mean(*(-r for r in logs)).value):.0f} %"
        for what, logs in zip(meanings, gained.values(), strict=True)
        if logs
    ]
    costs = matrix.delay_costs.items()
    late, delay = next((x for entry, x in costs if entry.agent == REFERENCE_CONTROLLER), ()), ""
    if late and np.isfinite(late[-1].value):
        grown = 100.0 * (late[-1].value / late[0].value - 1.0)
        delay = f"; {DELAYS[-1]:g} s of delay costs {grown:.0f} %"
    return f"Knowing {', then '.join(texts)} of the cost{delay}." if gained["model"] else ""


_PANELS = (
    Panel("sideslip / mrad", (("beta", "true"), ("beta_ref", "reference"))),
    Panel("yaw rate / (rad/s)", (("gamma", "true"), ("gamma_ref", "reference"))),
    Panel("yaw moment / (N m)", (("yaw_moment", "delivered"),)),
    Panel("front steering / mrad", (("steer", "delivered"),)),
)
_SCALES = {"beta": 1e3, "beta_ref": 1e3, "steer": 1e3}
_BODY = (1.5, 1.15)  # length and width of a car's body, over its wheelbase and its track
_COST = "exp(-r) / %: cost over nominal's, less is better"
_CAPTION = (
    "nominal: an LQG that knows the data sheet. A loss that nominal does not have counts as 7.4 "
    "times its cost. Whiskers: 95 % intervals. Hollow: a variant."
)


def add_figures(suite: Suite, matrix: Matrix, draw: ModuleType) -> None:
    """Add the figures to a suite.

    Args:
        suite: Suite, to which the figures are added.
        matrix: Measurements.
        draw: `report.figures`.
    """
    by_tier = matrix.by_tier
    filters = _group_costs(by_tier, lambda x: x.estimator * (x.agent == REFERENCE_CONTROLLER))
    questions = (
        ("Which controller holds the car?", {"All tasks": _group_agents(matrix.overall).costs}),
        ("Which controller holds it in each tier?", _group_costs(by_tier, _name_agent)),
        ("Which estimator does a controller drive best with?", filters),
        ("What would knowing more save?", _group_oracles(matrix)),
    )
    suite.answers += [
        (title, draw.draw_groups(groups, _COST, {100.0: "nominal"}), _CAPTION)
        for title, groups in questions
        if any(groups.values())
    ]
    lines = {entry.label: np.array(x).T for entry, x in matrix.delay_costs.items()}
    shown = {label: (*line,) for label, line in lines.items() if np.isfinite(line).all()}
    if shown:
        ms, label = 1e3 * np.array(DELAYS), "cost / nominal's with sensors in time"
        figure = draw.draw_curves(ms, shown, "further delay of camera and GPS / ms", label)
        text = f"{DELAY_TASK.name}: camera every 50 ms, GPS every 200 ms; "
        text += "each filter is designed for its delay."
        suite.answers.append(("What does late sensing cost?", figure, text))
    suite.explorers.append(_make_explorer(matrix))
    for tier, standings in by_tier.items():
        suite.figures += _draw_maps(tier, standings, draw)


def _group_costs(by_tier: _ByTier, name: Callable[[Entry], str]) -> dict[str, dict[str, Estimate]]:
    """Group costs over nominal's (%) by tier and name(entry), "" left out; the best is first."""
    groups = {}
    for tier, standings in by_tier.items():
        named = [(name(item.entry), item.scores) for item in standings if item.scores]
        costs = {label: _compute_cost(scores) for label, scores in named if label}
        title = f"Tier {tier}: {TITLES[tier]}"
        groups[title] = dict(sorted(costs.items(), key=lambda pair: pair[1].value))
    return {title: costs for title, costs in groups.items() if costs}


def _name_agent(entry: Entry) -> str:
    is_shown = entry.is_default and entry.agent != NOMINAL and entry.estimator != TRUTH
    return entry.agent if is_shown else ""


def _group_oracles(matrix: Matrix) -> dict[str, dict[str, Estimate]]:
    """Group the oracles' costs over nominal's (%) by tier, clairvoyant's from oracle-state's."""
    groups = _group_costs(matrix.by_tier, lambda x: x.agent * (x.agent in ORACLE_NAMES))
    for tier in matrix.by_tier:
        shown = groups.get(f"Tier {tier}: {TITLES[tier]}", {})
        logs = [value for task, value in matrix.foresight.items() if task.tier == tier]
        if logs and STATE in shown:
            ratio = geometric_mean(*(-value for value in logs))
            shown["clairvoyant"] = ratio.rescale(shown[STATE].value)
    return groups


def _draw_maps(
    tier: str, standings: Sequence[Standing], draw: ModuleType
) -> list[tuple[str, "Figure", str]]:
    names = [standing.label for standing in standings]
    tasks = list(dict.fromkeys(c for standing in standings for c in standing.results))
    metrics = [[standing.by_task.get(task, {}) for task in tasks] for standing in standings]
    figures, absent = [], Estimate(math.nan)
    for metric, good, text in (
        ("score", "high", "The mean r: 0 as nominal."),
        ("failure_rate", "low", "The share of episodes in which the car spun or left the road."),
    ):
        values = np.array([[cell.get(metric, absent).value for cell in row] for row in metrics])
        if np.isfinite(values).any():
            title = f"Tier {tier}: {metric.replace('_', ' ')} in every task"
            columns = [task.name for task in tasks]
            figures.append((title, draw.draw_heat_map(names, columns, values, metric, good), text))
    places = np.array([_compute_places(standings, *pair) for pair in CONSTANTS.values()]).T
    title = f"Tier {tier}: places, by the score's constants"
    text = "The line between entries that surely lose more cars than nominal, and others, stays."
    heat_map = draw.draw_heat_map(names, list(CONSTANTS), places, "place", "low")
    return [*figures, (title, heat_map, text)]


def _compute_places(standings: Sequence[Standing], loss: float, floor_factor: float) -> Array:
    """Compute the places of entries by a score of other constants, 1 for the best, NaN for none."""
    scores = np.array([standing.compute_score(loss, floor_factor) for standing in standings])
    below = [standing.rank[0] for standing in standings]
    order = np.lexsort((np.nan_to_num(-scores, nan=np.inf), below))
    return np.where(np.isnan(scores), np.nan, np.argsort(order) + 1.0)


def make_tracks(matrix: Matrix) -> list[tuple[str, str, str]]:
    """Make the tracks (KML) of the first and the last task, without control and with the best.

    Args:
        matrix: Measurements.

    Returns:
        Name, media type and text of each file.
    """
    series, best = matrix.series, _group_agents(matrix.overall).find_best()
    tasks = list(dict.fromkeys(task for task, _ in series))
    files = []
    for task in dict.fromkeys(tasks[:1] + tasks[-1:]):
        places = {
            entry.label: (values[:, 1 + SIGNALS.index("X")], values[:, 1 + SIGNALS.index("Y")])
            for (driven, entry), values in series.items()
            if driven == task and entry.agent in ("none", best) and entry.is_default
        }
        text = make_track_kml(task.name, places, {name: find_colour(name) for name in places})
        name = f"{task.name.replace(', ', '-')}.kml"
        files.append((name, "application/vnd.google-earth.kml+xml", text))
    return files


def _make_explorer(matrix: Matrix) -> Explorer:
    """Make the view of every entry's first test seed, at first no control and the best."""
    series, best = matrix.series, _group_agents(matrix.overall).find_best()
    keyed: dict[tuple[str, ...], Array] = {}
    bodies: dict[tuple[str, ...], tuple[float, float]] = {}
    for (task, entry), values in series.items():
        car = VEHICLES[task.vehicle or "coms"]
        keyed[task.tier, task.name, entry.label] = values
        bodies[task.tier, task.name] = (_BODY[0] * car.wheelbase, _BODY[1] * car.front_track)
    labels = (entry.label for _, entry in series if entry.agent == best and entry.is_default)
    shown = keyed, next(labels, ""), bodies
    return make_time_explorer("Any two side by side", ("tier", "task"), *shown)


def make_time_explorer(
    title: str,
    menus: Sequence[str],
    series: Mapping[tuple[str, ...], Array],
    best: str = "",
    bodies: Mapping[tuple[str, ...], tuple[float, float]] | None = None,
) -> Explorer:
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
