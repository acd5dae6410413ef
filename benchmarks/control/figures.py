"""The matrix's figures: a picture for each question, heat maps, any two cells side by side."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import Array
from ...envs.rendering.palette import find_colour
from ...envs.vehicle.vehicles import VEHICLES
from ..harness.drives import make_env
from ..harness.explorer import Explorer, Panel
from ..harness.results import Suite
from ..harness.stats import Estimate, geometric_mean
from ..report.kml import make_track_kml
from .answer import compute_relative_costs, find_best_controller, is_default_filter
from .build import get_filter_name, make_agent_options, make_estimate_options
from .cells import ORACLE_NAMES, REFERENCE_CONTROLLER, TRUTH, ControlEntry
from .contests import NOMINAL, TITLES, ControlTask
from .episodes import SIGNALS
from .ladder import DELAY_TASK, DELAYS, DelayCost, make_cost_lines
from .run import Results
from .tables import Standing

_PANELS = (
    Panel("sideslip / mrad", (("beta", "true"), ("beta_ref", "reference"))),
    Panel("yaw rate / (rad/s)", (("gamma", "true"), ("gamma_ref", "reference"))),
    Panel("yaw moment / (N m)", (("yaw_moment", "delivered"),)),
    Panel("front steering / mrad", (("steer", "delivered"),)),
)
_SCALES = {"beta": 1e3, "beta_ref": 1e3, "steer": 1e3}
_BODY = (1.5, 1.15)  # of a car, over its wheelbase and its track
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

    foresight: (n,) log(J_oracle-state / J_clairvoyant) of calibrated contests.
    """
    series = {
        entry: result.series
        for entry, result in results.outcomes.items()
        if result.series is not None
    }
    best = find_best_controller(by_tier)
    suite.files += _make_tracks(series, best)
    try:
        from ..report.figures import draw_curves, draw_groups
    except ModuleNotFoundError:
        return
    questions = (
        ("Which controller holds the car?", {"All contests": compute_relative_costs(by_tier)}),
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
        text = (
            f"{DELAY_TASK.name}: camera every 50 ms, GPS every 200 ms; each filter is designed "
            "for its delay."
        )
        suite.answers.append(("What does late sensing cost?", figure, text))
    suite.explorers.append(_make_explorer(series, best))
    for tier, standings in by_tier.items():
        suite.figures += _draw_maps(tier, standings)


def _group_costs(
    by_tier: Mapping[str, Sequence[Standing]], name: Any
) -> dict[str, dict[str, Estimate]]:
    """By tier, the cost over nominal's in %, the best first; name: of a cell, "" leaves it out."""
    groups = {}
    for tier, standings in by_tier.items():
        costs = {
            name(standing.entry): Estimate(
                *(100.0 * n for n in standing.overall["cost_vs_nominal"])
            )
            for standing in standings
            if name(standing.entry) and "cost_vs_nominal" in standing.overall
        }
        title = f"Tier {tier}: {TITLES[tier]}"
        groups[title] = dict(sorted(costs.items(), key=lambda pair: pair[1].value))
    return {title: costs for title, costs in groups.items() if costs}


def _estimator(cell: ControlEntry) -> str:
    return cell.estimator if cell.controller == REFERENCE_CONTROLLER else ""


def _controller(cell: ControlEntry) -> str:
    has_default = is_default_filter(cell.controller, cell.estimator) and cell.controller != NOMINAL
    return cell.controller if has_default and cell.estimator != TRUTH else ""


def _group_oracles(
    by_tier: Mapping[str, Sequence[Standing]], foresight: Mapping[ControlTask, Array]
) -> dict[str, dict[str, Estimate]]:
    groups = _group_costs(
        by_tier, lambda entry: entry.controller if entry.controller in ORACLE_NAMES else ""
    )
    for tier in by_tier:
        title = f"Tier {tier}: {TITLES[tier]}"
        logs = [value for task, value in foresight.items() if task.tier == tier]
        if logs and "oracle-state" in groups.get(title, {}):
            state = groups[title]["oracle-state"].value
            ratio = geometric_mean(*(-value for value in logs))
            groups[title]["clairvoyant"] = Estimate(*(state * value for value in ratio))
    return groups


def _draw_maps(tier: str, standings: Sequence[Standing]) -> list[tuple[str, Any, str]]:
    from ..report.heat_maps import draw_heat_map

    names = [standing.label for standing in standings]
    tasks = list(dict.fromkeys(c for standing in standings for c in standing.results))
    figures = []
    for metric, good, text in (
        ("cost_vs_nominal", "low", "Over nominal's, the paired geometric mean; 1: nominal."),
        ("failure_rate", "low", "The share of episodes in which the car spun or left the road."),
    ):
        values = np.full((len(standings), len(tasks)), np.nan)
        for i, standing in enumerate(standings):
            for j, task in enumerate(tasks):
                if metric in standing.by_task.get(task, {}):
                    values[i, j] = standing.by_task[task][metric].value
        if np.isfinite(values).any():
            title = f"Tier {tier}: {metric.replace('_', ' ')} in every contest"
            columns = [task.name for task in tasks]
            figures.append((title, draw_heat_map(names, columns, values, metric, good), text))
    return figures


def _make_tracks(series: Mapping[ControlEntry, Array], best: str) -> list[tuple[str, str, str]]:
    """The tracks of the first and the last contest, for a map: no control and the best one."""
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
    """Every cell's first test seed; at first no control and the best controller."""
    labels = (
        c.label for c in series if c.controller == best and is_default_filter(best, c.estimator)
    )
    keyed: dict[tuple[str, ...], Array] = {
        (c.task.tier, c.task.name, c.label): values for c, values in series.items()
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
    """Episodes of which two are shown beside each other, at first `none` and the best.

    series: key (one name a menu, and the contestant) to what `Driven` keeps of one.
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
    """One episode of a contestant in a single env."""
    return rollout(*make_env_and_agent(entry), seed)


def make_env_and_agent(entry: ControlEntry) -> tuple[Any, Any]:
    """A single env with its filter, and the contestant that drives it."""
    estimate = make_estimate_options(entry) if entry.estimator else None
    name = get_filter_name(entry.estimator)
    env = make_env(entry.task.env_id, name, estimate, **entry.env_options)
    return env, make_agent(entry.controller, env, **make_agent_options(entry))
