"""Question: what does it cost to know neither tyres nor noise? `joint` on cars whose front and rear
stiffness are drawn from 0.6 to 1.4 of what filters assume, over the bound that knows them."""

from collections.abc import Mapping

import numpy as np
from rich.console import Console

from ... import __version__
from ..harness.parallel import run_cases
from ..harness.results import Row, Suite, Table
from ..harness.stats import Estimate, interval, mean, ratio_of_roots
from ..harness.verdict import verdict
from .conditions import CAMERA, CONDITIONS, CURVES, PARTS
from .curves import add_curve, add_reliability, all_points, columns_of, parts_table
from .measure import LEVELS, measure_all

SEEDS, QUICK_SEEDS = 256, 8
NAME = "unknown"
COVERED = (0.5, 0.8, 0.95)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Every condition on the seeds 0 .. seeds-1; curves and parts on the first quarter of many."""
    few = min(seeds, max(seeds // 4, QUICK_SEEDS))
    found = measure_all(CONDITIONS, seeds, NAME, jobs, console)
    points = measure_all(all_points(), few, f"{NAME}: curves", jobs, console)
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
    over, against, lines = dict[str, dict[str, Estimate]](), dict[str, Estimate](), []
    for what, each in zip(CONDITIONS, found, strict=True):
        (ours, nees, inside), theirs = each.of("joint"), each.of("exact-kf")[0]
        saved, honest = interval(ours, ratio_of_roots, theirs), interval(nees, mean)
        against[what.name], known = saved, None
        covered = inside.mean(axis=0)
        numbers = {"rmse_over_exact_kf": saved, "nees": honest}
        numbers |= {"covered_95": Estimate(float(covered[-1]))}
        if what.bounded:
            known = numbers["rmse_over_bound"] = interval(ours, ratio_of_roots, each.best)
            best = interval(theirs, ratio_of_roots, each.best)
            over[what.name] = {"joint": known, "exact-kf": best}
        theory = interval(ours, ratio_of_roots, each.own[:, each.labels.index("joint")])
        numbers["rmse_over_own"] = theory
        here = columns_of(what, each)
        suite.rows += [Row.of(k, v, estimator="joint", **here) for k, v in numbers.items()]
        lines.append([
            what.name, str(len(nees)), str(each.left_out), _cell(known), _cell(saved),
            f"{honest.value:.2f}", f"{theory.value:.2f}",
            *(f"{100.0 * covered[LEVELS.index(level)]:.0f}" for level in COVERED),
        ])  # fmt: skip
    head = ("condition", "n", "left out", "over the bound", "over exact-kf", "NEES", "over its own")
    suite.tables = [
        Table(
            "joint, which assumes nominal tyres",
            (*head, *(f"in {100.0 * each:.0f} %" for each in COVERED)),
            lines,
            "left out: episodes that end early, in which tyres that saturate let the car "
            "spin. over its own: error over the deviation that joint gives, where NEES is 1 the "
            "limit of filters that do not know the tyres. in 50 %: share of the errors within the "
            "interval of that confidence.",
        ),
        parts_table(suite, parts),
        *_race(suite, max(few // 8, 2), jobs, console),
    ]
    suite.verdict = _answer(over, against)
    _draw(suite, over)
    add_reliability(suite, found)
    rest = iter(points)
    for curve in CURVES:
        add_curve(suite, curve, [next(rest) for _ in curve.values])
    return suite


def _race(suite: Suite, seeds: int, jobs: int | None, console: Console | None) -> list[Table]:
    """Rows and a table of joint beside FilterPy's filter; none where FilterPy is not installed."""
    try:
        from .rival import DELAYS, race
    except ModuleNotFoundError:
        return []
    cases = [(delay, seed) for delay in DELAYS.values() for seed in range(seeds)]
    found = np.reshape(
        run_cases(race, cases, f"{NAME}: FilterPy", jobs, console), (-1, seeds, 3, 2)
    )
    cells = []
    for name, each in zip(DELAYS, found, strict=True):
        for i, label in enumerate(("joint", "FilterPy")):
            error = interval(each[:, i, 0], ratio_of_roots, each[:, 2, 0])
            us = Estimate(float(np.median(each[:, i, 1])))
            here = {
                "suite": NAME,
                "scenario": name,
                "salt": "fixed",
                "n": seeds,
                "estimator": label,
            }
            here["env_version"] = f"{CAMERA} {__version__}"
            numbers = {"rmse_over_bound": error, "us_per_tick": us}
            suite.rows += [Row.of(metric, number, **here) for metric, number in numbers.items()]
            cells.append([name, label, _cell(error), f"{us.value:.3g}"])
    head = ("camera", "filter", "over the bound", "CPU us a tick")
    text = (
        "The same eight states; FilterPy's takes a frame as it arrives. One core, in one process."
    )
    return [Table("Beside FilterPy's extended Kalman filter", head, cells, text)]


def _cell(ratio: Estimate | None) -> str:
    return ratio.inline() if ratio else ""


def _answer(over: Mapping[str, Mapping[str, Estimate]], against: Mapping[str, Estimate]) -> str:
    ours = [each["joint"].value for each in over.values()]
    theirs = [each["exact-kf"].value for each in over.values()]
    worst = max(over, key=lambda name: over[name]["joint"].value)
    four, one = (
        against[f"from the change on, {each}"].value for each in ("four members", "one filter")
    )
    return verdict(
        "A filter believes in the tyres of a data sheet; a real car's are up to 40 % off.",
        f"joint, which estimates them, has {min(ours):.2f} to {max(ours):.2f} times the least "
        f"error (worst: {worst}).",
        f"exact-kf, which believes in the data sheet, {min(theirs):.1f} to {max(theirs):.1f}.",
        f"Why: after a change of tyres a bank of four has {four / one:.2f} of one filter's error.",
        "Not covered: recorded cars, whose noise and forces are not known: `sideslip replay`.",
    )


def _draw(suite: Suite, over: Mapping[str, Mapping[str, Estimate]]) -> None:
    """One picture; nothing where plotly is not installed."""
    try:
        from ..report.figures import groups_with_interval
    except ModuleNotFoundError:
        return
    bars = groups_with_interval(
        {k: dict(v) for k, v in over.items()},
        "error / that of a filter that knows the tyres: less is better",
        {1.0: "knows the tyres"},
    )
    text = suite.verdict.splitlines()[1]
    suite.answers.append(("What does it cost not to know the tyres?", bars, text))
