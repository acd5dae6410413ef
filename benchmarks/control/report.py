"""The verdict of the control benchmark, and its figures, tracks and side-by-side views.

`_Gains` are log(J_nominal / J) of an entry's episodes, shape (n,), by task (r in `score`);
`foresight` everywhere is the log of oracle-state's cost over clairvoyant's in each calibrated task,
shape (n,).
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import Array
from ...envs.rendering.palette import find_colour
from ...envs.vehicle.parameters import VEHICLES
from ..harness.drives import make_env
from ..harness.results import Suite
from ..harness.stats import Estimate, geometric_mean
from ..harness.verdict import Explorer, Panel, describe_leader, format_verdict, summarise_names
from ..report.film import make_track_kml
from .baseline_gaps import DELAY_TASK, DELAYS, DelayCost, make_cost_lines
from .entries import (
    ADAPTIVE,
    LEARNED,
    ORACLE_NAMES,
    REFERENCE_CONTROLLER,
    REFERENCE_FILTER,
    TRUTH,
    ControlEntry,
    get_filter_name,
    make_agent_options,
    make_estimate_options,
)
from .run import SIGNALS, Results
from .score import Standing
from .tasks import NOMINAL, PARAMETERS, TITLES, ControlTask

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_POLICIES = {pair for pairs in LEARNED.values() for pair in pairs}

_Gains = dict[ControlTask, Array]
Driven = TypeVar("Driven", bound=Collection[Hashable])


def compose_verdict(
    by_tier: Mapping[str, Sequence[Standing]],
    prices: Sequence[DelayCost] = (),
    foresight: Mapping[ControlTask, Array] | None = None,
) -> str:
    """Compose the verdict over all tiers: the best controller, the best estimator, and why.

    Args:
        by_tier: Entries by tier, the best first.
        prices: Relative costs of entries at each delay of camera and GPS.
        foresight: Log of oracle-state's cost over clairvoyant's by task, None without calibration.

    Returns:
        Text of the verdict, a statement a line.
    """
    filters, controllers = _group_estimators(by_tier), _group_controllers(by_tier)
    complete, none = select_complete(controllers), controllers.get("none", {})
    best = _find_best_controller(by_tier)
    ratio = _compute_cost_ratio(complete[best], none) if best not in ("", "none") and none else None
    text = f", and {100.0 * ratio.value:.0f} % as much as no control" if ratio else ""
    episodes = max((len(r) for gains in controllers.values() for r in gains.values()), default=0)
    return format_verdict(
        "Controllers drive on what estimators infer; cost: squared error of slip and yaw rate.",
        f"Of the controllers {_describe_first(complete)}{text}.",
        f"Of the estimators, under one controller, {_describe_first(filters)}.",
        _describe_reasons(by_tier, prices, foresight or {}),
        f"{_describe_exceptions(by_tier)}Not covered: other cars and roads, and what "
        f"{episodes} episodes a contest are too few to show.",
    )


def _compute_relative_costs(standings: Mapping[str, Sequence[Standing]]) -> dict[str, Estimate]:
    """Compute the cost over nominal's (%) of controllers with every task, the best first."""
    complete = select_complete(_group_controllers(standings))
    logs = {name: [-r for r in complete[name].values()] for name in _rank_entries(complete)}
    return {
        name: Estimate(*(100.0 * value for value in geometric_mean(*ratios)))
        for name, ratios in logs.items()
    }


def is_default_filter(controller: str, estimator: str) -> bool:
    """Whether an estimator is a controller's default: none, the reference or its own filter.

    Args:
        controller: Name of the controller.
        estimator: Name of the estimator.

    Returns:
        Whether controllers are compared on this pair.
    """
    follows = ADAPTIVE.get(estimator) == controller
    return estimator in ("", REFERENCE_FILTER) or follows or (estimator, controller) in _POLICIES


def _find_best_controller(by_tier: Mapping[str, Sequence[Standing]]) -> str:
    """Find the best controller over all tiers among those with every task; "" without a score."""
    return next(iter(_rank_entries(select_complete(_group_controllers(by_tier)))), "")


def select_complete(by_name: Mapping[str, Driven]) -> dict[str, Driven]:
    """Select the names with every task that any name has: only they can be the best over all.

    Args:
        by_name: Tasks of a controller, or a mapping from them, by the controller's name.

    Returns:
        Selected names.
    """
    all_tasks = {task for tasks in by_name.values() for task in tasks}
    return {name: tasks for name, tasks in by_name.items() if set(tasks) == all_tasks}


def _group_estimators(by_tier: Mapping[str, Sequence[Standing]]) -> dict[str, _Gains]:
    """Collect the `_Gains` of each estimator under the reference controller, the truth left out."""
    return _collect_gains(by_tier, "estimator", lambda entry: (
        entry.controller == REFERENCE_CONTROLLER and entry.estimator != TRUTH))  # fmt: skip


def _group_controllers(by_tier: Mapping[str, Sequence[Standing]]) -> dict[str, _Gains]:
    """Collect the `_Gains` of each controller on its default filters, the oracles left out."""
    return _collect_gains(by_tier, "controller", lambda entry: (
        entry.controller not in ORACLE_NAMES and is_default_filter(entry.controller,
                                                                   entry.estimator)))  # fmt: skip


def _collect_gains(
    by_tier: Mapping[str, Sequence[Standing]], attribute: str, among: Callable[[ControlEntry], bool]
) -> dict[str, _Gains]:
    by_name: dict[str, _Gains] = {}
    for item in (item for standings in by_tier.values() for item in standings if among(item.entry)):
        name = getattr(item.entry, attribute).replace(", ", " with ")  # in a list of names
        gains = by_name.setdefault(name, {})
        gains |= {task: r for task, (r, _) in item.pairs.items()}
    return {name: item for name, item in by_name.items() if item}


def _compute_cost_ratio(one: _Gains, other: _Gains) -> Estimate:
    """Compute J / J_other on the tasks and seeds of both; NaN where there are none."""
    both = [(r, other[task]) for task, r in one.items() if task in other]
    return geometric_mean(*(b[: len(a)] - a[: len(b)] for a, b in both))


def _rank_entries(by_name: Mapping[str, _Gains]) -> dict[str, dict[str, Estimate]]:
    """Rank entries by fewest cheaper rivals; each name has its cost ratios over rivals."""
    ratios = {
        name: {rival: _compute_cost_ratio(x, by_name[rival]) for rival in by_name if rival != name}
        for name, x in by_name.items()
    }
    losses = {name: sum(ratio.value > 1.0 for ratio in ratios[name].values()) for name in by_name}
    gained = {name: np.mean([r.mean() for r in gains.values()]) for name, gains in by_name.items()}
    order = sorted(by_name, key=lambda name: (losses[name], -gained[name]))
    return {
        name: dict(sorted(
            ((other, ratio) for other, ratio in ratios[name].items() if np.isfinite(ratio.value)),
            key=lambda rival: -rival[1].value,
        ))
        for name in order
    }  # fmt: skip


def _describe_first(by_name: Mapping[str, _Gains]) -> str:
    """Describe in a clause which name leads, and by how much."""
    ranked = _rank_entries(by_name)
    return describe_leader(*next(iter(ranked.items())), "cost") if ranked else "nobody has a score"


def _describe_exceptions(by_tier: Mapping[str, Sequence[Standing]]) -> str:
    """Describe the tiers in which another name surely leads, and controllers of fewer tasks."""
    parts = []
    for tier, standings in by_tier.items():
        for collect in (_group_estimators, lambda by: select_complete(_group_controllers(by))):
            overall, in_tier = (_rank_entries(collect(x)) for x in (by_tier, {tier: standings}))
            first, best = next(iter(overall), ""), next(iter(in_tier), "")
            rivals = in_tier.get(best, {})
            if best != first and first in rivals and rivals[first].high < 1.0:
                parts.append(f"{best} in tier {tier}")
    gains, overall_best = _group_controllers(by_tier), _find_best_controller(by_tier)
    partial = gains.keys() - select_complete(gains).keys() if overall_best else ()
    ratios = {name: _compute_cost_ratio(gains[name], gains[overall_best]) for name in partial}
    cheaper = (name for name in ratios if ratios[name].high < 1.0)
    ordered = sorted(cheaper, key=lambda label: ratios[label].value)
    parts += [f"{name} on its own manoeuvres" for name in ordered]
    return f"It costs less with {summarise_names(parts)}. " if parts else ""


def _describe_reasons(
    by_tier: Mapping[str, Sequence[Standing]],
    prices: Sequence[DelayCost],
    foresight: Mapping[ControlTask, Array],
) -> str:
    """Describe what the oracles save by their knowledge, and the cost of delay."""
    all_standings = [standing for standings in by_tier.values() for standing in standings]
    oracles = [item for item in all_standings if item.entry.controller == PARAMETERS]
    parameter_pairs = [pair for item in oracles for pair in item.pairs.values()]
    steps = (
        ("the true car and road", [r for r, _ in parameter_pairs]),
        ("its exact motion", [oracle_gain - r for r, oracle_gain in parameter_pairs]),
        ("what is ahead", list(foresight.values())),
    )
    texts = [
        f"{what} saves {100.0 * (1.0 - geometric_mean(*(-r for r in logs)).value):.0f} %"
        for what, logs in steps
        if logs
    ]
    late = [price.over for price in prices if price.entry.controller == REFERENCE_CONTROLLER]
    delay = ""
    if late and np.isfinite(late[0][-1].value):
        grown = 100.0 * (late[0][-1].value / late[0][0].value - 1.0)
        delay = f"; {DELAYS[-1]:g} s of delay costs {grown:.0f} %"
    return f"Knowing {', then '.join(texts)} of the cost{delay}." if parameter_pairs else ""


_PANELS = (
    Panel("sideslip / mrad", (("beta", "true"), ("beta_ref", "reference"))),
    Panel("yaw rate / (rad/s)", (("gamma", "true"), ("gamma_ref", "reference"))),
    Panel("yaw moment / (N m)", (("yaw_moment", "delivered"),)),
    Panel("front steering / mrad", (("steer", "delivered"),)),
)
_SCALES = {"beta": 1e3, "beta_ref": 1e3, "steer": 1e3}
_BODY = (1.5, 1.15)  # length and width of a car's body, over its wheelbase and its track
_COST = "cost / nominal's, %: less is better"
_CAPTION = "nominal: an LQG that knows the data sheet. Whiskers: 95 % intervals. Hollow: a variant."


def add_figures(
    suite: Suite,
    by_tier: Mapping[str, Sequence[Standing]],
    results: Results,
    prices: Sequence[DelayCost],
    foresight: Mapping[ControlTask, Array],
) -> None:
    """Add the figures to a suite that has its verdict; without plotly only the tracks.

    Args:
        suite: Suite, to which the figures are added.
        by_tier: Entries by tier, the best first.
        results: Episodes by entry.
        prices: Relative costs of entries at each delay of camera and GPS.
        foresight: Log of oracle-state's cost over clairvoyant's by task.
    """
    outcomes = results.outcomes.items()
    series = {entry: drive.series for entry, drive in outcomes if drive.series is not None}
    best = _find_best_controller(by_tier)
    suite.files += _make_tracks(series, best)
    try:
        from ..report.figures import draw_curves, draw_groups
    except ModuleNotFoundError:
        return
    questions = (
        ("Which controller holds the car?", {"All contests": _compute_relative_costs(by_tier)}),
        ("Which controller holds it in each tier?", _group_costs(by_tier, _controller)),
        ("Which estimator does a controller drive best with?", _group_costs(by_tier, _estimator)),
        ("What would knowing more save?", _group_oracles(by_tier, foresight)),
    )
    suite.answers += [
        (title, draw_groups(groups, _COST, {100.0: "nominal"}), _CAPTION)
        for title, groups in questions
        if any(groups.values())
    ]
    shown = make_cost_lines(prices)
    if shown:
        ms, label = 1e3 * np.array(DELAYS), "cost / nominal's with sensors in time"
        figure = draw_curves(ms, shown, "further delay of camera and GPS / ms", label)
        text = f"{DELAY_TASK.name}: camera every 50 ms, GPS every 200 ms; "
        text += "each filter is designed for its delay."
        suite.answers.append(("What does late sensing cost?", figure, text))
    suite.explorers.append(_make_explorer(series, best))
    for tier, standings in by_tier.items():
        suite.figures += _draw_maps(tier, standings)


def _group_costs(
    by_tier: Mapping[str, Sequence[Standing]], name: Callable[[ControlEntry], str]
) -> dict[str, dict[str, Estimate]]:
    """Group costs over nominal's (%) by tier and name(entry), "" left out; the best is first."""
    groups = {}
    for tier, standings in by_tier.items():
        shown = [item for item in standings if "cost_vs_nominal" in item.overall]
        costs = {
            name(item.entry): Estimate(*(100.0 * n for n in item.overall["cost_vs_nominal"]))
            for item in shown
            if name(item.entry)
        }
        title = f"Tier {tier}: {TITLES[tier]}"
        groups[title] = dict(sorted(costs.items(), key=lambda pair: pair[1].value))
    return {title: costs for title, costs in groups.items() if costs}


def _estimator(entry: ControlEntry) -> str:
    return entry.estimator if entry.controller == REFERENCE_CONTROLLER else ""


def _controller(entry: ControlEntry) -> str:
    is_shown = is_default_filter(entry.controller, entry.estimator) and entry.controller != NOMINAL
    return entry.controller if is_shown and entry.estimator != TRUTH else ""


def _group_oracles(
    by_tier: Mapping[str, Sequence[Standing]], foresight: Mapping[ControlTask, Array]
) -> dict[str, dict[str, Estimate]]:
    """Group the oracles' costs over nominal's (%) by tier, clairvoyant's from oracle-state's."""
    names = ORACLE_NAMES
    groups = _group_costs(by_tier, lambda x: x.controller if x.controller in names else "")
    for tier in by_tier:
        title = f"Tier {tier}: {TITLES[tier]}"
        logs = [value for task, value in foresight.items() if task.tier == tier]
        if logs and "oracle-state" in groups.get(title, {}):
            state = groups[title]["oracle-state"].value
            ratio = geometric_mean(*(-value for value in logs))
            groups[title]["clairvoyant"] = Estimate(*(state * value for value in ratio))
    return groups


def _draw_maps(tier: str, standings: Sequence[Standing]) -> list[tuple[str, "Figure", str]]:
    from ..report.figures import draw_heat_map

    names = [standing.label for standing in standings]
    tasks = list(dict.fromkeys(c for standing in standings for c in standing.results))
    figures = []
    for metric, good, text in (
        ("cost_vs_nominal", "low", "Over nominal's, the paired geometric mean; 1: nominal."),
        ("failure_rate", "low", "The share of episodes in which the car spun or left the road."),
    ):
        values = np.full((len(standings), len(tasks)), np.nan)
        for (i, standing), (j, task) in product(enumerate(standings), enumerate(tasks)):
            if metric in standing.by_task.get(task, {}):
                values[i, j] = standing.by_task[task][metric].value
        if np.isfinite(values).any():
            title = f"Tier {tier}: {metric.replace('_', ' ')} in every contest"
            columns = [task.name for task in tasks]
            figures.append((title, draw_heat_map(names, columns, values, metric, good), text))
    return figures


def _make_tracks(series: Mapping[ControlEntry, Array], best: str) -> list[tuple[str, str, str]]:
    """Make the tracks (KML) of the first and the last task, without control and with the best."""
    tasks = list(dict.fromkeys(entry.task for entry in series))
    files = []
    for task in dict.fromkeys(tasks[:1] + tasks[-1:]):
        places = {
            entry.label: (values[:, 1 + SIGNALS.index("X")], values[:, 1 + SIGNALS.index("Y")])
            for entry, values in series.items()
            if entry.task == task and entry.controller in ("none", best)
            if is_default_filter(entry.controller, entry.estimator)
        }
        text = make_track_kml(task.name, places, {name: find_colour(name) for name in places})
        name = f"{task.name.replace(', ', '-')}.kml"
        files.append((name, "application/vnd.google-earth.kml+xml", text))
    return files


def _make_explorer(series: Mapping[ControlEntry, Array], best: str) -> Explorer:
    """Make the view of every entry's first test seed, at first no control and the best."""
    labels = (
        entry.label
        for entry in series
        if entry.controller == best and is_default_filter(best, entry.estimator)
    )
    keyed: dict[tuple[str, ...], Array] = {
        (entry.task.tier, entry.task.name, entry.label): values for entry, values in series.items()
    }
    bodies: dict[tuple[str, ...], tuple[float, float]] = {}
    for entry in series:
        car = VEHICLES[entry.task.vehicle or "coms"]
        size = (_BODY[0] * car.wheelbase, _BODY[1] * car.front_track)
        bodies[entry.task.tier, entry.task.name] = size
    best = next(labels, "")
    return make_time_explorer("Any two side by side", ("tier", "contest"), keyed, best, bodies)


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

    Returns:
        Figure with menus.
    """
    cells = {}
    for key, values in series.items():
        signals = dict(zip(("t", *SIGNALS), values.T, strict=True))
        cells[key] = {name: _SCALES.get(name, 1.0) * signal for name, signal in signals.items()}
    caption = (
        "The same seed in both: line the contestant's, dashed the reference. The arrow is where "
        "the car goes in a quarter of a second, its angle to the body the sideslip."
    )
    return Explorer(title, menus, cells, _PANELS, caption, ("none", best), bodies or {})


def run_entry(entry: ControlEntry, seed: int) -> Rollout:
    """Run one episode of an entry in a single env.

    Args:
        entry: Task, estimator and controller with their options.
        seed: Seed of the episode.

    Returns:
        Rollout of the episode.
    """
    return rollout(*make_env_and_agent(entry), seed)


def make_env_and_agent(entry: ControlEntry) -> tuple[Any, Any]:
    """Make a single env with its filter, and the agent that drives it.

    Args:
        entry: Task, estimator and controller with their options.

    Returns:
        Env of one car, and the agent that drives it.
    """
    estimate = make_estimate_options(entry) if entry.estimator else None
    name = get_filter_name(entry.estimator)
    env = make_env(entry.task.env_id, name, estimate, **entry.env_options)
    return env, make_agent(entry.controller, env, **make_agent_options(entry))
