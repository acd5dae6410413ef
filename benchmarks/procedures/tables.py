"""The suite's cases and their results, its tables and rows, one of each for a procedure."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...agents.rollout import compute_cost_ratios
from ...envs.vehicle.parameters import GRAVITY
from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate, geometric_mean, interval
from ..report.study import add_rows
from . import fmvss126, iso3888, iso4138, iso7401, outside
from .drive import ENTRIES, Series

NAME = "procedures"


@dataclass(frozen=True)
class ProcedureCase:
    """A case: a procedure, a car or outside model, a controller's index in `ENTRIES`, seeds."""

    procedure: str
    car: str
    contestant: int = 0
    seeds: tuple[int, ...] = ()
    quick: bool = False

    @property
    def agent(self) -> str:
        """The controller."""
        return ENTRIES[self.contestant].agent


@dataclass(frozen=True)
class SineDwellOutcome:
    """FMVSS 126 of a controller, and one of its runs to look at."""

    result: fmvss126.SineDwellResult
    shown: Series


@dataclass(frozen=True)
class Transient:
    """ISO 7401 of a car: by output, measured and of the linear model."""

    step: dict[str, iso7401.StepResponse]
    linear_step: dict[str, iso7401.StepResponse]
    sweep: dict[str, iso7401.FrequencyResponse]
    linear_sweep: dict[str, Any]


CaseResult = Any
"""What a procedure gives: a result of its own module."""
CaseResults = dict[ProcedureCase, CaseResult]
"""The result of every case."""


def select_cases(done: CaseResults, procedure: str) -> CaseResults:
    """Select the cases of one procedure.

    Args:
        done: Result of every case.
        procedure: Name of the procedure.

    Returns:
        Result of each of its cases.
    """
    return {case: result for case, result in done.items() if case.procedure == procedure}


RIVAL = "lqr"
"""Against whom costs on outside plants are paired."""


def add(suite: Suite, done: CaseResults) -> None:
    """Add every table of the results to a suite.

    Args:
        suite: Suite that gets the tables.
        done: Result of every case.
    """
    _add_sine(suite, select_cases(done, "fmvss-126"))
    _add_tracks(suite, {track: select_cases(done, track) for track in iso3888.TRACKS})
    _add_circle(suite, select_cases(done, "iso-4138"))
    _add_step(suite, select_cases(done, "iso-7401"))
    if episodes := select_cases(done, "outside"):
        _add_episodes(suite, episodes)
    for check_result in select_cases(done, "check").values():
        _add_check(suite, check_result)


def _add_rows(
    suite: Suite,
    case: ProcedureCase,
    numbers: Mapping[str, Estimate | float],
    output: str = "",
    **more: str | int,
) -> None:
    """Add rows of a case; output: what is measured, if a case has several."""
    entry = ENTRIES[case.contestant]
    columns: dict[str, Any] = {"estimator": entry.get_configuration(case.car)[1]}
    columns |= {"controller": entry.agent, "salt": ""} | more
    columns["scenario"] = f"{case.procedure} {case.car}" + (f", {output}" if output else "")
    estimates = {x: Estimate(y) if isinstance(y, float) else y for x, y in numbers.items()}
    add_rows(suite, estimates, **columns)


def _add_sine(suite: Suite, done: dict[ProcedureCase, SineDwellOutcome]) -> None:
    """Add FMVSS 126: up to which amplitude every run passes, and what the first failure is."""
    cells = []
    for case, sine in done.items():
        result = sine.result
        _add_rows(suite, case, {"amplitude": result.highest}, n=len(result.runs))
        failed = [run for run in result.runs if not run.passed]
        last = max(run.multiple for run in result.runs)
        verdict = "passes"
        if failed:
            verdict = f"fails at {failed[0].multiple:.3g} A: {_describe_failure(failed[0])}"
        amplitude, passed = f"{np.degrees(result.A):.1f}", f"{result.highest:.3g} of {last:.3g}"
        cells.append([case.agent, case.car, amplitude, passed, verdict])
    note = "Both sides; the last amplitude is the larger of 6.5 A and 270 deg, at most 300 deg."
    header = ("controller", "car", "A / deg", "passes up to / A", "result")
    suite.tables.append(ResultTable("FMVSS 126, sine with dwell", header, cells, note))


def _describe_failure(run: fmvss126.SineDwellRun) -> str:
    if not run.ratio_2 < np.inf:
        return "spins"
    if not run.stable:
        shares = f"{100 * run.ratio_1:.0f} % and {100 * run.ratio_2:.0f} %"
        return f"{shares} of the peak yaw rate left (at most 35 % and 20 %)"
    return f"{run.sideways:.2f} m sideways (at least {fmvss126.SIDEWAYS} m)"


def _add_tracks(suite: Suite, done: dict[str, dict[ProcedureCase, list[iso3888.TrackRun]]]) -> None:
    """Add ISO 3888: the highest clean speed of each controller."""
    cells: dict[tuple[str, ...], list[str]] = {}
    for track_results in done.values():
        for case, runs in track_results.items():
            speed = iso3888.find_highest_speed(runs)
            _add_rows(suite, case, {"speed": speed}, n=len(runs))
            text = f"{3.6 * speed:.0f}" if speed else "none clean"
            cells.setdefault((case.agent, case.car), []).append(text)
    header = ("controller", "car", *(f"{track} / (km/h)" for track in done))
    lines = [[*labels, *texts] for labels, texts in cells.items()]
    note = "The highest speed without a cone; any of five drivers may do it."
    title = "ISO 3888, lane change and obstacle avoidance"
    suite.tables.append(ResultTable(title, header, lines, note))


def _add_circle(suite: Suite, done: dict[ProcedureCase, iso4138.Handling]) -> None:
    """Add ISO 4138: the understeer gradient against the linear model's."""
    cells = []
    for case, handling in done.items():
        _add_rows(suite, case, {"understeer_gradient": handling.K})
        per_g = np.degrees(GRAVITY * np.array([handling.K, handling.theory]))
        cells.append([case.agent, case.car, f"{per_g[0]:+.3f}", f"{per_g[1]:+.3f}"])
    header = ("controller", "car", "measured / (deg/g)", "linear model / (deg/g)")
    note = "At the front wheels, between 0.05 and 0.25 g; negative: the car oversteers."
    suite.tables.append(ResultTable("ISO 4138, understeer gradient", header, cells, note))


def _add_step(suite: Suite, done: dict[ProcedureCase, Transient]) -> None:
    """Add ISO 7401: the step's numbers beside the linear model's."""
    cells = []
    for case, transient in done.items():
        for name in iso7401.OUTPUTS:
            one, other = transient.step[name], transient.linear_step[name]
            numbers = {"response_time": one.response_time, "overshoot": one.overshoot}
            _add_rows(suite, case, numbers, name)
            pairs = [(a, vars(other)[key]) for key, a in vars(one).items()]
            cells.append([case.agent, case.car, name, *(f"{a:.3g} ({b:.3g})" for a, b in pairs)])
    header = ("output", "gain / (1/rad)", "90 % after / s", "peak after / s", "overshoot")
    note = "In brackets the linear model's under the same steering. No control."
    suite.tables.append(
        ResultTable("ISO 7401, step response", ("controller", "car", *header), cells, note)
    )


def _add_episodes(suite: Suite, done: dict[ProcedureCase, list[outside.OutsideEpisode]]) -> None:
    """Add outside plants: cost and spins of each controller."""
    cells = []
    costs = {case: np.array([x.cost for x in episodes]) for case, episodes in done.items()}
    rivals = {case.car: costs[case] for case in done if case.agent == RIVAL}
    for case, episodes in done.items():
        cost, paired = interval(costs[case]), ""
        if case.car in rivals and case.agent != RIVAL:
            logs = np.log(compute_cost_ratios(costs[case], rivals[case.car]))
            paired = geometric_mean(logs).inline(100.0, ".0f")
        spins = float(np.mean([episode.failed for episode in episodes]))
        _add_rows(suite, case, {"cost": cost, "share": spins}, n=len(episodes), salt="fixed")
        peak = 1e3 * float(np.median([episode.peak for episode in episodes]))
        texts = cost.inline(1.0, ".3g"), paired, f"{100 * spins:.0f}", f"{peak:.0f}"
        cells.append([case.agent, case.car, *texts])
    header = ("controller", "model", "cost", f"of {RIVAL}'s / %", "failed / %", "peak slip / mrad")
    note = (
        f"{len(episodes)} lane changes at 60 to 90 km/h; speed, steering, tyres and friction are "
        f"drawn by seed. of {RIVAL}'s: geometric mean, paired. peak slip: median."
    )
    suite.tables.append(ResultTable("CommonRoad's models of a BMW 320i", header, cells, note))


def _add_check(suite: Suite, check_result: outside.OutsideCheck) -> None:
    """Add the claim on the drift model."""
    verdict = "reproduced" if check_result.reproduced else "not reproduced"
    text = "no control fails at 5 A, a yaw moment of 500 N m passes at 6.5 A"
    case = ProcedureCase("fmvss-126", f"outside {outside.MODEL}")
    cells = []
    for control, result in (("none", check_result.none), ("500 N m", check_result.law)):
        worst = max(result.runs, key=lambda run: run.ratio_1 if run.ratio_1 < np.inf else np.inf)
        ratios = (f"{100 * ratio:.0f}" for ratio in (worst.ratio_1, worst.ratio_2))
        sideways = f"{min(run.sideways for run in result.runs):.2f}"
        outcome = "passes" if result.passed else "fails"
        cells.append([control, f"{worst.multiple:.3g}", *ratios, sideways, outcome])
        columns = {"controller": control, "verdict": verdict, "paper": text}
        _add_rows(suite, case, {"ratio": worst.ratio_1}, n=len(result.runs), **columns)
    header = ("control", "amplitude / A", "at 1.00 s / %", "at 1.75 s / %", "sideways / m", "")
    title = f"Sine with dwell on the drift model at 80 km/h: {text}: {verdict}"
    suite.tables.append(ResultTable(title, header, cells, "Worst of both sides.", keyed=False))
