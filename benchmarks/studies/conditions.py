"""The suite `conditions`: a filter without options in conditions that no level of it was found in.

A condition is a scenario, and an error in the record, in world v1 and alone in an ideal world.
The seed draws car, tyres and steering, in world v1 also what errs in every car.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from scipy.signal import lfilter

from ...agents.baselines import CONSTANT_ERRORS, compute_range_rms
from ...envs.record import FAST, PACKET, Log
from ...envs.scenarios.world import IDEAL
from ...envs.sensors.slow import SLOW_NAMES
from ...estimators.design.options import COURSE_SPEED, NOISE
from ...estimators.make import make_estimator
from ...estimators.protocol import Estimates
from ...estimators.wrappers.truth import calibrate
from ..harness.drives import SETTLED, draw_steering, make_unchecked_filter, record_drive
from ..harness.results import HONESTY, Column, ResultTable, Suite
from ..harness.stats import compute_honesty, interval, mean_share, ratio_of_roots, root_mean
from ..report.study import Request, Study, format_verdict, summarise_names

NAME, GYRO_ALONE = "joint", "bicycle-kf"
BASE, BAD_INPUT = "base world v1", "steering in degrees"
IDEAL_SUFFIX = ", ideal world"  # ends the name of a condition in which nothing else errs
_BASE_FACTOR = 4  # seeds of the base world over those of another condition
_FIRST_SEED = 200_000  # no drive of `tuning`
_WATCH = 0.1  # s between two looks at `is_healthy`
_SPIN = 0.2  # rad of sideslip beyond which a car is lost, and errors do not count
_SLOW = 1.0  # m/s; a car that stands has no sideslip angle
_LOST, _MAX_SILENCE = 4.0, 3.0  # NEES of a filter that is lost, and s until it should say so


@dataclass(frozen=True)
class Edit:
    """An error of fast columns from a time on, or of the values under a slow sensor's stamps."""

    columns: tuple[str, ...] = ()  # names in `Fast`
    scale: float = 1.0  # factor
    offset: float = 0.0  # in the column's unit
    drift: float = 0.0  # of the offset, per s
    accel_x: float = 0.0  # fraction of the longitudinal acceleration that is added
    delay: float = 0.0  # s
    noise: float = 0.0  # standard deviation of added noise
    corner: float = np.inf  # Hz of that noise's low pass
    start: float = 0.0  # s
    sensor: str = ""  # slow sensor
    packets: int = 0  # how many packets earlier its values were true


def _apply_edit(edit: Edit, log: Log, seed: int) -> Log:
    """Apply an error to a copy of a log; the seed is that of its noise."""
    record, rng = log.record, np.random.default_rng([47, seed])
    fast, packets, late = record.fast.copy(), record.packets.copy(), edit.delay / record.dt
    pole = np.exp(-2.0 * np.pi * edit.corner * record.dt)
    for column in (getattr(FAST, name) for name in edit.columns):
        white = edit.noise * np.sqrt(1.0 - pole**2) * rng.standard_normal(len(fast))
        x = edit.scale * fast[:, column] + edit.offset + edit.drift * log.time
        x += edit.accel_x * fast[:, FAST.accel_x] + lfilter([1.0], [1.0, -pole], white)
        rows = np.arange(round(edit.start / record.dt), len(fast))
        fast[rows, column] = x[np.maximum(rows - round(late), 0)]
    if edit.sensor:
        places = np.flatnonzero(packets[:, PACKET.sensor] == SLOW_NAMES.index(edit.sensor))
        values = record.packets[places[: -edit.packets], PACKET.value :]
        packets[places[edit.packets :], PACKET.value :] = values
    return replace(log, record=replace(record, fast=fast, packets=packets))


_GPS, _CAMERA, _BOTH = (f"sideslip/Yaw{name}-v1" for name in ("Gps", "Vision", "Fusion"))
_DEGREE = np.pi / 180.0


@dataclass(frozen=True)
class Condition:
    """A kind of drive of the passenger car."""

    name: str  # name in the tables
    env_id: str = _GPS  # id of the env
    scenario: Mapping[str, Any] = field(default_factory=dict)  # fields over `_DRIVE`
    edit: Edit = Edit()  # error in the record
    fault: float = 0.0  # s at which it begins; inf where there is none
    amplitude: float = 0.05  # of steering (rad), at 16 m/s and below
    speed: tuple[float, float] = (14.0, 26.0)  # m/s
    duration: float = 20.0  # s


_DRIVE = {
    "base": "random-steering", "steering": "trace", "trace_step": 0.01, "onset": 0.0,
    "front_stiffness": (0.6, 1.4), "rear_stiffness": (0.6, 1.4), "friction": (0.8, 1.0),
    "hdop_law": "half", "half_width": 1e4, "disturbance_force": 200.0, "disturbance_moment": 350.0,
}  # fmt: skip
_LANE = {"road": "nominal-path", "camera_heading": 0.5, "camera_offset": 4.0}
_SLIDE = {"friction": 0.5, "initial_beta": 0.14, "initial_gamma": 0.3}
_LOADED = {"mass": 1875.0, "yaw_inertia": 2800.0, "sprung_mass": 1675.0}
_TAIL_HEAVY = {"front_arm": 1.4, "rear_arm": 1.3}
_RAMP = {"bank": 0.07, "curve_start": 60.0, "curve_ramp": 20.0}
_GUST = {"wind_force": (1500.0, 2500.0), "wind_arm": 0.3, "wind_start": 7.0, "wind_length": 3.0}
_STOP = {"speed_change": -5.2, "change_start": 5.0, "change_length": 4.0}
_STAND = _STOP | {"speed_change": -6.5}
_DRIFT = Edit(("gyro",), drift=_DEGREE / 600.0)
_IN_V1 = (
    Condition(BASE, _BOTH, _LANE, fault=np.inf),
    Condition("GPS", fault=np.inf),
    Condition("camera", _CAMERA, _LANE, fault=np.inf),
    Condition("rear tyres x 0.6", _GPS, {"tyre_change_time": 8.0, "rear_change": 0.6}, fault=8.0),
    Condition("front tyres x 0.6", _GPS, {"tyre_change_time": 8.0, "front_change": 0.6}, fault=8.0),
    Condition("friction 0.35, hard steering", _GPS, {"friction": 0.35}, amplitude=0.07),
    Condition("starts sliding by 8 deg", _GPS, _SLIDE),
    Condition("camera's stamps 0.1 s late", _CAMERA, _LANE, Edit(sensor="camera", packets=3)),
    Condition("GPS's stamps 0.2 s late", edit=Edit(sensor="gps", packets=1)),
    Condition("no GPS for 10 s", _GPS, {"gps_outage": (6.0, 16.0)}, fault=6.0),
    Condition("bank of 4 deg", _GPS, {"bank": 0.07, "curve_start": -1.0}),
    Condition("bank of 4 deg from 60 m on", _GPS, _RAMP, fault=2.3),
    Condition("gust of 1.5 to 2.5 kN", _GPS, _GUST, fault=7.0),
    Condition("gyro drifts to 0.1 deg/s", edit=_DRIFT, duration=60.0),
    Condition("gyro drifts to 1 deg/s", edit=Edit(("gyro",), drift=_DEGREE / 20.0)),
    Condition("gyro's scale + 2 %", edit=Edit(("gyro",), scale=1.02)),
    Condition("accelerometer askew by 2 deg", edit=Edit(("accel_y",), offset=0.34, accel_x=0.035)),
    Condition("mass + 25 %", _GPS, {"vehicle": _LOADED}),
    Condition("centre of gravity 0.2 m back", _GPS, {"vehicle": _TAIL_HEAVY}),
    Condition("steering's scale + 5 %", edit=Edit(("steer",), scale=1.05)),
    Condition("steering's offset 0.5 deg", edit=Edit(("steer",), offset=0.5 * _DEGREE)),
    Condition("wheel speed + 3 %", edit=Edit(("wheel_left", "wheel_right"), scale=1.03)),
    Condition("stop and go", _GPS, _STOP, fault=5.0, amplitude=0.15, speed=(6.0, 9.0)),
    Condition("stops and stands", _GPS, _STAND, fault=5.0, amplitude=0.1, speed=(6.5, 6.5)),
    Condition("gyro's noise x 1.9", edit=Edit(("gyro",), noise=0.008)),
    Condition("vibration of 1 m/s2", edit=Edit(("accel_y",), noise=1.0, corner=8.0)),
    Condition("gyro 20 ms late", edit=Edit(("gyro",), delay=0.02)),
    Condition("steering sensor 50 ms late", edit=Edit(("steer",), delay=0.05)),
    Condition(BAD_INPUT, _BOTH, _LANE, Edit(("steer",), scale=1.0 / _DEGREE, start=5.0), fault=5.0),
)
_IDEAL = (  # a camera that errs cannot see a road from which the car turns away
    Condition("camera and GPS", _BOTH, _LANE, fault=np.inf),
    Condition("camera and GPS, straight road", _BOTH, fault=np.inf),
    *_IN_V1[1:],
)
CONDITIONS = _IN_V1 + tuple(
    replace(x, name=x.name + IDEAL_SUFFIX, env_id=f"{x.env_id[:-1]}0") for x in _IDEAL
)


def _drive_car(condition: Condition, seed: int, has_errors: bool = True) -> tuple[Log, Any]:
    """Log without the edit, and env; a car moves alike without constant errors."""
    rng = np.random.default_rng([46, seed])
    speed = float(rng.uniform(*condition.speed))
    amplitude = condition.amplitude * min(1.0, (16.0 / speed) ** 1.2)
    scenario = _DRIVE | {"duration": condition.duration, "speed": speed} | dict(condition.scenario)
    scenario["trace"] = tuple(draw_steering(rng, amplitude, condition.duration))
    scenario["gyro_bias"] = (-0.005, 0.005) if has_errors else 0.0
    world = {"base": "ideal" if condition.env_id.endswith("0") else "v1"}
    world |= {} if has_errors else {name: getattr(IDEAL, name) for name in CONSTANT_ERRORS}
    options: dict[str, Any] = {"vehicle": "passenger-car", "control_period": 10}
    env: Any = gym.make(condition.env_id, scenario=scenario, world=world, **options)
    return record_drive(env, seed), env.unwrapped


_KNOWN: dict[str, float] = {
    "accel_bias_sd": 0.0, "accel_scale_sd": 0.0, "bias_sd": 0.0, "steer_offset_sd": 0.0,
    "camera_yaw_sd": 0.0, "map_heading_sd": 0.0, "map_lag_sd": 0.0, "front_tyres_sd": 0.1,
    "rear_tyres_sd": 0.1, "inverse_friction_sd": 0.1,
}  # fmt: skip
"""Levels of who knows sensors and car; tyres to a tenth, since the law has no lag (as oracles)."""
_NOISE = {"": ("gyro_noise", "accel_y_noise"), "camera": ("psi_noise", "y_l_noise")}


def _run_informed_filter(condition: Condition, seed: int) -> Estimates:
    """Run the filter that is told what the seed draws, on a record without errors of sensors."""
    log, base = _drive_car(condition, seed, has_errors=False)
    base.reset(seed=seed)  # to the tyres of the start
    record, scenario, truth, options = log.record, base.scenario, base.car_truth, dict(_KNOWN)
    if base.config.world.is_ideal:  # its errors are noise and disturbances alone
        options |= {name: NOISE[name] for key in ("", *log.slow) for name in _NOISE.get(key, ())}
        if "gps" in log.slow:
            speed = max(float(np.mean(record.fast[:, FAST.wheel_left])), 1.0)
            options["course_noise"] = NOISE["course_noise"] * COURSE_SPEED / speed
        options |= {"force_share": 0.0, "force_sd": scenario.disturbance_force}
        options |= {"moment_share": 0.0, "moment_sd": scenario.disturbance_moment}
        options["bank_sd"] = compute_range_rms(scenario, "bank")
    fast = np.ascontiguousarray(calibrate(record.fast, truth.calibration))
    calibrated = replace(log, record=replace(record, fast=fast))
    return make_unchecked_filter(NAME, log, truth.fiala, options).run(calibrated)


class Outcome(NamedTuple):
    """Numbers of a drive; mean squared errors in rad2."""

    square: float  # of the filter
    informed: float  # of the filter that is told
    gyro: float  # of the gyro alone
    nees: float
    coverage: float  # fraction of errors in the 95 % interval
    healthy_after: float  # time from the fault until `is_healthy` is False (s), or inf
    false_alarms: float  # fraction of the time before the fault in which it is False, or NaN
    spins: float  # 1 where the car spins


def _measure_drive(condition: Condition, seed: int) -> Outcome | None:
    """Run the filters over a drive; None where the car spins before errors count."""
    log, base = _drive_car(condition, seed)
    beta, dt, wrong = log.truth["beta"], log.record.dt, _apply_edit(condition.edit, log, seed)
    driven = np.cumsum(np.abs(beta) > _SPIN) == 0
    rows = driven & (log.time >= SETTLED - 1e-9) & (log.record.fast[:, FAST.wheel_left] > _SLOW)
    if rows.sum() * dt < 0.5:
        return None
    filter_ = make_unchecked_filter(NAME, wrong, base.nominal, {})
    run, healthy = filter_.run_with_health(wrong, _WATCH)
    deviation, n_watch = run.std[:, run.names.index("beta")], round(_WATCH / dt)
    gyro = make_estimator(GYRO_ALONE, vehicle=base.nominal, dt=dt).run(wrong)["beta"]
    runs = run["beta"], _run_informed_filter(condition, seed)["beta"], gyro
    square, informed, by_gyro = (float(np.mean((estimate - beta)[rows] ** 2)) for estimate in runs)
    nees, coverage, _ = compute_honesty((run["beta"] - beta)[rows], deviation[rows])
    healthy = healthy[::n_watch][: int(driven.sum() * dt / _WATCH)]
    time = _WATCH * np.arange(1, len(healthy) + 1)
    said = time[~healthy & (time > condition.fault)] - condition.fault
    clean = healthy[time <= condition.fault]
    alarms = float(np.mean(~clean)) if len(clean) else np.nan
    after = float(said[0]) if len(said) else np.inf
    spins = float(not driven.all())
    return Outcome(square, informed, by_gyro, nees, coverage, after, alarms, spins)


def _measure_seeds(case: tuple[Condition, Sequence[int]]) -> list[Outcome | None]:
    condition, seeds = case
    return [_measure_drive(condition, _FIRST_SEED + seed) for seed in seeds]


Results = dict[str, dict[str, Any]]  # cells of the table by condition and column


def _measure(request: Request) -> Results:
    seeds = request.episodes or 0
    counts = [seeds * (_BASE_FACTOR if x.name == BASE else 1) for x in CONDITIONS]
    drives = request.run_seeds(_measure_seeds, CONDITIONS, counts, 8, "conditions")
    return {
        condition.name: _summarise_outcomes([item for item in outcomes if item is not None])
        for condition, outcomes in zip(CONDITIONS, drives, strict=True)
    }


def _summarise_outcomes(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    square, informed, gyro, nees, coverage, after, alarms, spins = np.array(outcomes, float).T
    lost = nees > _LOST
    return {
        "n": len(outcomes),
        "spins": int(spins.sum()),
        "rmse": interval(square, root_mean),
        "rmse_over_told": interval(square, ratio_of_roots, informed),
        "rmse_over_gyro": interval(square, ratio_of_roots, gyro),
        "nees": interval(nees),
        "coverage": mean_share(coverage),
        "lost": float(np.mean(lost)),
        "healthy_after": float(np.median(after[lost])) if lost.any() else np.nan,
        "false_alarms": float(np.mean(alarms)),
    }


def _add_tables(suite: Suite, results: Results) -> None:
    for x in CONDITIONS:
        suite.add_rows([results[x.name]], x.env_id, scenario=x.name, estimator=NAME)
    records = [{"condition": name} | numbers for name, numbers in results.items()]
    suite.tables = [ResultTable(f"{NAME} in each condition", _COLUMNS, records, _NOTE)]


_COLUMNS = (
    *("condition", "n", "spins"),
    Column("rmse", "RMSE / mrad", 1e3, ".2f", interval=False),
    Column("rmse_over_told", "over told", form=".2f"),
    Column("rmse_over_gyro", "over gyro", form=".2f", interval=False),
    *HONESTY[:2],
    Column("lost", "lost / %", 1e2, ".0f"),
    Column("healthy_after", "said after / s", form=".1f"),
    Column("false_alarms", "false alarms / %", 1e2, ".1f"),
)
_NOTE = (
    f"Errors count above {_SLOW:g} m/s. spins: drives in which they count until the car slips by "
    f"{_SPIN} rad. over gyro: over {GYRO_ALONE}. lost: drives with a NEES above {_LOST:g}. said "
    "after: from the fault until healthy is false in these (median), inf where it never is. false "
    "alarms: time before a fault in which it is false."
)


def _compose_verdict(results: Mapping[str, Mapping[str, Any]]) -> str:
    others = [name for name in results if name != BASE and BAD_INPUT not in name]
    clean = [name for name in others if name.endswith(IDEAL_SUFFIX)]
    judged = [name for name in others if name not in clean]
    ratio, nees, coverage, gyro, silence = (
        {name: float(np.ravel(cells.get(key, np.inf))[0]) for name, cells in results.items()}
        for key in ("rmse_over_told", "nees", "coverage", "rmse_over_gyro", "healthy_after")
    )
    worst = max(judged, key=lambda name: ratio[name])
    lost = [name for name in results if nees[name] > _LOST]
    silent = [name for name in lost if not silence[name] <= _MAX_SILENCE]
    lost_names, silent_names = (summarise_names(x) if x else "none" for x in (lost, silent))
    middle = float(np.median([ratio[name] for name in judged]))
    clean_nees = float(np.median([nees[name] for name in clean]))
    return format_verdict(
        f"In world v1 it errs {ratio[BASE]:.2f} times as much as one that is told all; "
        f"95 % intervals hold {1e2 * coverage[BASE]:.0f} %.",
        f"With one error more, in {len(judged)} conditions, the median is {middle:.2f}, "
        f"the worst is {worst} with {ratio[worst]:.1f}.",
        f"The interval holds at least 88 % in {sum(coverage[x] >= 0.88 for x in judged)}; NEES is "
        f"0.5 to 2 in {sum(0.5 <= nees[x] <= 2.0 for x in judged)}, in an ideal world "
        f"{clean_nees:.2f}.",
        f"Lost, with a NEES above {_LOST:g}: {lost_names}; unsaid for {_MAX_SILENCE:g} s: "
        f"{silent_names}. Over gyro at most {max(gyro[x] for x in judged):.2f}.",
        "Not covered: other cars, reversing, and recorded drives (`sideslip replay`).",
    )


def _add_figures(suite: Suite, results: Results, draw: ModuleType) -> None:
    groups = {"": {name: cells["rmse_over_told"] for name, cells in results.items()}}
    figure = draw.draw_groups(groups, "RMSE over that of one that is told", {1.0: "is told"})
    suite.answers.append((suite.title, figure, suite.verdict.splitlines()[1]))


STUDY = Study(
    "conditions", "How far is a filter without options from one that is told everything?",
    f"RMSE of the sideslip angle from 2 s on, of {NAME} over the same filter that is told: the "
    "true car, tyres and friction to a tenth, sensors' errors, and in an ideal world the "
    "levels of noise and disturbances. No level was found in these drives. NEES: the mean square "
    "of the error over its deviation, 1 where that is honest. Intervals are 95 % over seeds.",
    (64, 4),
    _measure, _add_tables, _compose_verdict, _add_figures,
)  # fmt: skip
