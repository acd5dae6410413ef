"""Conditions of the suite `unknown`: drives, curves of one quantity, and what a filter can lack.

A condition's drives are recorded once, and every filter runs over the same records. The bound is
the error of the optimal filter of the true model (`compute_error_bound`).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.stats import norm

from ...agents.baselines import compute_range_rms
from ...agents.rollout import iterate_steps
from ...envs.record import FAST, Array, Log, Record, concatenate
from ...envs.scenarios.scenario import Scenario
from ...envs.vehicle.parameters import Vehicle
from ...estimators.analysis.bound import Gust, VehicleChange, compute_error_bound
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, call_quietly, make_filter_arguments
from ..report.study import Request

CAMERA, GPS, _FUSION = (f"sideslip/Yaw{sensors}-v0" for sensors in ("Vision", "Gps", "Fusion"))
_KMH = 1.0 / 3.6
_STIFF = {"front_stiffness": (0.6, 1.4), "rear_stiffness": (0.6, 1.4)}
LINEAR = {"base": "random-steering", "small_angle": True, "tyres": "linear", "roll": False}
LINEAR |= {"lags": False, "speed": 25.0 * _KMH, "hdop_law": "constant"} | _STIFF
MIX = {"amplitude": (0.03, 0.08), "amplitude_2": (0.02, 0.05)}
_CHANGED = 5.0  # s
_CHANGE = {"tyre_change_time": _CHANGED, "front_change": (0.7, 1.3), "rear_change": (0.7, 1.3)}
_GUST = {"wind_force": (300.0, 500.0), "wind_arm": 0.1, "wind_start": 4.0, "wind_length": 3.0}
_TRUE = "exact-kf, true model"
"""The label of a filter that knows the true car and noise."""

Filters = Mapping[str, tuple[str, Mapping[str, Any]]]


@dataclass(frozen=True)
class Condition:
    """A kind of drive."""

    name: str  # name in the tables
    env_id: str = CAMERA  # id of the env
    scenario: Mapping[str, Any] = field(default_factory=dict)  # fields over `LINEAR`
    options: Mapping[str, Any] = field(default_factory=dict)  # options of `joint`
    since: float = SETTLED  # time from which errors count (s)
    bounded: bool = True  # whether the bound exists: the car is linear and does not roll
    modelled: bool = True  # whether `joint` has a state or a level for all that happens
    filters: Filters = field(default_factory=dict)  # others: (estimator, options) by label
    vehicle: str = "coms"  # vehicle of the env
    gyro_late: float = 0.0  # delay of the gyro (s), which the bound knows

    @property
    def all_filters(self) -> Filters:
        """Every filter that runs over the drives."""
        return {"joint": ("joint", self.options), "exact-kf": ("exact-kf", {})} | dict(self.filters)


LATE = 0.06  # s
_FIND = {"latency": {"gyro": "find"}}
_FOUR = {"members": 4}
_THREE = {"levels": (0.5, 1.0, 2.0)}
_LIMITED = {"inverse_friction_sd": 0.5}
_BIASED = {"bias_sd": 0.01}
_INERTIAL = {"fast": ["gyro", "accel_y"]}
_GUSTY = {"levels": ((1.0, 1.0), (8.0, 2.0)), "disturbance_time": 1.0}
"""One of two models expects an eightfold force; both expect disturbances to last for 1 s."""


def _scale_disturbances(factor: float) -> dict[str, Any]:
    """Scale disturbances to a factor times the levels that filters assume."""
    return MIX | {"disturbance_force": 50.0 * factor, "disturbance_moment": 20.0 * factor}


def _make_gyro_bias(degrees: float) -> dict[str, Any]:
    """Make the fields of a gyro with a bias (deg/s)."""
    return MIX | {"noise": {"gyro_bias": np.radians(degrees)}}


def _make_rolling(
    name: str, options: Mapping[str, Any], gust: Mapping[str, Any] = _GUST
) -> Condition:
    """Make a condition without a bound: the accelerometer feels that the car rolls."""
    scenario = MIX | {"roll": True} | dict(gust)
    return Condition(name, CAMERA, scenario, options, bounded=False, modelled=False)


FIALA = {"tyres": "fiala", "friction": 0.9}
_SLALOM = {"base": "slalom", "tyres": "fiala", "friction": 0.5}
_LATER = {"tyre_change_time": 5.37}  # s: between two steps of a bank of filters
CAR = {"speed": 80.0 * _KMH, "disturbance_force": 200.0, "disturbance_moment": 350.0}
"""The disturbances accelerate the passenger car as those of `LINEAR` do the COMS."""
_CAR_LEVELS = {"force_sd": 200.0, "moment_sd": 350.0}
_CAR_FILTERS: Filters = {"exact-kf": ("exact-kf", _CAR_LEVELS)}
_UNEVEN = {"camera_delays": (0.02, 0.015, 0.01, 0.025)}
_on_car = partial(Condition, filters=_CAR_FILTERS, vehicle="passenger-car")
_HALF, _TWICE = _scale_disturbances(0.5), _scale_disturbances(2.0)
CONDITIONS = (
    Condition("camera", CAMERA, MIX),
    Condition("GPS", GPS, MIX),
    Condition("camera and GPS", _FUSION, MIX),
    Condition("camera, gentle steering", CAMERA),
    Condition("GPS, gentle steering", GPS),
    Condition("camera, 10 km/h", CAMERA, MIX | {"speed": 10.0 * _KMH}),
    Condition("camera, 40 km/h, gentle", CAMERA, {"speed": 40.0 * _KMH}),
    _on_car("camera, passenger car, 80 km/h", CAMERA, CAR, _CAR_LEVELS),
    Condition("camera, gyro 60 ms late", CAMERA, MIX, modelled=False, gyro_late=LATE),
    Condition("the same, configured", CAMERA, MIX, {"latency": {"gyro": LATE}}, gyro_late=LATE),
    Condition("the same, found", CAMERA, MIX, _FIND, gyro_late=LATE),
    Condition("GPS, gyro 60 ms late, found", GPS, MIX, _FIND, gyro_late=LATE),
    Condition("camera, a punctual gyro's found", CAMERA, MIX, _FIND),
    Condition("camera, gyro 0.5 deg/s off", CAMERA, _make_gyro_bias(0.5), _BIASED),
    Condition("GPS, gyro 0.5 deg/s off", GPS, _make_gyro_bias(0.5), _BIASED),
    Condition("camera 20, 15, 10, 25 ms late", CAMERA, MIX | _UNEVEN),
    Condition("GPS out for 5 s", GPS, MIX | {"gps_outage": (3.0, 8.0)}),
    Condition("half the disturbances it was told", CAMERA, _HALF, modelled=False),
    Condition("twice the disturbances it was told", CAMERA, _TWICE, modelled=False),
    Condition("half the disturbances, three levels", CAMERA, _HALF, _THREE),
    Condition("twice the disturbances, three levels", CAMERA, _TWICE, _THREE),
    Condition("a gust of unknown strength", CAMERA, MIX | _GUST, modelled=False),
    Condition("the same gust, for a gust", CAMERA, MIX | _GUST, _GUSTY, modelled=False),
    _make_rolling("the gust, car that rolls", {}),
    _make_rolling("the same, accelerometer", _INERTIAL),
    _make_rolling("the same, accelerometer, for a gust", _INERTIAL | _GUSTY),
    _make_rolling("no gust, accelerometer, for a gust", _INERTIAL | _GUSTY, {}),
    Condition("camera, four members", CAMERA, MIX, _FOUR),
    Condition("camera, three levels", CAMERA, MIX, _THREE),
    Condition("tyres change at 5 s, four members", CAMERA, MIX | _CHANGE, _FOUR),
    Condition("the same, three levels", CAMERA, MIX | _CHANGE, _THREE),
    Condition("the same, one filter", CAMERA, MIX | _CHANGE, modelled=False),
    Condition("from the change on, four members", CAMERA, MIX | _CHANGE, _FOUR, _CHANGED),
    Condition("from the change on, three levels", CAMERA, MIX | _CHANGE, _THREE, _CHANGED),
    Condition(
        "from the change on, one filter", CAMERA, MIX | _CHANGE, {}, _CHANGED, modelled=False
    ),
    Condition("tyres change at 5.37 s, four members", CAMERA, MIX | _CHANGE | _LATER, _FOUR),
    Condition("Fiala tyres, friction 0.9", CAMERA, MIX | FIALA, _LIMITED, bounded=False),
    Condition("slalom, Fiala tyres, friction 0.5", CAMERA, _SLALOM, _LIMITED, bounded=False),
)


@dataclass(frozen=True)
class Curve:
    """A quantity over which conditions vary; log: axes of `draw_curves` with a logarithm."""

    question: str
    label: str
    values: tuple[float, ...]
    make_condition: Callable[[float], Condition]
    log: str = "y"

    def conditions(self) -> list[Condition]:
        """Make the condition at every value."""
        return [self.make_condition(value) for value in self.values]


def _vary_steering(degrees: float) -> Condition:
    size = {"amplitude": np.radians(degrees), "amplitude_2": 0.6 * np.radians(degrees)}
    return Condition(f"steering of {degrees:g} deg", CAMERA, size)


def _vary_noise(factor: float) -> Condition:
    """Make a condition without a bound: the accelerometer feels that the car rolls."""
    noise = {"roll": True, "noise": {"accel": 0.1 * factor}}
    options = _INERTIAL | {"noise_time": 2.0}
    filters: Filters = {
        "joint, finds the noise": ("joint", options),
        "exact-kf": ("exact-kf", _INERTIAL),
        _TRUE: ("exact-kf", _INERTIAL | {"accel_y_noise": 0.1 * factor}),
    }
    name = f"accelerometer noise x {factor:g}"
    return Condition(name, CAMERA, MIX | noise, _INERTIAL, bounded=False, filters=filters)


def _vary_disturbances(factor: float) -> Condition:
    filters = {"joint, three levels": ("joint", _THREE)}
    name, scenario = f"disturbances x {factor:g}", _scale_disturbances(factor)
    return Condition(name, CAMERA, scenario, filters=filters)


CURVES = (
    Curve("What do other tyres cost?", "stiffness of both axles / nominal",
          (0.6, 0.8, 1.0, 1.2, 1.4), lambda factor: Condition(
              f"both axles {factor:g} of nominal", CAMERA, MIX | dict.fromkeys(_STIFF, factor))),
    Curve("How much steering do the tyres need?", "steering amplitude / deg",
          (0.125, 0.25, 0.5, 1.0, 2.0, 4.0), _vary_steering, "xy"),
    Curve("What does a late camera cost?", "delay of the camera / ms",
          (0.0, 30.0, 60.0, 100.0, 150.0, 200.0), lambda ms: Condition(
              f"camera {ms:g} ms late", CAMERA, MIX | {"camera_delays": (1e-3 * ms,)})),
    Curve("What does a slow GPS cost?", "period of the GPS / s",
          (0.05, 0.1, 0.2, 0.5, 1.0, 2.0), lambda period: Condition(
              f"GPS every {period:g} s", GPS, MIX | {"gps_period": period}), "xy"),
    Curve("What does a GPS that is out cost?", "length of the outage / s",
          (0.0, 1.0, 2.0, 3.0, 4.0, 6.0), lambda s: Condition(
              f"no GPS for {s:g} s", GPS, MIX | ({"gps_outage": (3.0, 3.0 + s)} if s else {}))),
    Curve("What does a gyro's bias cost?", "bias of the gyro / (deg/s)",
          (0.0, 0.1, 0.2, 0.5, 1.0, 2.0), lambda degrees: Condition(
              f"gyro {degrees:g} deg/s off", CAMERA, _make_gyro_bias(degrees), _BIASED)),
    Curve("What does another noise of the accelerometer cost?",
          "accelerometer noise / data sheet's", (0.25, 0.5, 1.0, 2.0, 4.0), _vary_noise, "xy"),
    Curve("What do other disturbances cost?", "disturbances / those assumed",
          (0.5, 0.7, 1.0, 1.4, 2.0), _vary_disturbances, "xy"),
)  # fmt: skip

_COMPLETE = _INERTIAL | _LIMITED | _BIASED | {"accel_bias_sd": 0.3}
WITHOUT: dict[str, dict[str, Any]] = {
    "joint, complete": {},
    "without accelerometer": {"fast": ["gyro"], "accel_bias_sd": 0.0},
    "without friction": {"inverse_friction_sd": 0.0},
    "without stiffness": {"front_tyres_sd": 1e-6, "rear_tyres_sd": 1e-6},
    "without disturbances": {"force_sd": 1.0, "moment_sd": 1.0},
    "without biases": {"bias_sd": 0.0, "accel_bias_sd": 0.0},
}
"""Options over `_COMPLETE`: a state is left out or known at the start."""


def _make_ablation(name: str, env_id: str, scenario: Mapping[str, Any]) -> Condition:
    filters = {label: ("joint", _COMPLETE | left) for label, left in WITHOUT.items()}
    return Condition(name, env_id, {"roll": True} | dict(scenario), bounded=False, filters=filters)


PARTS = (
    _make_ablation("camera, car that rolls", CAMERA, MIX),
    _make_ablation("GPS, car that rolls", GPS, MIX),
    _make_ablation("gyro 0.5 deg/s off, car that rolls", CAMERA, _make_gyro_bias(0.5)),
    _make_ablation("Fiala tyres, car that rolls", CAMERA, MIX | FIALA),
)


LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)  # confidences of counted intervals
_Z = norm.ppf(0.5 + 0.5 * np.array(LEVELS))
_CHUNK = 16


@dataclass
class ConditionResult:
    """Results of the seeds whose episodes did not end early, shape (seeds,) by filter."""

    condition: Condition
    seeds: list[int]  # seeds of the episodes
    squares: dict[str, Array]  # mean squared errors (rad2)
    nees: dict[str, Array]  # normalised squared errors
    variances: dict[str, Array]  # the filters' own variances (rad2)
    inside: dict[str, Array]  # fractions of the errors within `LEVELS`, shape (seeds, levels)
    best: Array  # mean squares of the bound (rad2), NaN where there is none
    left_out: int  # number of episodes that ended early


def measure_all(
    request: Request, conditions: Sequence[Condition], seeds: int, title: str
) -> list[ConditionResult]:
    """Measure every condition on the same seeds.

    Args:
        request: Options of the run.
        conditions: Conditions to measure.
        seeds: Number of seeds.
        title: Title of the progress bar.

    Returns:
        Result of each condition.
    """
    drives = request.run_seeds(_measure_seeds, conditions, seeds, _CHUNK, title)
    return list(map(_stack_results, conditions, drives))


def _stack_results(
    condition: Condition, drives: Sequence[dict[str, list[float]] | None]
) -> ConditionResult:
    seeds = [seed for seed, drive in enumerate(drives) if drive is not None]
    driven, names = [drive for drive in drives if drive is not None], [*condition.all_filters, ""]
    # (numbers, seeds) of each filter
    numbers = {
        name: np.reshape([x[name] for x in driven], (-1, 3 + len(LEVELS))).T for name in names
    }
    best = numbers.pop("")[0]
    by_name = ({name: item[i] for name, item in numbers.items()} for i in range(3))
    squares, nees, variances = by_name
    inside = {name: item[3:].T for name, item in numbers.items()}
    return ConditionResult(
        condition, seeds, squares, nees, variances, inside, best, len(drives) - len(driven)
    )


def _measure_seeds(case: tuple[Condition, Sequence[int]]) -> list[dict[str, list[float]] | None]:
    """Drive some seeds of a condition, and run its filters over the records; None: ended early.

    Mean squared error, NEES, variance and fractions within `LEVELS` of each filter; the mean square
    of the bound stands under "".
    """
    condition, seeds = case
    scenario = LINEAR | dict(condition.scenario)
    car = condition.vehicle
    env: Any = gym.make(condition.env_id, scenario=scenario, control_period=10, vehicle=car)
    filters, results = dict[str, Estimator](), list[dict[str, list[float]] | None]()
    for seed in seeds:
        episode = _run_episode(env, seed)
        if episode is None:
            results.append(None)
            continue
        log, cars = episode
        settled = log.time >= condition.since - 1e-9
        if not filters or _TRUE in filters:  # else only clocks differ, and the log has them
            filters = _make_filters(condition, env.unwrapped, log)
        felt, numbers = _delay_gyro(log, condition.gyro_late), dict[str, list[float]]()
        for label, filter_ in filters.items():
            estimates = filter_.run(felt)
            error = (estimates["beta"] - log.truth["beta"])[settled]
            sd = estimates.std[settled, estimates.names.index("beta")]
            size = np.abs(error) / sd
            squares = (float(np.mean(np.square(x))) for x in (error, size, sd))
            numbers[label] = [*squares, *np.mean(size[:, None] < _Z, axis=0)]
        best = np.nan
        if condition.bounded:
            bound = _compute_bound(env.unwrapped, log, cars, condition.gyro_late)
            best = float(np.mean(bound[settled] ** 2))
        results.append(numbers | {"": [best] * (3 + len(LEVELS))})
    return results


def run_with_bound(env: gym.Env[Any, Any], seed: int) -> tuple[Log, Array]:
    """Run an episode with its bound.

    Args:
        env: Env of a linear car that does not roll.
        seed: Seed of the episode.

    Returns:
        Record, and the bound (rad) at every row.

    Raises:
        RuntimeError: The episode ends early.
    """
    episode = _run_episode(env, seed)
    if episode is None:
        raise RuntimeError(f"the episode of seed {seed} ends early")
    return episode[0], _compute_bound(env.unwrapped, *episode)


def _delay_gyro(log: Log, late: float) -> Log:
    """Make a log whose gyro is read late (s), until then with its first value."""
    if late == 0.0:
        return log
    fast, rows = log.record.fast.copy(), round(late / log.record.dt)
    fast[rows:, FAST.gyro], fast[:rows, FAST.gyro] = fast[:-rows, FAST.gyro], fast[0, FAST.gyro]
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


def _run_episode(env: gym.Env[Any, Any], seed: int) -> tuple[Log, tuple[Vehicle, Vehicle]] | None:
    """Record with the true sideslip angle, car at start and end; None where it ended early."""
    base: Any = env.unwrapped
    records, times, slips = list[Record](), [], []
    for step in iterate_steps(env, None, seed):
        if not records:
            first = base.vehicle
        records.append(base.record)
        times.append(step.info["t"])
        slips.append(step.info["beta"])
    if step.info["failure"]:
        return None
    record = concatenate(records)
    truth = {"beta": np.interp(record.ticks * record.dt, times, slips)}
    return Log(record, base.slow_sensors, truth), (first, base.vehicle)


def _get_levels(scenario: Scenario) -> dict[str, Any]:
    """Return the true levels of disturbances, as options of a filter."""
    return {"force_sd": scenario.disturbance_force, "moment_sd": scenario.disturbance_moment}


def _make_filters(condition: Condition, base: Any, log: Log) -> dict[str, Estimator]:
    facts, filters = make_filter_arguments(base) | {"slow": list(log.slow)}, {}
    true = facts | {"vehicle": base.vehicle} | _get_levels(base.scenario)
    for label, (name, options) in condition.all_filters.items():
        known = true if label == _TRUE else facts
        filters[label] = call_quietly(make_estimator, name, **known, **options)
    return filters


def _compute_bound(
    base: Any, log: Log, cars: tuple[Vehicle, Vehicle], gyro_late: float = 0.0
) -> Array:
    """Compute the bound (rad) at every row; its filter knows all but the strength of a gust."""
    scene, passing = base.scenario, dict[str, Any]()
    if scene.tyre_change_time is not None:
        passing["change"] = VehicleChange(scene.tyre_change_time, cars[1])
    if scene.wind_force != 0.0:
        strength, end = compute_range_rms(scene, "wind_force"), scene.wind_start + scene.wind_length
        passing["gust"] = Gust(strength, scene.wind_arm, scene.wind_start, end)
    facts = make_filter_arguments(base) | _get_levels(scene)
    facts |= {"vehicle": cars[0], "latency": {"gyro": gyro_late}}
    return compute_error_bound(record=log.record, **facts, **passing)
