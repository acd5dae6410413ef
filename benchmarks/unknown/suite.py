"""Question: what does it cost to know neither tyres nor noise? `joint` on cars whose front and rear
stiffness are drawn from 0.6 to 1.4 of what filters assume, over the bound that knows them."""

from collections.abc import Mapping

import numpy as np
from rich.console import Console

from ... import __version__
from ..harness.parallel import run_cases
from ..harness.results import ResultRow, ResultTable, Suite
from ..harness.stats import Estimate, interval, mean, ratio_of_roots
from ..harness.verdict import format_verdict
from .conditions import CAMERA, CONDITIONS, CURVES, PARTS
from .curves import add_curve, add_reliability, list_conditions, make_columns, make_parts_table
from .measure import LEVELS, measure_all

SEEDS, QUICK_SEEDS = 256, 8
NAME = "unknown"
COVERED = (0.5, 0.8, 0.95)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Every condition on the seeds 0 .. seeds-1; curves and parts on the first quarter of many."""
    few = min(seeds, max(seeds // 4, QUICK_SEEDS))
    results = measure_all(CONDITIONS, seeds, NAME, jobs, console)
    points = measure_all(list_conditions(), few, f"{NAME}: curves", jobs, console)
    parts = measure_all(PARTS, few, f"{NAME}: parts", jobs, console)
    suite = Suite(
        NAME,
        "What does it cost not to know the tyres?",
        'Root mean square error of the sideslip angle from 2 s on (of "from the change on" '
        "from 5 s), over the bound that knows the tyres: the optimal filter of the true linear "
        "car with its true disturbances, which knows when tyres change, but not how "
        "strong a gust is. joint and exact-kf know the nominal car "
        "and the data sheet's noise. NEES: the mean square of joint's error over its own "
        "deviation, 1 where that is honest. Where tyres saturate there is no such bound; the ratio "
        "is to exact-kf alone. Intervals are 95 % over seeds.",
    )
    ratios, against, lines = dict[str, dict[str, Estimate]](), dict[str, Estimate](), []
    for condition, item in zip(CONDITIONS, results, strict=True):
        (joint_squares, nees, inside), exact_squares = (
            item.select("joint"),
            item.select("exact-kf")[0],
        )
        saved, honest = interval(joint_squares, ratio_of_roots, exact_squares), interval(nees, mean)
        against[condition.name], known = saved, None
        covered = inside.mean(axis=0)
        numbers = {"rmse_over_exact_kf": saved, "nees": honest}
        numbers |= {"covered_95": Estimate(float(covered[-1]))}
        if condition.bounded:
            known = numbers["rmse_over_bound"] = interval(joint_squares, ratio_of_roots, item.best)
            best = interval(exact_squares, ratio_of_roots, item.best)
            ratios[condition.name] = {"joint": known, "exact-kf": best}
        theory = interval(
            joint_squares, ratio_of_roots, item.variances[:, item.labels.index("joint")]
        )
        numbers["rmse_over_own"] = theory
        columns = make_columns(condition, item)
        suite.rows += [
            ResultRow.from_estimate(k, v, estimator="joint", **columns) for k, v in numbers.items()
        ]
        lines.append([
            condition.name, str(len(nees)), str(item.left_out), _format_ratio(known),
            _format_ratio(saved),
            f"{honest.value:.2f}", f"{theory.value:.2f}",
            *(f"{100.0 * covered[LEVELS.index(level)]:.0f}" for level in COVERED),
        ])  # fmt: skip
    head = ("condition", "n", "left out", "over the bound", "over exact-kf", "NEES", "over its own")
    suite.tables = [
        ResultTable(
            "joint, which assumes nominal tyres",
            (*head, *(f"in {100.0 * item:.0f} %" for item in COVERED)),
            lines,
            "left out: episodes that end early, in which tyres that saturate let the car "
            "spin. over its own: error over the deviation that joint gives, where NEES is 1 the "
            "limit of filters that do not know the tyres. in 50 %: share of the errors within the "
            "interval of that confidence.",
        ),
        make_parts_table(suite, parts),
        *_make_race_table(suite, max(few // 8, 2), jobs, console),
    ]
    suite.verdict = _compose_verdict(ratios, against)
    _draw_figures(suite, ratios)
    add_reliability(suite, results)
    rest = iter(points)
    for curve in CURVES:
        add_curve(suite, curve, [next(rest) for _ in curve.values])
    return suite


def _make_race_table(
    suite: Suite, seeds: int, jobs: int | None, console: Console | None
) -> list[ResultTable]:
    """Rows and a table of joint beside FilterPy's filter; none where FilterPy is not installed."""
    try:
        from .rival import DELAYS, compare_filters
    except ModuleNotFoundError:
        return []
    cases = [(delay, seed) for delay in DELAYS.values() for seed in range(seeds)]
    errors = np.reshape(
        run_cases(compare_filters, cases, f"{NAME}: FilterPy", jobs, console), (-1, seeds, 3, 2)
    )
    cells = []
    for name, values in zip(DELAYS, errors, strict=True):
        for i, label in enumerate(("joint", "FilterPy")):
            error = interval(values[:, i, 0], ratio_of_roots, values[:, 2, 0])
            us = Estimate(float(np.median(values[:, i, 1])))
            columns = {
                "suite": NAME,
                "scenario": name,
                "salt": "fixed",
                "n": seeds,
                "estimator": label,
            }
            columns["env_version"] = f"{CAMERA} {__version__}"
            numbers = {"rmse_over_bound": error, "us_per_tick": us}
            suite.rows += [
                ResultRow.from_estimate(metric, number, **columns)
                for metric, number in numbers.items()
            ]
            cells.append([name, label, _format_ratio(error), f"{us.value:.3g}"])
    head = ("camera", "filter", "over the bound", "CPU us a tick")
    text = (
        "The same eight states; FilterPy's takes a frame as it arrives. One core, in one process."
    )
    return [ResultTable("Beside FilterPy's extended Kalman filter", head, cells, text)]


def _format_ratio(ratio: Estimate | None) -> str:
    return ratio.inline() if ratio else ""


def _compose_verdict(
    ratios: Mapping[str, Mapping[str, Estimate]], against: Mapping[str, Estimate]
) -> str:
    joint = [item["joint"].value for item in ratios.values()]
    exact = [item["exact-kf"].value for item in ratios.values()]
    worst = max(ratios, key=lambda name: ratios[name]["joint"].value)
    four, one = (
        against[f"from the change on, {item}"].value for item in ("four members", "one filter")
    )
    return format_verdict(
        "A filter believes in the tyres of a data sheet; a real car's are up to 40 % off.",
        f"joint, which estimates them, has {min(joint):.2f} to {max(joint):.2f} times the least "
        f"error (worst: {worst}).",
        f"exact-kf, which believes in the data sheet, {min(exact):.1f} to {max(exact):.1f}.",
        f"Why: after a change of tyres a bank of four has {four / one:.2f} of one filter's error.",
        "Not covered: recorded cars, whose noise and forces are not known: `sideslip replay`.",
    )


def _draw_figures(suite: Suite, ratios: Mapping[str, Mapping[str, Estimate]]) -> None:
    """One picture; nothing where plotly is not installed."""
    try:
        from ..report.figures import draw_groups
    except ModuleNotFoundError:
        return
    bars = draw_groups(
        {k: dict(v) for k, v in ratios.items()},
        "error / that of a filter that knows the tyres: less is better",
        {1.0: "knows the tyres"},
    )
    text = suite.verdict.splitlines()[1]
    suite.answers.append(("What does it cost not to know the tyres?", bars, text))
