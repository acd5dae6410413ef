"""One figure a question: error against a quantity, and whether intervals hold what they promise."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ... import __version__
from ...envs.record import Array
from ..harness.results import ResultRow, ResultTable, Suite
from ..harness.stats import Estimate, interval, mean, mean_share, ratio_of_roots, root_mean
from .conditions import CONDITIONS, CURVES, PARTS, WITHOUT, Condition, Curve
from .measure import LEVELS, ConditionResult

BOUND = "the bound"


def make_columns(condition: Condition, result: ConditionResult) -> dict[str, Any]:
    """The columns that the rows of a condition share."""
    version = f"{condition.env_id} {__version__}"
    common = {
        "suite": "unknown",
        "scenario": condition.name,
        "salt": "fixed",
        "env_version": version,
    }
    return common | {"n": len(result.best)}


def _make_rows(condition: Condition, result: ConditionResult, label: str) -> list[ResultRow]:
    """A filter's error and NEES, and its error over the bound where there is one."""
    squares, nees, _ = result.select(label)
    numbers = {"rmse": interval(squares, root_mean), "nees": interval(nees, mean)}
    if condition.bounded:
        numbers["rmse_over_bound"] = interval(squares, ratio_of_roots, result.best)
    columns = make_columns(condition, result)
    return [
        ResultRow.from_estimate(metric, number, estimator=label, **columns)
        for metric, number in numbers.items()
    ]


def add_curve(suite: Suite, curve: Curve, results: Sequence[ConditionResult]) -> None:
    """Rows and a figure of a curve; no figure where plotly is not installed."""
    conditions = curve.conditions()
    labels = list(results[0].labels)
    lines = dict[str, list[Estimate]]()
    for condition, result in zip(conditions, results, strict=True):
        for label in labels:
            suite.rows += _make_rows(condition, result, label)
            lines.setdefault(label, []).append(interval(result.select(label)[0], root_mean))
        if condition.bounded:
            best = interval(result.best, root_mean)
            suite.rows.append(
                ResultRow.from_estimate(
                    "rmse", best, estimator=BOUND, **make_columns(condition, result)
                )
            )
            lines.setdefault(BOUND, []).append(best)
    try:
        from ..report.figures import draw_curves
    except ModuleNotFoundError:
        return
    series = {label: _split_line(values, 1e3) for label, values in lines.items()}
    unit = "RMSE of the sideslip angle / mrad"
    figure = draw_curves(np.array(curve.values), series, curve.label, unit, curve.log)
    suite.answers.append((curve.question, figure, _describe_range(lines, results)))


def _split_line(line: Sequence[Estimate], scale: float) -> tuple[Array, Array, Array]:
    """Values, lows and highs of a line."""
    value, low, high = scale * np.array(line).T
    return value, low, high


def _describe_range(
    lines: Mapping[str, Sequence[Estimate]], results: Sequence[ConditionResult]
) -> str:
    """From the first point to the last."""
    n = min(len(result.best) for result in results)
    spans = [
        f"{label} {1e3 * values[0].value:.2g} to {1e3 * values[-1].value:.2g}"
        for label, values in lines.items()
    ]
    return f"From left to right, mrad: {', '.join(spans)}; at least {n} drives a point."


def add_reliability(suite: Suite, results: Sequence[ConditionResult]) -> None:
    """Rows and a figure of the share of errors within an interval against its confidence, where
    nothing happens that `joint` cannot foresee.

    Conditions share their seeds, so each seed's share is its mean over them; of conditions with the
    same drives the first one counts. found: of all `CONDITIONS`.
    """
    shares = dict[str, list[Estimate]]()
    drives = {
        (condition.env_id, repr(condition.scenario)): condition
        for condition in reversed(CONDITIONS)
    }
    for saturating in (False, True):
        kind = "saturating tyres" if saturating else "linear tyres"
        selected = [
            (condition, item)
            for condition, item in zip(CONDITIONS, results, strict=True)
            if condition.modelled
            and condition.bounded != saturating
            and len(item.best)
            and condition is drives[condition.env_id, repr(condition.scenario)]
        ]
        for label in ("joint", "exact-kf"):
            by_seed = dict[int, list[Array]]()
            for _, item in selected:
                for seed, share in zip(item.seeds, item.select(label)[2], strict=True):
                    by_seed.setdefault(seed, []).append(share)
            inside = np.array([np.mean(item, axis=0) for item in by_seed.values()])
            line = [mean_share(column) for column in inside.T]
            shares[f"{label}, {kind}"] = line
            columns = make_columns(*selected[0]) | {
                "scenario": f"all with {kind}",
                "n": len(inside),
            }
            suite.rows += [
                ResultRow.from_estimate(
                    f"covered_{100.0 * level:.0f}", share, estimator=label, **columns
                )
                for level, share in zip(LEVELS, line, strict=True)
            ]
    try:
        from ..report.figures import draw_curves
    except ModuleNotFoundError:
        return
    percent = 100.0 * np.array(LEVELS)
    series: dict[str, Any] = {label: _split_line(line, 1e2) for label, line in shares.items()}
    series["ideal"] = percent
    labels = ("confidence of the interval / %", "errors within it / %")
    at = LEVELS.index(0.9)
    text = "; ".join(f"{label} {100.0 * line[at].value:.0f} %" for label, line in shares.items())
    question = "Do the intervals hold what they promise?"
    text = f"In the interval of 90 % are: {text}. Below the diagonal a filter is too sure."
    suite.answers.append((question, draw_curves(percent, series, *labels), text))


def make_parts_table(suite: Suite, results: Sequence[ConditionResult]) -> ResultTable:
    """Rows and a table of the filter's error without each of its parts, over that with all.

    results: of all `PARTS`.
    """
    cells = [[label] for label in WITHOUT]
    for condition, result in zip(PARTS, results, strict=True):
        complete_squares = result.select(next(iter(WITHOUT)))[0]
        columns = make_columns(condition, result)
        for line, label in zip(cells, WITHOUT, strict=True):
            squares = result.select(label)[0]
            error, ratio = (
                interval(squares, root_mean),
                interval(squares, ratio_of_roots, complete_squares),
            )
            suite.rows += [
                ResultRow.from_estimate(metric, number, estimator=label, **columns)
                for metric, number in (("rmse", error), ("ratio", ratio))
            ]
            line.append(f"{1e3 * error.value:.2f} ({ratio.value:.2f})")
    return ResultTable(
        f"What each part of joint saves: RMSE / mrad, and over the complete one's "
        f"({len(results[0].best)} seeds)",
        ("filter", *(condition.name for condition in PARTS)),
        cells,
        "complete: accelerometer, both stiffnesses, friction, biases of gyro and accelerometer, a "
        "force and a moment. Below 1 the part costs more than it saves there.",
    )


def list_conditions() -> list[Condition]:
    """The conditions of all curves, one after the other."""
    return [condition for curve in CURVES for condition in curve.conditions()]
