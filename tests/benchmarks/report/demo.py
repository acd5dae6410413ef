"""Two suites with made-up numbers and signals, and texts that would break a careless page."""

from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.harness.results import Column, Explorer, Line, ResultTable, Suite
from sideslip.benchmarks.harness.stats import Estimate

HOSTILE = "</script><b>1 & 2</b>"
COMMAND = "sideslip bench --html report.html --json results.json"
VERSIONS = {"sideslip": "0.1.0", "Python": "3.11.2", "numpy": "2.3.4", "odd": HOSTILE}
ESTIMATORS = {
    "exact-kf": (1.31, 1.24, 1.38, 1.02, 0.412),
    "multirate-kf": (1.74, 1.65, 1.83, 1.35, 0.098),
    "single-rate-kf": (2.96, 2.81, 3.12, 2.30, 0.071),
    "bicycle-kf": (10.2, 9.81, 10.6, 7.92, 0.052),
}


def estimation(figures: bool = True) -> Suite:
    records: list[Line] = [
        {"estimator": name, "rmse": Estimate(*errors), "over the bound": over, "cost": cost}
        for name, (*errors, over, cost) in ESTIMATORS.items()
    ]
    records.append({"estimator": "the bound", "rmse": 1.29, "over the bound": 1.0})
    rmse, cost = Column("rmse", "RMSE / mrad", form=".2f"), Column("cost", "us per tick")
    columns = ("estimator", rmse, Column("over the bound", form=".2f"), cost)
    suite = Suite(
        "estimation",
        "Which estimator comes closest to the sideslip angle",
        "Root mean square error from 2 s on; `exact-kf` knows the delay.\n\nIntervals are 95 %.",
        tables=[
            ResultTable(
                "tie-vision Fig. 7 (100 seeds)", columns, records, "Sine steering at 25 km/h."
            ),
            ResultTable("Odd texts", ("name", HOSTILE), [[HOSTILE, "a < b"]], HOSTILE),
        ],
    )
    suite.verdict = f"Best estimator: `exact-kf`.\nNot covered: {HOSTILE}."
    if figures:
        suite.figures = drawn()
        suite.answers = [answered()]
    return suite


def answered() -> tuple[str, Any, str]:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    numbers = {name: Estimate(*each[:3]) for name, each in ESTIMATORS.items()}
    groups = {"Late camera": numbers, HOSTILE: numbers}
    drawn = figures.draw_groups(groups, "error / the least possible", {2.0: "twice"})
    return "Which estimator is the best?", drawn, "Best estimator: `exact-kf`."


def control() -> Suite:
    cells = [
        ["none", 12.41, 1.0, 0.0],
        ["feedforward", 6.52, 0.53, 1.3],
        ["single-rate", 5.04, 0.41, 96.0],
        ["multirate", 3.98, 0.32, 11.2],
    ]
    numbers = map(Column, ("RMS slip / mrad", "over none", "largest 1 ms step / N m"))
    columns = ("controller", *numbers)
    table = ResultTable("tie-vision Fig. 8, tyres as believed (20 seeds)", columns, cells)
    text = "A single lane change at 25 km/h."
    suite = Suite("control", "Which controller keeps it small", text, tables=[table])
    suite.verdict = "Best controller: multirate."
    return suite


def drawn() -> list[tuple[str, Any, str]]:
    """Plausible signals: a sine of the sideslip angle, and estimates with their own errors."""
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 10.0, 1e-3)
    beta = 12.0 * np.sin(2 * np.pi * 0.5 * t) * np.minimum(t, 1.0)
    errors = {}
    for name, (rmse, *_) in ESTIMATORS.items():
        walk = np.cumsum(rng.normal(size=t.size)) * 1e-2
        errors[name] = rmse * (0.4 * (walk - walk.mean()) + 0.5 * np.sin(3.1 * t + rmse))
    errors["exact-kf, true model"] = 0.5 * errors["exact-kf"]
    seen = np.where(np.arange(t.size) % 33 == 0, beta + rng.normal(size=t.size), np.nan)
    lines = {name: beta + error for name, error in errors.items()}
    label = "sideslip angle / mrad"
    numbers = {name: Estimate(*v[:3]) for name, v in ESTIMATORS.items()} | {
        "the bound": Estimate(1.29)
    }
    bars = figures.draw_groups({"All": numbers}, "RMSE of the sideslip angle / mrad", {})
    x, y = 7.0 * t, 1.75 * (1 + np.tanh(t - 5.0))
    paths = {"truth": (x, y), "multirate-kf": (x, y + 0.02 * t), "bicycle-kf": (x, y + 0.2 * t)}
    course = {"truth": beta, "camera": seen} | lines
    return [
        ("Error of each estimator", bars, "Shorter is better."),
        ("The same once more, without a caption", bars, ""),
        (
            "The sideslip angle",
            figures.draw_time_series(t, course, label, dots=["camera"]),
            f"The paper's figure, redrawn: {HOSTILE}",
        ),
        (
            "Errors (seed 0)",
            figures.draw_time_series(t, errors, f"error of the {label}", zero_line=True),
            "Estimate minus truth.",
        ),
        ("The track", figures.draw_track(paths), "Dead reckoning with each estimate."),
    ]


def _place(t: Any) -> dict[str, Any]:
    return {"X": 10.0 * t, "Y": np.sin(t), "psi": 0.1 * np.cos(t)}


def matrix() -> Suite:
    """What only the matrix has: two cells side by side and in motion."""
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    t = np.linspace(0.0, 8.0, 801)
    cells: dict[tuple[str, ...], dict[str, Any]] = {
        (manoeuvre, who): {"t": t, "beta": k * np.sin(t + k), **_place(t)}
        for k, (manoeuvre, who) in enumerate(
            [("gust", "none"), ("gust", "lqr"), ("step-steer", "none"), ("step-steer", HOSTILE)], 1
        )
    }
    panels = {name: [("beta", "true")] for name in ("slip / mrad", "again / mrad")}
    delays = np.array([0.0, 100.0, 300.0])
    line = (np.array([0.9, 0.8, 0.5]), np.array([0.88, 0.78, 0.4]), np.array([0.92, 0.82, 0.6]))
    return Suite(
        "control",
        "Which controller and estimator hold the car",
        "Made up.",
        figures=[
            ("Delay", figures.draw_curves(delays, {"lqr": line}, "delay / ms", "score"), ""),
        ],
        explorers=[Explorer("Any two", ("manoeuvre",), cells, panels, "One.", ("none", HOSTILE))],
    )
