"""The matrix's figures: heat maps, any cell's time series, price of delay, runs in motion."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import Array
from ...envs.rendering.palette import INK, colour
from ...envs.vehicle.vehicles import VEHICLES
from ..harness.drives import make_env
from ..harness.explorer import Explorer, Panel
from ..harness.results import Suite
from ..report.kml import track_kml
from .build import agent_options, estimate_options, name_of
from .cells import REFERENCE_FILTER, Cell
from .contests import Contest
from .delay_price import DELAYS, PRICE_CONTEST, Price, lines
from .episodes import SIGNALS
from .run import Results
from .tables import Standing

_SHOWN = (  # in motion
    ("", "none"),
    ("multirate-kf, camera and gps", "two-dof"),
    (REFERENCE_FILTER, "lqr"),
)
_MOST = 2  # contests in motion
_PANELS = (
    Panel("sideslip angle / mrad", (("beta", "true", "#0072B2"), ("beta_ref", "reference", INK))),
    Panel("yaw rate / (rad/s)", (("gamma", "true", "#0072B2"), ("gamma_ref", "reference", INK))),
    Panel("yaw moment / (N m)", (("yaw_moment", "delivered", "#D55E00"),)),
    Panel("front steering / mrad", (("steer", "delivered", "#D55E00"),)),
)
_SCALES = {"beta": 1e3, "beta_ref": 1e3, "steer": 1e3}


def illustrate(
    suite: Suite,
    found: Mapping[str, Sequence[Standing]],
    results: Results,
    prices: Sequence[Price],
    seed: int,
) -> None:
    """Add the figures to the suite; without plotly only the tracks.

    seed: of the runs in motion.
    """
    contests = list(dict.fromkeys(cell.contest for cell in results.found))
    moving = contests[:1] + contests[-1:] if len(contests) > 1 else contests
    drives = {contest: runs_of(contest, seed) for contest in moving[:_MOST]}
    for contest, runs in drives.items():
        tracks = {name: (run["X"], run["Y"]) for name, run in runs.items()}
        text = track_kml(contest.name, tracks, {name: colour(name) for name in tracks})
        file = f"{contest.name.replace(', ', '-')}.kml"
        suite.files.append((file, "application/vnd.google-earth.kml+xml", text))
    try:
        from ..report.figures import curves
    except ModuleNotFoundError:
        return
    suite.explorers.append(_time_series(results))
    for tier, standings in found.items():
        suite.figures += _maps(tier, standings)
    shown = lines(prices)
    if shown:
        ms, label = 1e3 * np.array(DELAYS), "cost / nominal's with sensors in time"
        suite.figures.append(
            (
                "The price of delay",
                curves(ms, shown, "further delay of camera and GPS / ms", label),
                f"{PRICE_CONTEST.name}: camera every 50 ms, GPS every 200 ms. Each filter is "
                "designed for its delay.",
            )
        )
    for contest, runs in drives.items():
        suite.figures.append(in_motion(f"In motion: {contest.name}, first test seed", runs))


def runs_of(contest: Contest, seed: int) -> dict[str, Rollout]:
    """One episode of each contestant that is shown in motion and can be driven there."""
    cells = [Cell(contest, *shown) for shown in _SHOWN]
    return {cell.label: run_of(cell, seed) for cell in cells}


def in_motion(title: str, runs: Mapping[str, Rollout]) -> tuple[str, Any, str]:
    """A figure of a suite: cars from above; runs: by name. Needs plotly."""
    from ..report.heat_maps import animation

    size = (VEHICLES["coms"].wheelbase, VEHICLES["coms"].front_track)
    t = max((run["t"] for run in runs.values()), key=len)
    paths = {name: (run["X"], run["Y"], run["psi"]) for name, run in runs.items()}
    caption = (
        "A rectangle has the wheelbase and track of the car, drawn at its centre of gravity. A car "
        "whose episode ended stays where it was."
    )
    return title, animation(t, paths, size), caption


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


def _time_series(results: Results) -> Explorer:
    """Every cell's first test seed."""
    series: dict[tuple[str, ...], Array] = {
        (cell.contest.tier, cell.contest.name, cell.controller, cell.estimator): result.series
        for cell, result in results.found.items()
        if result.series is not None
    }
    menus = ("tier", "contest", "controller", "estimator")
    return over_time("Any cell over time (its first test seed)", menus, series)


def over_time(
    title: str, menus: Sequence[str], series: Mapping[tuple[str, ...], Array]
) -> Explorer:
    """Episodes to choose from; series: key (one name a menu) to what `Driven` keeps of one."""
    cells = {}
    for key, values in series.items():
        signals = dict(zip(("t", *SIGNALS), values.T, strict=True))
        cells[key] = {name: _SCALES.get(name, 1.0) * each for name, each in signals.items()}
    caption = "The same seed in every cell; thinned to 250 samples."
    return Explorer(title, menus, cells, _PANELS, caption)


def run_of(cell: Cell, seed: int) -> Rollout:
    """One episode of a contestant in a single env."""
    return rollout(*contestant_of(cell), seed)


def contestant_of(cell: Cell) -> tuple[Any, Any]:
    """A single env with its filter, and the contestant that drives it."""
    estimate = estimate_options(cell) if cell.estimator else None
    name = name_of(cell.estimator)
    env = make_env(cell.contest.env_id, name, estimate, **cell.env_options)
    return env, make_agent(cell.controller, env, **agent_options(cell))
