"""The suite's tables and rows, one of each for a procedure."""

from typing import Any

import numpy as np

from ... import __version__
from ...agents.rollout import cost_ratios
from ...envs.vehicle.vehicle import GRAVITY
from ..harness.results import Row, Suite, Table
from ..harness.stats import geometric_mean, interval
from . import fmvss126, iso3888, iso4138, iso7401, outside
from .cases import NAME, Case, Done, Sine, Transient, of
from .contestants import CONTESTANTS

RIVAL = "lqr"
"""Against whom costs on outside plants are paired."""


def add(suite: Suite, done: Done) -> None:
    """Every table of what was found."""
    _sine(suite, of(done, "fmvss-126"))
    _tracks(suite, {track: of(done, track) for track in iso3888.TRACKS})
    _circle(suite, of(done, "iso-4138"))
    _step(suite, of(done, "iso-7401"))
    if episodes := of(done, "outside"):
        _episodes(suite, episodes)
    for found in of(done, "check").values():
        _check(suite, found)


def _row(case: Case, metric: str, value: float, of: str = "", **more: Any) -> Row:
    """of: what is measured, if a case has several."""
    who = CONTESTANTS[case.contestant]
    columns = {"estimator": who.on(case.car)[1], "controller": who.agent}
    columns["env_version"] = __version__
    where = f"{case.procedure} {case.car}" + (f", {of}" if of else "")
    return Row(NAME, where, metric, value, **columns | more)


def _who(case: Case) -> list[str]:
    return [CONTESTANTS[case.contestant].agent, case.car]


def _sine(suite: Suite, done: dict[Case, Sine]) -> None:
    """FMVSS 126: up to which amplitude every run passes, and what the first failure is."""
    cells = []
    for case, found in done.items():
        result = found.result
        suite.rows.append(_row(case, "amplitude", result.highest, n=len(result.runs)))
        failed = [run for run in result.runs if not run.passed]
        last = max(run.multiple for run in result.runs)
        verdict = f"fails at {failed[0].multiple:.3g} A: {_why(failed[0])}" if failed else "passes"
        amplitude, passed = f"{np.degrees(result.A):.1f}", f"{result.highest:.3g} of {last:.3g}"
        cells.append([*_who(case), amplitude, passed, verdict])
    note = "Both sides; the last amplitude is the larger of 6.5 A and 270 deg, at most 300 deg."
    header = ("controller", "car", "A / deg", "passes up to / A", "result")
    suite.tables.append(Table("FMVSS 126, sine with dwell", header, cells, note))


def _why(run: fmvss126.Run) -> str:
    if not run.ratio_2 < np.inf:
        return "spins"
    if not run.stable:
        shares = f"{100 * run.ratio_1:.0f} % and {100 * run.ratio_2:.0f} %"
        return f"{shares} of the peak yaw rate left (at most 35 % and 20 %)"
    return f"{run.sideways:.2f} m sideways (at least {fmvss126.SIDEWAYS} m)"


def _tracks(suite: Suite, done: dict[str, dict[Case, list[iso3888.Pass]]]) -> None:
    """ISO 3888: the highest clean speed of each contestant."""
    cells: dict[tuple[str, ...], list[str]] = {}
    for found in done.values():
        for case, runs in found.items():
            speed = iso3888.highest(runs)
            suite.rows.append(_row(case, "speed", speed, n=len(runs)))
            text = f"{3.6 * speed:.0f}" if speed else "none clean"
            cells.setdefault(tuple(_who(case)), []).append(text)
    header = ("controller", "car", *(f"{track} / (km/h)" for track in done))
    lines = [[*who, *texts] for who, texts in cells.items()]
    note = "The highest speed without a cone; any of five drivers may do it."
    suite.tables.append(Table("ISO 3888, lane change and obstacle avoidance", header, lines, note))


def _circle(suite: Suite, done: dict[Case, iso4138.Handling]) -> None:
    """ISO 4138: the understeer gradient against the linear model's."""
    cells = []
    for case, found in done.items():
        suite.rows.append(_row(case, "understeer_gradient", found.K))
        per_g = np.degrees(GRAVITY * np.array([found.K, found.theory]))
        cells.append([*_who(case), f"{per_g[0]:+.3f}", f"{per_g[1]:+.3f}"])
    header = ("controller", "car", "measured / (deg/g)", "linear model / (deg/g)")
    note = "At the front wheels, between 0.05 and 0.25 g; negative: the car oversteers."
    suite.tables.append(Table("ISO 4138, understeer gradient", header, cells, note))


def _step(suite: Suite, done: dict[Case, Transient]) -> None:
    """ISO 7401: the step's numbers beside the linear model's."""
    cells = []
    for case, found in done.items():
        for name in iso7401.OUTPUTS:
            one, other = found.step[name], found.linear_step[name]
            suite.rows.append(_row(case, "response_time", one.response_time, name))
            suite.rows.append(_row(case, "overshoot", one.overshoot, name))
            pairs = [(a, vars(other)[key]) for key, a in vars(one).items()]
            cells.append([*_who(case), name, *(f"{a:.3g} ({b:.3g})" for a, b in pairs)])
    header = ("output", "gain / (1/rad)", "90 % after / s", "peak after / s", "overshoot")
    note = "In brackets the linear model's under the same steering. No control."
    suite.tables.append(
        Table("ISO 7401, step response", ("controller", "car", *header), cells, note)
    )


def _episodes(suite: Suite, done: dict[Case, list[outside.Episode]]) -> None:
    """Outside plants: cost and spins of each contestant."""
    cells = []
    costs = {case: np.array([each.cost for each in found]) for case, found in done.items()}
    rivals = {case.car: costs[case] for case in done if _who(case)[0] == RIVAL}
    for case, found in done.items():
        cost, paired = interval(costs[case]), ""
        if case.car in rivals and _who(case)[0] != RIVAL:
            logs = np.log(cost_ratios(costs[case], rivals[case.car]))
            paired = geometric_mean(logs).inline(100.0, ".0f")
        spins = float(np.mean([each.failed for each in found]))
        more: dict[str, Any] = {"n": len(found), "salt": "fixed"}
        suite.rows.append(_row(case, "cost", cost.value, low=cost.low, high=cost.high, **more))
        suite.rows.append(_row(case, "share", spins, **more))
        peak = 1e3 * float(np.median([each.peak for each in found]))
        cells.append(
            [*_who(case), cost.inline(1.0, ".3g"), paired, f"{100 * spins:.0f}", f"{peak:.0f}"]
        )
    header = ("controller", "model", "cost", f"of {RIVAL}'s / %", "failed / %", "peak slip / mrad")
    note = (
        f"{len(found)} lane changes at 60 to 90 km/h; speed, steering, tyres and friction are "
        f"drawn by seed. of {RIVAL}'s: geometric mean, paired. peak slip: median."
    )
    suite.tables.append(Table("CommonRoad's models of a BMW 320i", header, cells, note))


def _check(suite: Suite, found: outside.Check) -> None:
    """The claim on the drift model."""
    verdict = "reproduced" if found.reproduced else "not reproduced"
    text = "no control fails at 5 A, a yaw moment of 500 N m passes at 6.5 A"
    case = Case("fmvss-126", f"outside {outside.MODEL}")
    cells = []
    for who, result in (("none", found.none), ("500 N m", found.law)):
        worst = max(result.runs, key=lambda run: run.ratio_1 if run.ratio_1 < np.inf else np.inf)
        ratios = (f"{100 * ratio:.0f}" for ratio in (worst.ratio_1, worst.ratio_2))
        sideways = f"{min(run.sideways for run in result.runs):.2f}"
        outcome = "passes" if result.passed else "fails"
        cells.append([who, f"{worst.multiple:.3g}", *ratios, sideways, outcome])
        more: dict[str, Any] = {"n": len(result.runs), "verdict": verdict, "paper": text}
        suite.rows.append(_row(case, "ratio", worst.ratio_1, controller=who, **more))
    header = ("control", "amplitude / A", "at 1.00 s / %", "at 1.75 s / %", "sideways / m", "")
    title = f"Sine with dwell on the drift model at 80 km/h: {text}: {verdict}"
    suite.tables.append(Table(title, header, cells, "Worst of both sides.", keyed=False))
