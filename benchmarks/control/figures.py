"""The matrix's figures: a picture for each question, heat maps, any two cells side by side."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import Array
from ...envs.rendering.palette import colour
from ...envs.vehicle.vehicles import VEHICLES
from ..harness.drives import make_env
from ..harness.explorer import Explorer, Panel
from ..harness.results import Suite
from ..harness.stats import Estimate, geometric_mean
from ..report.kml import track_kml
from .answer import best_controller, costs, on_its_own
from .build import agent_options, estimate_options, name_of
from .cells import REFERENCE_CONTROLLER, RUNGS, TRUTH, Cell
from .contests import NOMINAL, TITLES, Contest
from .episodes import SIGNALS
from .ladder import DELAYS, PRICE_CONTEST, Price, lines
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


def illustrate(
    suite: Suite,
    found: Mapping[str, Sequence[Standing]],
    results: Results,
    prices: Sequence[Price],
    ahead: Mapping[Contest, Array],
) -> None:
    """Add the figures to a suite that has its verdict; without plotly only the tracks.

    ahead: (n,) log(J_oracle-state / J_clairvoyant) of calibrated contests.
    """
    series = {cell: each.series for cell, each in results.found.items() if each.series is not None}
    best = best_controller(found)
    suite.files += _tracks(series, best)
    try:
        from ..report.figures import curves, groups_with_interval
    except ModuleNotFoundError:
        return
    asked = (
        ("Which controller holds the car?", {"All contests": costs(found)}),
        ("Which controller holds it in each tier?", _groups(found, _controller)),
        ("Which estimator does a controller drive best with?", _groups(found, _estimator)),
        ("What would knowing more save?", _ladder(found, ahead)),
    )
    suite.answers += [
        (title, groups_with_interval(groups, _COST, {100.0: "nominal"}), _CAPTION)
        for title, groups in asked
        if any(groups.values())
    ]
    shown = lines(prices)
    if shown:
        ms, label = 1e3 * np.array(DELAYS), "cost / nominal's with sensors in time"
        figure = curves(ms, shown, "further delay of camera and GPS / ms", label)
        text = (
            f"{PRICE_CONTEST.name}: camera every 50 ms, GPS every 200 ms; each filter is designed "
            "for its delay."
        )
        suite.answers.append(("What does late sensing cost?", figure, text))
    suite.explorers.append(_two_cells(series, best))
    for tier, standings in found.items():
        suite.figures += _maps(tier, standings)


def _groups(found: Mapping[str, Sequence[Standing]], name: Any) -> dict[str, dict[str, Estimate]]:
    """By tier, the cost over nominal's in %, the best first; name: of a cell, "" leaves it out."""
    groups = {}
    for tier, standings in found.items():
        costs = {
            name(each.cell): Estimate(*(100.0 * n for n in each.overall["cost_vs_nominal"]))
            for each in standings
            if name(each.cell) and "cost_vs_nominal" in each.overall
        }
        title = f"Tier {tier}: {TITLES[tier]}"
        groups[title] = dict(sorted(costs.items(), key=lambda pair: pair[1].value))
    return {title: costs for title, costs in groups.items() if costs}


def _estimator(cell: Cell) -> str:
    return cell.estimator if cell.controller == REFERENCE_CONTROLLER else ""


def _controller(cell: Cell) -> str:
    own = on_its_own(cell.controller, cell.estimator) and cell.controller != NOMINAL
    return cell.controller if own and cell.estimator != TRUTH else ""


def _ladder(
    found: Mapping[str, Sequence[Standing]], ahead: Mapping[Contest, Array]
) -> dict[str, dict[str, Estimate]]:
    groups = _groups(found, lambda cell: cell.controller if cell.controller in RUNGS else "")
    for tier in found:
        title = f"Tier {tier}: {TITLES[tier]}"
        mine = [each for contest, each in ahead.items() if contest.tier == tier]
        if mine and "oracle-state" in groups.get(title, {}):
            state = groups[title]["oracle-state"].value
            over = geometric_mean(*(-each for each in mine))
            groups[title]["clairvoyant"] = Estimate(*(state * each for each in over))
    return groups


def _maps(tier: str, standings: Sequence[Standing]) -> list[tuple[str, Any, str]]:
    from ..report.heat_maps import heat_map

    names = [each.label for each in standings]
    contests = list(dict.fromkeys(c for each in standings for c in each.results))
    figures = []
    for metric, good, text in (
        ("cost_vs_nominal", "low", "Over nominal's, the paired geometric mean; 1: nominal."),
        ("failure_rate", "low", "The share of episodes in which the car spun or left the road."),
    ):
        values = np.full((len(standings), len(contests)), np.nan)
        for i, each in enumerate(standings):
            for j, contest in enumerate(contests):
                if metric in each.by_contest.get(contest, {}):
                    values[i, j] = each.by_contest[contest][metric].value
        if np.isfinite(values).any():
            title = f"Tier {tier}: {metric.replace('_', ' ')} in every contest"
            columns = [contest.name for contest in contests]
            figures.append((title, heat_map(names, columns, values, metric, good), text))
    return figures


def _tracks(series: Mapping[Cell, Array], best: str) -> list[tuple[str, str, str]]:
    """The tracks of the first and the last contest, for a map: no control and the best one."""
    contests = list(dict.fromkeys(cell.contest for cell in series))
    files = []
    for contest in dict.fromkeys(contests[:1] + contests[-1:]):
        places = {
            cell.label: (each[:, 1 + SIGNALS.index("X")], each[:, 1 + SIGNALS.index("Y")])
            for cell, each in series.items()
            if cell.contest == contest and cell.controller in ("none", best)
            if on_its_own(cell.controller, cell.estimator)
        }
        text = track_kml(contest.name, places, {name: colour(name) for name in places})
        name = f"{contest.name.replace(', ', '-')}.kml"
        files.append((name, "application/vnd.google-earth.kml+xml", text))
    return files


def _two_cells(series: Mapping[Cell, Array], best: str) -> Explorer:
    """Every cell's first test seed; at first no control and the best controller."""
    own = (c.label for c in series if c.controller == best and on_its_own(best, c.estimator))
    keyed: dict[tuple[str, ...], Array] = {
        (c.contest.tier, c.contest.name, c.label): each for c, each in series.items()
    }
    bodies: dict[tuple[str, ...], tuple[float, float]] = {}
    for cell in series:
        car = VEHICLES[cell.contest.vehicle or "coms"]
        size = (_BODY[0] * car.wheelbase, _BODY[1] * car.front_track)
        bodies[cell.contest.tier, cell.contest.name] = size
    best = next(own, "")
    return over_time("Any two side by side", ("tier", "contest"), keyed, best, bodies)


def over_time(
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
        cells[key] = {name: _SCALES.get(name, 1.0) * each for name, each in signals.items()}
    caption = (
        "The same seed in both: line the contestant's, dashed the reference. The arrow is where "
        "the car goes in a quarter of a second, its angle to the body the sideslip."
    )
    return Explorer(title, menus, cells, _PANELS, caption, ("none", best), bodies or {})


def run_of(cell: Cell, seed: int) -> Rollout:
    """One episode of a contestant in a single env."""
    return rollout(*contestant_of(cell), seed)


def contestant_of(cell: Cell) -> tuple[Any, Any]:
    """A single env with its filter, and the contestant that drives it."""
    estimate = estimate_options(cell) if cell.estimator else None
    name = name_of(cell.estimator)
    env = make_env(cell.contest.env_id, name, estimate, **cell.env_options)
    return env, make_agent(cell.controller, env, **agent_options(cell))
