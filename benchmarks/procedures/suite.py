"""Question: do the cars pass the standard test procedures, and on equations that are not ours?"""

from importlib.util import find_spec

import numpy as np
from rich.console import Console

from ...envs.outside.plants import OUTSIDE_PLANTS
from ...envs.vehicle.parameters import GRAVITY
from ..harness.parallel import run_cases
from ..harness.results import Suite
from ..harness.verdict import format_verdict, summarise_names
from . import fmvss126, iso3888, iso4138, iso7401, outside, tables
from .drive import CARS, ENTRIES
from .tables import (
    NAME,
    CaseResult,
    CaseResults,
    ProcedureCase,
    SineDwellOutcome,
    Transient,
    select_cases,
)

SHOWN = 5.0  # of A: the sine with dwell in the figures
_QUICK_MULTIPLES = (1.5, 3.0, 5.0, 6.5)  # of A
EPISODES, QUICK_EPISODES = 20, 2
_STEP_AT = 0.2 * GRAVITY  # steady lateral acceleration of the step, in the linear range
_SWEEP_AT = 0.1 * GRAVITY  # of the sweep, where it is slow

_TEXT = (
    "Standard manoeuvres driven by the book. FMVSS 126: sine with dwell, amplitudes in units of A, "
    "the steering wheel angle at 0.3 g; A is the uncontrolled car's, so that all are steered alike "
    "(steering ratio 16). ISO 3888: lane change and obstacle avoidance by a driver model, with a "
    "check of the car's body against the cones. ISO 4138: understeer gradient of a circle driven "
    "slowly faster. ISO 7401: step and swept sine. The COMS is tested at 40 km/h, on tracks of "
    "half the length: it oversteers and is unstable above 63 km/h. The 0.3 g and the 1.83 m stay. "
    "The passenger car is tested at 80 km/h. References are limited by friction."
)
_OUTSIDE = (
    " Outside plants are CommonRoad's models of a BMW 320i, whose equations and tyres are not ours."
)
_NONE_OUTSIDE = " Outside plants are left out: pip install 'sideslip[outside]'."


def measure(case: ProcedureCase) -> CaseResult:
    """Drive a case.

    Args:
        case: Procedure, car and controller.

    Returns:
        Result of its procedure.
    """
    if case.procedure == "outside":
        return outside.run_episodes(case.car, ENTRIES[case.contestant], case.seeds)
    if case.procedure == "check":
        return outside.run_check()
    car, drive = CARS[case.car], ENTRIES[case.contestant].drive(case.car)
    if case.procedure == "fmvss-126":
        A = fmvss126.measure_reference_angle(ENTRIES[0].drive(case.car), car)
        result = fmvss126.run(drive, car, A, _QUICK_MULTIPLES if case.quick else None)
        return SineDwellOutcome(result, drive(fmvss126.make_sine_with_dwell(car, SHOWN * A)))
    if case.procedure in iso3888.TRACKS:
        shares = np.arange(0.5, 1.25, 0.15 if case.quick else 0.05)
        return iso3888.run(drive, car, case.procedure, (car.speed * shares).tolist())
    if case.procedure == "iso-4138":
        return iso4138.run(drive, car)
    return _measure_transient(case)


def _measure_transient(case: ProcedureCase) -> Transient:
    car, drive = CARS[case.car], ENTRIES[case.contestant].drive(case.car)
    gradient = iso4138.compute_understeer_gradient(car.vehicle)
    per = car.vehicle.wheelbase / car.speed**2 + gradient  # rad s2/m
    stepped = drive(iso7401.make_step(car, per * _STEP_AT))
    sweep = iso7401.run_sweep(drive, car, per * _SWEEP_AT)
    frequency = sweep[iso7401.OUTPUTS[0]].frequency
    step = iso7401.compute_responses(stepped)
    linear_step = iso7401.compute_linear_step(car.vehicle, car.speed, stepped)
    linear_sweep = iso7401.compute_linear_response(car.vehicle, car.speed, frequency)
    return Transient(step, linear_step, sweep, linear_sweep)


def _make_cases(quick: bool) -> list[ProcedureCase]:
    """Make the list of what is driven; outside plants only where their extra is installed."""
    indices = [k for k, entry in enumerate(ENTRIES) if not (quick and entry.slow)]
    driven = ("fmvss-126", *iso3888.TRACKS)
    cases = [ProcedureCase(p, car, k, (), quick) for p in driven for car in CARS for k in indices]
    cases += [ProcedureCase(p, car) for p in ("iso-4138", "iso-7401") for car in CARS]
    if find_spec("vehiclemodels") is None:
        return cases
    cases.append(ProcedureCase("check", outside.MODEL))
    seeds = tuple(range(QUICK_EPISODES if quick else EPISODES))
    known = [k for k in indices if ENTRIES[k].agent != "feedforward"]
    cases += [ProcedureCase("outside", model, k, seeds) for model in OUTSIDE_PLANTS for k in known]
    return cases


def make_verdict(done: CaseResults) -> str:
    """Make the verdict: on each car, who passes the sine with dwell, and how fast the lanes are.

    Args:
        done: Result of every case.

    Returns:
        Verdict.
    """
    passed, lanes = [], []
    for car in CARS:
        car_results = {case: result for case, result in done.items() if case.car == car}
        outcomes = select_cases(car_results, "fmvss-126")
        sines = {case.agent: outcome.result for case, outcome in outcomes.items()}
        passing = [name for name, item in sines.items() if item.passed]
        weakest = min(sines, key=lambda name: sines[name].highest)
        failing = f"; {weakest} fails above {sines[weakest].highest:.3g} A"
        failing *= weakest not in passing
        passed.append(f"{car}: {summarise_names(passing, 4)}{failing}.")
        runs = select_cases(car_results, next(iter(iso3888.TRACKS)))
        speeds = {c.agent: 3.6 * iso3888.find_highest_speed(item) for c, item in runs.items()}
        max_speed = max(speeds.values())
        fast = summarise_names([name for name, speed in speeds.items() if speed == max_speed])
        lanes.append(f"{car} {max_speed:.0f} with {fast} (none {speeds['none']:.0f})")
    return format_verdict(
        "FMVSS 126, no spin after a hard swerve of up to 6.5 A (A: the steering of 0.3 g), passes:",
        *passed,
        f"Fastest clean lane change, km/h: {'; '.join(lanes)}.",
        "Not covered: a real car; outside plants, on equations that are not ours, have a table.",
    )


def run(quick: bool = False, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Run every procedure for both cars and every controller, and the outside plants.

    Args:
        quick: Whether a few amplitudes, speeds and seeds do, and slow controllers are left out.
        jobs: Number of processes; None: one a core.
        console: Console for the progress.

    Returns:
        The suite.
    """
    cases = _make_cases(quick)
    done = dict(zip(cases, run_cases(measure, cases, NAME, jobs, console), strict=True))
    has_outside = any(case.procedure == "outside" for case in cases)
    text = _TEXT + (_OUTSIDE if has_outside else _NONE_OUTSIDE)
    suite = Suite(NAME, "Standard test procedures", text)
    tables.add(suite, done)
    suite.verdict = make_verdict(done)
    try:
        from . import figures as draw
    except ModuleNotFoundError:
        return suite
    draw.add(suite, done)
    return suite
