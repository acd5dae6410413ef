"""Question: do the cars pass the standard test procedures, and on equations that are not ours?"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from itertools import product
from types import ModuleType
from typing import Any

import numpy as np

from ...agents.rollout import compute_cost_ratios
from ...envs.outside.plants import OUTSIDE_PLANTS
from ...envs.vehicle.parameters import GRAVITY
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import Estimate, geometric_mean, interval
from ..report.study import Request, Study, format_verdict, summarise_names
from . import fmvss126, iso, outside
from .drive import CARS, ENTRIES, CaseResults, ProcedureCase

NAME = "procedures"
RIVAL = "lqr"  # against whom costs on outside plants are paired
_QUICK_MULTIPLES = (1.5, 3.0, 5.0, 6.5)  # of A
EPISODES, QUICK_EPISODES, OUTSIDE_EPISODES = 16, 2, 8

_HAS_OUTSIDE = find_spec("vehiclemodels") is not None
_TEXT = (
    "Standard manoeuvres driven by the book. FMVSS 126: sine with dwell, amplitudes in units of A, "
    "the steering wheel angle at 0.3 g; A is the uncontrolled car's, so that all are steered alike "
    "(steering ratio 16). ISO 3888: lane change and obstacle avoidance by a driver model, with a "
    "check of the car's body against the cones. ISO 4138: understeer gradient of a circle driven "
    "slowly faster. ISO 7401: step and swept sine. The COMS is tested at 40 km/h, on tracks of "
    "half the length: it oversteers and is unstable above 63 km/h. The 0.3 g and the 1.83 m stay. "
    "The passenger car is tested at 80 km/h. References are limited by friction. Outside plants "
) + (
    "are CommonRoad's models of a BMW 320i, whose equations and tyres are not ours."
    if _HAS_OUTSIDE
    else "are left out: pip install 'sideslip[outside]'."
)


def _measure_case(case: ProcedureCase) -> Any:
    if case.procedure == "outside":
        return outside.run_episodes(case.car, ENTRIES[case.agent], case.seeds)
    if case.procedure == "check":
        return outside.run_check()
    car, entry = CARS[case.car], ENTRIES[case.agent]
    if case.procedure == "fmvss-126":
        multiples, results = _QUICK_MULTIPLES if case.quick else None, []
        for seed in case.seeds:
            A = fmvss126.measure_reference_angle(ENTRIES["none"].drive(case.car, seed), car)
            results.append(fmvss126.run(entry.drive(case.car, seed), car, A, multiples))
        return results
    drive = entry.drive(case.car, 0 if case.procedure in iso.TRACKS else None)
    if case.procedure in iso.TRACKS:
        shares = np.arange(0.5, 1.25, 0.15 if case.quick else 0.05)
        speeds = (car.speed * shares).tolist()
        return [iso.run_track(drive, car, case.procedure, speed) for speed in speeds]
    return (iso.run_circle if case.procedure == "iso-4138" else iso.run_transient)(drive, car)


def _make_cases(quick: bool) -> list[ProcedureCase]:
    """Make the list of what is driven; outside plants only where their extra is installed."""
    agents = [name for name, entry in ENTRIES.items() if not (quick and entry.slow)]
    seeds = tuple(range(QUICK_EPISODES if quick else EPISODES))
    driven = (("fmvss-126", seeds), *((track, ()) for track in iso.TRACKS))
    triples = product(driven, CARS, agents)
    cases = [ProcedureCase(name, car, agent, x, quick) for (name, x), car, agent in triples]
    cases += [ProcedureCase(p, car) for p in ("iso-4138", "iso-7401") for car in CARS]
    if not _HAS_OUTSIDE:
        return cases
    cases.append(ProcedureCase("check", outside.MODEL))
    pairs = product(OUTSIDE_PLANTS, agents)
    return cases + [ProcedureCase("outside", *pair, seeds[:OUTSIDE_EPISODES]) for pair in pairs]


def _select_results(done: CaseResults, procedure: str, car: str) -> dict[str, Any]:
    """Select the results of a procedure with a car by controller."""
    where = procedure, car
    return {x.agent: result for x, result in done.items() if (x.procedure, x.car) == where}


def _make_verdict(done: CaseResults) -> str:
    """Make the verdict: on each car, who passes the sine with dwell, and how fast the lanes are."""
    passed, lanes = [], []
    for car in CARS:
        sines = _select_results(done, "fmvss-126", car)
        passing = [name for name, items in sines.items() if all(x.passed for x in items)]
        medians = {name: np.median([x.highest for x in items]) for name, items in sines.items()}
        weakest = min(medians, key=lambda name: float(medians[name]))
        failing = f"; {weakest} fails above {medians[weakest]:.3g} A in half of the cars"
        failing *= weakest not in passing
        passed.append(f"{car}: {summarise_names(passing, 4)}{failing}.")
        runs = _select_results(done, iso.TRACKS[0], car)
        speeds = {name: 3.6 * _find_highest_speed(items) for name, items in runs.items()}
        max_speed = max(speeds.values())
        fast = summarise_names([name for name, speed in speeds.items() if speed == max_speed])
        lanes.append(f"{car} {max_speed:.0f} with {fast} (none {speeds['none']:.0f})")
    return format_verdict(
        "FMVSS 126, no spin after a hard swerve of up to 6.5 A (A: the steering of 0.3 g), passes:",
        *passed,
        f"Fastest clean lane change, km/h: {'; '.join(lanes)}.",
        "Not covered: a real car; outside plants, on equations that are not ours, have a table.",
    )


def _find_highest_speed(runs: Sequence[iso.TrackRun]) -> float:
    """Find the highest speed (m/s) of a clean run; 0 where there is none."""
    return max((run.speed for run in runs if run.passed), default=0.0)


def _measure(request: Request) -> CaseResults:
    cases = _make_cases(request.quick)
    return dict(zip(cases, request.run_cases(_measure_case, cases, NAME), strict=True))


def _make_record(case: ProcedureCase, **more: object) -> dict[str, object]:
    """Make a line of a table, and the columns of its rows; output: if a case measures several."""
    estimator = ENTRIES[case.agent].get_configuration(case.car)[1]
    scenario = f"{case.procedure} {case.car}" + (f", {x}" if (x := more.get("output")) else "")
    names = {"controller": case.agent, "car": case.car, "estimator": estimator}
    return {"scenario": scenario, "salt": "", **names, **more}


def _add_tables(suite: Suite, done: CaseResults) -> None:
    for name, (make_records, table) in _TABLES.items():
        records = make_records({x: y for x, y in done.items() if x.procedure == name})
        if records:
            suite.add_rows(records)
            title, note = (text.format(**records[0]) for text in (table.title, table.note))
            suite.tables.append(replace(table, title=title, cells=records, note=note))
        if name == "fmvss-126":
            _add_tracks(suite, done)


def _make_sine_records(done: CaseResults) -> list[dict[str, object]]:
    """FMVSS 126: up to which amplitude every run passes, and what the weakest car's failure is."""
    from scipy.special import bdtrik  # which a command's help need not load

    records = []
    for case, results in done.items():
        highest = np.array([result.highest for result in results])
        weakest = results[int(np.argmin(highest))]
        failed = [run for run in weakest.runs if not run.passed]
        beyond = math.ceil(bdtrik(0.025, len(results), 0.5))  # cars; no jackknife holds here
        bounds = np.sort(highest)[[beyond - 1, -beyond]] if beyond else ()
        numbers = {"amplitude": Estimate(float(np.median(highest)), *bounds), "n": len(results)}
        numbers |= {"A": np.degrees(np.median([result.A for result in results]))}
        last = np.array([max(run.multiple for run in result.runs) for result in results])
        ends = float(np.median(highest)), float(np.median(last)), int(np.sum(highest < last))
        text = "passes"
        if failed:
            text = f"fails at {failed[0].multiple:.3g} A: {_describe_failure(failed[0])}"
        records.append(_make_record(case, **numbers, passed=ends, text=text))
    return records


def _describe_failure(run: fmvss126.SineDwellRun) -> str:
    if not run.ratio_2 < np.inf:
        return "spins"
    if not run.stable:
        shares = f"{100 * run.ratio_1:.0f} % and {100 * run.ratio_2:.0f} %"
        return f"{shares} of the peak yaw rate left (at most 35 % and 20 %)"
    return f"{run.sideways:.2f} m sideways (at least {fmvss126.SIDEWAYS} m)"


def _add_tracks(suite: Suite, done: CaseResults) -> None:
    lines: dict[tuple[str, str], dict[str, object]] = {}
    for case, runs in done.items():
        if case.procedure in iso.TRACKS:
            speed = _find_highest_speed(runs)
            suite.add_rows([_make_record(case, speed=speed, n=len(runs))])
            line = lines.setdefault((case.agent, case.car), _make_record(case))
            line[case.procedure] = 3.6 * speed if speed else "none clean"
    speeds = (Column(track, f"{track} / (km/h)", form=".0f") for track in iso.TRACKS)
    note = "The highest speed without a cone; any of five drivers may do it."
    title = "ISO 3888, lane change and obstacle avoidance"
    suite.tables.append(ResultTable(title, (*_KEYS, *speeds), list(lines.values()), note))


def _make_circle_records(done: CaseResults) -> list[dict[str, object]]:
    return [
        _make_record(case, understeer_gradient=K, theory=CARS[case.car].understeer_gradient)
        for case, K in done.items()
    ]


def _make_step_records(done: CaseResults) -> list[dict[str, object]]:
    records = []
    for case, responses in done.items():
        for name, transient in responses.items():
            one, other = vars(transient.step), vars(transient.linear_step)
            pairs = {f"both {key}": (number, other[key]) for key, number in one.items()}
            numbers = {key: one[key] for key in ("response_time", "overshoot")}
            records.append(_make_record(case, output=name, **numbers, **pairs))
    return records


def _make_outside_records(done: CaseResults) -> list[dict[str, object]]:
    records = []
    rivals = {case.car: episodes[:, 0] for case, episodes in done.items() if case.agent == RIVAL}
    for case, episodes in done.items():
        cost, failed, peak = episodes.T
        numbers = {"cost": interval(cost), "share": failed.mean(), "peak": np.median(peak)}
        if case.car in rivals and case.agent != RIVAL:
            numbers["ratio"] = geometric_mean(np.log(compute_cost_ratios(cost, rivals[case.car])))
        numbers |= {"n": len(episodes)}
        records.append(_make_record(case, **numbers, salt="fixed"))
    return records


def _make_check_records(done: CaseResults) -> list[dict[str, object]]:
    case, records = ProcedureCase("fmvss-126", f"outside {outside.MODEL}"), []
    for none, law in done.values():  # of the only check
        is_reproduced = law.passed and not any(run.passed for run in none.runs)
        claim = {"verdict": "reproduced" if is_reproduced else "not reproduced", "paper": _CLAIM}
        for control, result in (("none", none), ("500 N m", law)):
            ratios = [run.ratio_1 if run.ratio_1 < np.inf else np.inf for run in result.runs]
            worst = result.runs[int(np.argmax(ratios))]
            numbers = {"multiple": worst.multiple, "ratio": worst.ratio_1, "later": worst.ratio_2}
            numbers["sideways"] = min(run.sideways for run in result.runs)
            text = "passes" if result.passed else "fails"
            more = {"n": len(result.runs), "controller": control, "text": text}
            records.append(_make_record(case, **numbers, **claim) | more)
    return records


_KEYS, _PAIR = ("controller", "car"), "{:.3g} ({:.3g})"
_PER_G = float(np.degrees(GRAVITY))
_CLAIM = "no control fails at 5 A, a yaw moment of 500 N m passes at 6.5 A"
_OF = Column("passed", "median car passes up to / A", form="{:.3g} of {:.3g}; {:.0f} fail")
_CIRCLE = {"understeer_gradient": "measured / (deg/g)", "theory": "linear model / (deg/g)"}
_STEP = {"gain": "gain / (1/rad)", "response_time": "90 % after / s",
         "peak_time": "peak after / s", "overshoot": "overshoot"}  # fmt: skip
_SHARES = {"ratio": "at 1.00 s / %", "later": "at 1.75 s / %"}
# by procedure: its lines, and its table without them, whose title and note may name what the first
# line has
_TABLES: dict[str, tuple[Callable[[CaseResults], list[dict[str, object]]], ResultTable]] = {
    "fmvss-126": (_make_sine_records, ResultTable(
        "FMVSS 126, sine with dwell",
        (*_KEYS, Column("A", "A / deg", form=".1f"), _OF, Column("text", "weakest car")), [],
        "{n} cars of world v1, both sides; the last amplitude is the larger of 6.5 A and 270 deg, "
        "at most 300 deg. The filter starts with the run.",
    )),
    "iso-4138": (_make_circle_records, ResultTable(
        "ISO 4138, understeer gradient",
        (*_KEYS, *(Column(key, text, _PER_G, "+.3f") for key, text in _CIRCLE.items())), [],
        "At the front wheels, between 0.05 and 0.25 g; negative: the car oversteers.",
    )),
    "iso-7401": (_make_step_records, ResultTable(
        "ISO 7401, step response",
        (*_KEYS, "output",
            *(Column(f"both {key}", text, form=_PAIR) for key, text in _STEP.items())), [],
        "In brackets the linear model's under the same steering. No control.",
    )),
    "outside": (_make_outside_records, ResultTable(
        "CommonRoad's models of a BMW 320i",
        ("controller", Column("car", "model"), Column("cost", form=".3g"),
            Column("ratio", f"of {RIVAL}'s / %", 100.0, ".0f"),
            Column("share", "failed / %", 100.0, ".0f"),
            Column("peak", "peak slip / mrad", 1e3, ".0f")), [],
        "{n} lane changes at 60 to 90 km/h; speed, steering, tyres and friction are drawn by seed. "
        f"of {RIVAL}'s: geometric mean, paired. peak slip: median.",
    )),
    "check": (_make_check_records, ResultTable(
        f"Sine with dwell on the drift model at 80 km/h: {_CLAIM}: {{verdict}}",
        (Column("controller", "control"), Column("multiple", "amplitude / A", form=".3g"),
            *(Column(key, text, 100.0, ".0f") for key, text in _SHARES.items()),
            Column("sideways", "sideways / m", form=".2f"), Column("text", " ")), [],
        "Worst of both sides.", keyed=False,
    )),
}  # fmt: skip


def _add_figures(suite: Suite, done: CaseResults, draw: ModuleType) -> None:
    """Draw tracks with their cones, and frequency responses beside the linear model's."""
    for car in CARS:
        responses = _select_results(done, "iso-7401", car)["none"]
        for name, unit in zip(iso.OUTPUTS, ("yaw rate / (1/s)", "a_y / (m/s2/rad)"), strict=True):
            sweep, linear = responses[name].sweep, responses[name].linear_sweep
            lines = {"measured": np.abs(sweep.H), "linear model": np.abs(linear)}
            figure = draw.draw_curves(sweep.frequency, lines, "frequency / Hz", unit)
            title = f"ISO 7401, {car}: response to steering, {unit}"
            suite.figures.append((title, figure, "Measured by a swept sine, no control."))
    for track, car in product(iso.TRACKS, CARS):
        runs = dict[str, iso.TrackRun]()
        for agent, result in _select_results(done, track, car).items():
            clean = (run for run in result if run.passed)
            runs[agent] = max(clean, key=lambda run: run.speed, default=result[0])
        speeds = ", ".join(f"{agent} {3.6 * run.speed:.0f} km/h" for agent, run in runs.items())
        text = f"The fastest clean run, or the slowest where none is clean: {speeds}."
        suite.figures.append((f"{track}, {car}: way and cones", _draw_cones(runs, draw), text))


def _draw_cones(runs: Mapping[str, iso.TrackRun], draw: ModuleType) -> Any:
    """Draw the paths of the centre of gravity, from where the first lane begins, and the cones."""
    paths = {x: (y.series.X - y.speed * iso.ONSET, y.series.Y) for x, y in runs.items()}
    figure, run = draw.draw_track(paths), list(runs.values())[-1]
    places = [
        (x - run.speed * iso.ONSET, lane.offset + side * 0.5 * lane.width)
        for lane in run.lanes
        for x in np.linspace(lane.start, lane.start + lane.length, 5)
        for side in (-1.0, 1.0)
    ]
    x, y = np.array(places).T
    marker = {"color": "#D55E00", "symbol": "triangle-up", "size": 7}
    figure.add_scatter(x=x, y=y, mode="markers", marker=marker, name="cones")
    figure.update_xaxes(range=[float(x.min()) - iso.RUN_OUT, float(x.max()) + iso.RUN_OUT])
    return figure


STUDY = Study(
    NAME, "Standard test procedures", _TEXT, (EPISODES, QUICK_EPISODES),
    _measure, _add_tables, _make_verdict, _add_figures,
)  # fmt: skip
