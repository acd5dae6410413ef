"""One figure a question: error against a quantity, and whether intervals hold what they promise."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ... import __version__
from ...envs.record import Array
from ..harness.results import Row, Suite, Table
from ..harness.stats import Estimate, interval, mean, mean_share, ratio_of_roots, root_mean
from .conditions import CONDITIONS, CURVES, PARTS, WITHOUT, Condition, Curve
from .measure import LEVELS, Measured

BOUND = "the bound"


def columns_of(what: Condition, found: Measured) -> dict[str, Any]:
    """The columns that the rows of a condition share."""
    version = f"{what.env_id} {__version__}"
    here = {"suite": "unknown", "scenario": what.name, "salt": "fixed", "env_version": version}
    return here | {"n": len(found.best)}


def _rows(what: Condition, found: Measured, label: str) -> list[Row]:
    """A filter's error and NEES, and its error over the bound where there is one."""
    squares, nees, _ = found.of(label)
    numbers = {"rmse": interval(squares, root_mean), "nees": interval(nees, mean)}
    if what.bounded:
        numbers["rmse_over_bound"] = interval(squares, ratio_of_roots, found.best)
    here = columns_of(what, found)
    return [Row.of(metric, number, estimator=label, **here) for metric, number in numbers.items()]


def add_curve(suite: Suite, curve: Curve, found: Sequence[Measured]) -> None:
    """Rows and a figure of a curve; no figure where plotly is not installed."""
    conditions = curve.conditions()
    labels = list(found[0].labels)
    lines = dict[str, list[Estimate]]()
    for what, each in zip(conditions, found, strict=True):
        for label in labels:
            suite.rows += _rows(what, each, label)
            lines.setdefault(label, []).append(interval(each.of(label)[0], root_mean))
        if what.bounded:
            best = interval(each.best, root_mean)
            suite.rows.append(Row.of("rmse", best, estimator=BOUND, **columns_of(what, each)))
            lines.setdefault(BOUND, []).append(best)
    try:
        from ..report.figures import curves
    except ModuleNotFoundError:
        return
    series = {label: _columns(values, 1e3) for label, values in lines.items()}
    unit = "RMSE of the sideslip angle / mrad"
    figure = curves(np.array(curve.values), series, curve.label, unit, curve.log)
    suite.answers.append((curve.question, figure, _answer(lines, found)))


def _columns(line: Sequence[Estimate], scale: float) -> tuple[Array, Array, Array]:
    """Values, lows and highs of a line."""
    value, low, high = scale * np.array(line).T
    return value, low, high


def _answer(lines: Mapping[str, Sequence[Estimate]], found: Sequence[Measured]) -> str:
    """From the first point to the last."""
    n = min(len(each.best) for each in found)
    spans = [
        f"{label} {1e3 * values[0].value:.2g} to {1e3 * values[-1].value:.2g}"
        for label, values in lines.items()
    ]
    return f"From left to right, mrad: {', '.join(spans)}; at least {n} drives a point."


def add_reliability(suite: Suite, found: Sequence[Measured]) -> None:
    """Rows and a figure of the share of errors within an interval against its confidence, where
    nothing happens that `joint` cannot foresee.

    Conditions share their seeds, so each seed's share is its mean over them; of conditions with the
    same drives the first one counts. found: of all `CONDITIONS`.
    """
    shares = dict[str, list[Estimate]]()
    drives = {(what.env_id, repr(what.scenario)): what for what in reversed(CONDITIONS)}
    for saturating in (False, True):
        kind = "saturating tyres" if saturating else "linear tyres"
        mine = [
            (what, each)
            for what, each in zip(CONDITIONS, found, strict=True)
            if what.foreseen
            and what.bounded != saturating
            and len(each.best)
            and what is drives[what.env_id, repr(what.scenario)]
        ]
        for label in ("joint", "exact-kf"):
            by_seed = dict[int, list[Array]]()
            for _, each in mine:
                for seed, share in zip(each.seeds, each.of(label)[2], strict=True):
                    by_seed.setdefault(seed, []).append(share)
            inside = np.array([np.mean(each, axis=0) for each in by_seed.values()])
            line = [mean_share(column) for column in inside.T]
            shares[f"{label}, {kind}"] = line
            here = columns_of(*mine[0]) | {"scenario": f"all with {kind}", "n": len(inside)}
            suite.rows += [
                Row.of(f"covered_{100.0 * level:.0f}", share, estimator=label, **here)
                for level, share in zip(LEVELS, line, strict=True)
            ]
    try:
        from ..report.figures import curves
    except ModuleNotFoundError:
        return
    percent = 100.0 * np.array(LEVELS)
    series: dict[str, Any] = {label: _columns(line, 1e2) for label, line in shares.items()}
    series["ideal"] = percent
    labels = ("confidence of the interval / %", "errors within it / %")
    at = LEVELS.index(0.9)
    text = "; ".join(f"{label} {100.0 * line[at].value:.0f} %" for label, line in shares.items())
    question = "Do the intervals hold what they promise?"
    text = f"In the interval of 90 % are: {text}. Below the diagonal a filter is too sure."
    suite.answers.append((question, curves(percent, series, *labels), text))


def parts_table(suite: Suite, found: Sequence[Measured]) -> Table:
    """Rows and a table of the filter's error without each of its parts, over that with all.

    found: of all `PARTS`.
    """
    cells = [[label] for label in WITHOUT]
    for what, each in zip(PARTS, found, strict=True):
        whole = each.of(next(iter(WITHOUT)))[0]
        here = columns_of(what, each)
        for line, label in zip(cells, WITHOUT, strict=True):
            squares = each.of(label)[0]
            error, ratio = interval(squares, root_mean), interval(squares, ratio_of_roots, whole)
            suite.rows += [
                Row.of(metric, number, estimator=label, **here)
                for metric, number in (("rmse", error), ("ratio", ratio))
            ]
            line.append(f"{1e3 * error.value:.2f} ({ratio.value:.2f})")
    return Table(
        f"What each part of joint saves: RMSE / mrad, and over the complete one's "
        f"({len(found[0].best)} seeds)",
        ("filter", *(what.name for what in PARTS)),
        cells,
        "complete: accelerometer, both stiffnesses, friction, biases of gyro and accelerometer, a "
        "force and a moment. Below 1 the part costs more than it saves there.",
    )


def all_points() -> list[Condition]:
    """The conditions of all curves, one after the other."""
    return [what for curve in CURVES for what in curve.conditions()]
