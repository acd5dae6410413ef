"""The matrix's figures: heat maps, any cell's time series, price of delay, runs in motion."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...agents import make_agent
from ...agents.rollout import Rollout, rollout
from ...envs.record import Array
from ...envs.vehicle.vehicle import VEHICLES
from ..harness.drives import make_env
from ..harness.explorer import Explorer, Panel
from ..harness.results import Suite
from ..report.colours import INK, colour
from ..report.kml import track_kml
from .build import estimate_options
from .cells import STEERING, YAW, Cell
from .delay_price import DELAYS, Price, lines
from .episodes import SIGNALS
from .run import Results
from .tables import Standing

_SHOWN = (  # in motion
    Cell(YAW, "", "", "none"),
    Cell(YAW, "", "multirate-residual-kf", "two-dof"),
    Cell(YAW, "", "exact-kf", "lqr"),
)
_MOVING = ("sine-with-dwell", "double-lane-change")
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
    drives = {
        m: {cell.label: run_of(replace(cell, scenario=m), seed) for cell in _SHOWN} for m in _MOVING
    }
    for manoeuvre, runs in drives.items():
        tracks = {name: (run["X"], run["Y"]) for name, run in runs.items()}
        text = track_kml(manoeuvre, tracks, {name: colour(name) for name in tracks})
        suite.files.append((f"{manoeuvre}.kml", "application/vnd.google-earth.kml+xml", text))
    try:
        from ..report.figures import curves
    except ModuleNotFoundError:
        return
    suite.explorers.append(_time_series(results))
    for env_id, standings in found.items():
        suite.figures += _maps(env_id, standings)
    for what, label in (("score", "score"), ("over", "cost / cost of informed")):
        shown = lines(prices, what)
        if shown:
            ms = 1e3 * np.array(DELAYS)
            suite.figures.append(
                (
                    f"The price of delay: {label}",
                    curves(ms, shown, "delay of camera and GPS / ms", label),
                    "Random steering, camera every 50 ms, GPS every 200 ms. informed is designed "
                    "for each delay; dividing by its cost leaves what a method loses by it.",
                )
            )
    for manoeuvre, runs in drives.items():
        suite.figures.append(in_motion(f"In motion: {manoeuvre}, first test seed", runs))


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


def _maps(env_id: str, standings: Sequence[Standing]) -> list[tuple[str, Any, str]]:
    from ..report.heat_maps import heat_map

    names = [each.label for each in standings]
    scenarios = list(standings[0].by_scenario)
    figures = []
    for metric, good, text in (
        ("score", "high", "0: the uncontrolled car, 1: the clairvoyant optimum."),
        ("cost_over_informed", "low", "1: the LQG of the true car with the same sensors."),
        ("spin_rate", "low", "The share of episodes in which the car spun."),
    ):
        values = np.array(
            [
                [e.by_scenario[s][metric].value if metric in e.by_scenario[s] else np.nan
                 for s in scenarios]
                for e in standings
            ]
        )  # fmt: skip
        if np.isfinite(values).any():
            title = f"{env_id}: {metric.replace('_', ' ')} on every manoeuvre"
            figures.append((title, heat_map(names, scenarios, values, metric, good), text))
    return figures


def _time_series(results: Results) -> Explorer:
    """Every cell's first test seed."""
    tables = {YAW: "yaw moment", STEERING: "yaw moment and steering"}
    series: dict[tuple[str, ...], Array] = {
        (tables[cell.env_id], cell.scenario, cell.controller, cell.estimator): result.series
        for cell, result in results.found.items()
        if result.series is not None
    }
    menus = ("action", "manoeuvre", "controller", "estimator")
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
    estimate = estimate_options(cell) if cell.estimator else None
    env = make_env(cell.env_id, cell.estimator, estimate, **cell.env_options)
    return rollout(env, make_agent(cell.controller, env), seed)
