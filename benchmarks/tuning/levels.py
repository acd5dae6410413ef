"""Levels of `joint`, found on simulated cars by a log score, and what its parts are worth.

`python -m sideslip.benchmarks.tuning.levels search --trials 2000 --out levels.json` goes on from
the levels in use. Every drive has a car, errors, a road and an event of its own; in 60 % of them
the ranges of two groups of errors are doubled, since the next car is none of these. `... levels
parts --drives 250 --out docs/next_car.json` runs filters with one part less over other such drives.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ...envs.numerics.kernel_cache import hash_sources
from ...envs.record import FAST, PACKET, Array, Log
from ...envs.scenarios.world import GROUPS, make_world
from ...envs.sensors.link import SlowSensor
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.options import BIASES, COURSE_SPEED
from ...estimators.filters import FILTERS
from ..harness.drives import (
    SETTLED,
    LoggedEpisode,
    draw_steering,
    make_filter_arguments,
    make_unchecked_filter,
    record_drive,
)
from ..harness.parallel import run_cases
from ..harness.results import write_text
from ..harness.stats import average, compute_honesty

if TYPE_CHECKING:
    from .search import SearchOptions

app = typer.Typer()
NAME = "joint"
_SEARCHED = (
    *("q_front_tyres", "front_tyres_sd", "inverse_friction_sd", "q_inverse_friction"),
    *("force_share", "moment_share", "disturbance_time", "moment_time", "model_error"),
    *("force_sd", "moment_sd", "gyro_noise", "accel_y_noise", "noise_time", "robust"),
    *("bias_sd", "q_bias", "accel_bias_sd", "accel_bias_time", "accel_scale_sd"),
    *("steer_offset_sd", "bank_time", "course_noise"),
    *("psi_noise", "y_l_noise"),
    *("map_heading_sd", "map_heading_time", "map_lag_sd"),
)  # options whose factors are searched; how roads and cameras lean is no matter of search
_KINDS = ("camera", "gps", "camera and gps", "gps, 100 Hz", "nothing, 100 Hz")
_WORST = 100.0  # squared error over its variance, of which more counts as much
_REACH = 2.5  # times a level, to the ends of its range; CMA-ES begins with a sixth of the range


def _draw_event(rng: np.random.Generator, is_small: bool) -> dict[str, object]:
    """Draw what happens in half of the drives, as fields of a scenario."""
    when = float(rng.uniform(5.0, 12.0))
    force = (150.0, 500.0) if is_small else (500.0, 2000.0)
    front, rear = map(float, rng.uniform(0.6, 1.2, 2))
    events: tuple[dict[str, object], ...] = (
        {"front_change": front, "rear_change": rear, "tyre_change_time": when},
        {"wind_force": force, "wind_arm": 0.3, "wind_start": when, "wind_length": 3.0},
        {"gps_outage": (6.0, 16.0)},
        {"initial_beta": float(rng.uniform(-0.1, 0.1)), "friction": 0.5},
        {"speed_change": (-3.0 if is_small else -10.0), "change_start": 6.0, "change_length": 4.0},
    )
    return events[rng.integers(len(events))] if rng.random() < 0.5 else {}


def _draw_data_sheet(rng: np.random.Generator, vehicle: Vehicle) -> Vehicle:
    """Draw a data sheet that errs: mass, inertia, centre of gravity, and how the body rolls."""
    shift = float(rng.uniform(-0.06, 0.06)) * vehicle.front_arm
    return dataclasses.replace(
        vehicle,
        mass=vehicle.mass * rng.uniform(0.95, 1.05),
        yaw_inertia=vehicle.yaw_inertia * rng.uniform(0.85, 1.15),
        front_arm=vehicle.front_arm + shift,
        rear_arm=vehicle.rear_arm - shift,
        roll_stiffness=vehicle.roll_stiffness * math.exp(rng.uniform(-0.5, 0.7)),
        roll_damping=vehicle.roll_damping * math.exp(rng.uniform(-0.4, 0.4)),
    )


def _reduce_rate(log: Log, every: int, sensors: Iterable[str]) -> Log:
    """Keep every so manieth row, as a slower logger does, and the packets of some sensors."""
    record, step = log.record, log.record.dt * every
    packets = np.concatenate([record.packets[:0], *map(record.select_packets, sensors)])
    packets[:, PACKET.captured] = np.floor(packets[:, PACKET.captured] / every + 1e-9)
    packets[:, PACKET.arrived] = np.ceil(packets[:, PACKET.arrived] / every - 1e-9)

    def round_up(time: float) -> float:
        return math.ceil(time / step - 1e-6) * step

    slow = {
        name: SlowSensor(
            round(sensor.period / step) * step,
            tuple(map(round_up, sensor.delays)),
            round_up(sensor.phase or 0.0),
            round_up(sensor.jitter),
        )
        for name, sensor in log.slow.items()
        if name in sensors
    }
    fast = np.ascontiguousarray(record.fast[::every])
    first = record.first // every
    thinned = dataclasses.replace(record, fast=fast, packets=packets, first=first, dt=step)
    return Log(thinned, slow, {name: truth[::every] for name, truth in log.truth.items()})


def _draw_drive(seed: int, duration: float = 14.0) -> LoggedEpisode:
    """Drive a drawn car of world v1; the filter's arguments have a data sheet that errs."""
    rng, kind = np.random.default_rng([43, seed]), _KINDS[seed % len(_KINDS)]
    is_small, world = rng.random() < 0.3, make_world("v1")
    if rng.random() < 0.6:
        for group in rng.choice([g for g in GROUPS if g not in ("load", "tyres")], 2, False):
            world = world.scale(str(group), 2.0)
    speed = float(rng.uniform(5.0, 11.0) if is_small else rng.uniform(14.0, 30.0))
    amplitude = float((0.12 if is_small else 0.05) * rng.choice([0.15, 0.4, 0.7, 1.0, 1.3]))
    amplitude *= min(1.0, (16.0 / speed) ** 1.2)
    scenario: dict[str, object] = {
        "base": "random-steering", "steering": "trace", "trace_step": 0.01, "onset": 0.0,
        "trace": tuple(draw_steering(rng, amplitude, duration)), "duration": duration,
        "speed": speed, "front_stiffness": (0.6, 1.4), "rear_stiffness": (0.6, 1.4),
        "friction": ((0.8, 1.0), (0.4, 1.0), (0.25, 0.6))[rng.integers(3)],
        "hdop_law": "half", "half_width": 1e4, "gyro_bias": (-0.005, 0.005),
        "disturbance_force": 50.0 if is_small else 200.0,
        "disturbance_moment": 40.0 if is_small else 350.0,
    } | _draw_event(rng, is_small)  # fmt: skip
    if "camera" in kind:
        scenario |= {"road": "nominal-path", "camera_heading": 0.5, "camera_offset": 4.0}
    sensors = {"camera": "Vision", "camera and gps": "Fusion"}.get(kind, "Gps")
    name, vehicle = f"sideslip/Yaw{sensors}-v1", "coms" if is_small else "passenger-car"
    env = gym.make(name, world=world, scenario=scenario, vehicle=vehicle, control_period=10)
    log = record_drive(env, seed)
    facts = make_filter_arguments(env.unwrapped)
    if "100 Hz" in kind:
        log = _reduce_rate(log, 10, ("gps",) if "gps" in kind else ())
        facts |= {"dt": log.record.dt, "sensors": log.slow}
    facts |= {"vehicle": _draw_data_sheet(rng, facts["vehicle"])}
    env.close()
    return LoggedEpisode(log, facts)


def _run_filter(episode: LoggedEpisode, options: Mapping[str, object]) -> tuple[Array, Array]:
    """Run `joint`: errors of the sideslip angle and deviations (rad), settled, every 10 ms."""
    log, dt = episode.log, episode.log.record.dt
    estimates = make_unchecked_filter(NAME, log, episode.facts["vehicle"], options).run(log)
    rows = slice(round(SETTLED / dt), None, max(1, round(0.01 / dt)))
    column = estimates.names.index("beta")
    error = estimates.x[rows, column] - log.truth["beta"][rows]
    return error, estimates.std[rows, column]


def _convert_levels(levels: Mapping[str, float], log: Log) -> dict[str, float]:
    """Convert levels to a filter's options for a drive, those alone whose sensors are there."""
    options, sensors = dict(levels), set(log.slow)
    options["q_rear_tyres"] = options["q_front_tyres"]
    options["rear_tyres_sd"] = options["front_tyres_sd"]
    if "gps" in sensors:
        speed = float(np.mean(log.record.fast[:, FAST.wheel_left]))
        options["course_noise"] *= COURSE_SPEED / max(speed, 1.0)
    absent = {name for name, sensor in BIASES.items() if sensor in {"camera", "gps"} - sensors}
    left_out = {f"{name}_{end}" for name in absent for end in ("sd", "time")}
    left_out |= set() if "gps" in sensors else {"course_noise"}
    return {key: value for key, value in options.items() if key not in left_out}


_draw_once = cache(_draw_drive)


def _score(case: tuple[Mapping[str, float], Sequence[int]]) -> list[float]:
    """Compute the negative log score of every drive, an outlier bounded."""
    levels, seeds = case
    scores = []
    for seed in seeds:
        episode = _draw_once(seed)
        error, deviation = _run_filter(episode, _convert_levels(levels, episode.log))
        if not len(error):  # it spun before the filter had settled
            continue
        squares = np.minimum((error / deviation) ** 2, _WORST)
        scores.append(float(np.mean(0.5 * squares + np.log(deviation))))
    return scores


def _search(
    start: Mapping[str, float], drives: int, search: "SearchOptions"
) -> tuple[dict[str, float], float, float]:
    """Search from some levels on: the best levels, their log score (rad), and the start's."""
    ranges = {name: (level / _REACH, level * _REACH) for name, level in start.items()}

    def evaluate(batch: Sequence[Mapping[str, float]]) -> list[tuple[float, int]]:
        cases = [(levels, range(i, drives, 2)) for levels in batch for i in range(2)]
        scores = iter(run_cases(_score, cases, jobs=search.jobs))
        return [(float(np.mean([*next(scores), *next(scores)])), drives) for _ in batch]

    sources = hash_sources("estimators") + hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    name = f"levels of {NAME} on {drives} drives {sources}"
    from .search import run_study

    trials = run_study(name, ranges, search, evaluate, drives, start)
    scores = [trial.user_attrs["objective"] for trial in trials]
    best = int(np.argmin(scores))
    return trials[best].params, scores[best], scores[0]


def _get_levels() -> dict[str, float]:
    """Return the levels in use, of the options that are searched."""
    row = dict(FILTERS[NAME].options)
    return {name: float(row[name]) for name in _SEARCHED}


@app.command("search")
def _search_levels(
    trials: Annotated[int, typer.Option(min=1, help="Trials.")] = 1200,
    drives: Annotated[int, typer.Option(min=5, help="Drives, the same for all.")] = 120,
    out: Annotated[Path, typer.Option(help="JSON for the levels.")] = Path("levels.json"),
    storage: Annotated[str | None, typer.Option(help="Where a stopped search goes on.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
) -> None:
    """Search the levels of `joint` from those in use, and write them."""
    from .search import STORAGE, SearchOptions

    search = SearchOptions(trials, storage or STORAGE, seed=1, jobs=jobs, console=Console())
    best, score, before = _search(_get_levels(), drives, search)
    levels = {name: float(f"{value:.3g}") for name, value in best.items()}
    write_text(out, json.dumps({"score": score, "before": before, "levels": levels}, indent=1))


FIRST_SEED = 100_000  # no drive of the search
_NO_TYRES = {"front_tyres_sd": 0.0, "rear_tyres_sd": 0.0, "inverse_friction_sd": 0.0}
PARTS: dict[str, Mapping[str, object]] = {
    "joint": {},
    "without the accelerometer": {"fast": ("gyro",)},
    "without a time of the moment's own": {"moment_time": 0.0},
    "without noise found while driving": {"noise_time": 0.0},
    "without heavy tails": {"robust": 0.0},
    "without the gyro's bias": {"bias_sd": 0.0},
    "without the accelerometer's bias": {"accel_bias_sd": 0.0},
    "without the accelerometer's scale": {"accel_scale_sd": 0.0},
    "without the steering's offset": {"steer_offset_sd": 0.0},
    "without the road's bank": {"bank_sd": 0.0},
    "without the camera's yaw": {"camera_yaw_sd": 0.0},
    "without the map's heading": {"map_heading_sd": 0.0},
    "without friction": {"inverse_friction_sd": 0.0},
    "without tyres": _NO_TYRES | {"accel_scale_sd": 0.0},
}  # filters by name, as options over the defaults


def _judge_parts(seed: int, names: tuple[str, ...]) -> list[tuple[float, ...]]:
    """Judge all filters on a drive: RMS error (rad), NEES, coverage, log score of each."""
    episode, judged = _draw_drive(seed), list[tuple[float, ...]]()
    for name in names:
        error, deviation = _run_filter(episode, PARTS[name])
        if len(error):
            judged.append((float(np.sqrt(np.mean(error**2))), *compute_honesty(error, deviation)))
    return judged


@app.command("parts")
def _compare_parts(
    drives: Annotated[int, typer.Option(min=2, help="Drives, the same for all.")] = 250,
    out: Annotated[Path | None, typer.Option(help="JSON for the table.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
) -> None:
    """Compare `joint` with itself, one part less at a time."""
    console, names = Console(), tuple(PARTS)
    seeds = range(FIRST_SEED, FIRST_SEED + drives)
    judged = run_cases(partial(_judge_parts, names=names), seeds, "the next car", jobs, console)
    numbers = np.array([row for row in judged if row])  # (drives, filters, 4)
    rows = []
    for i, name in enumerate(names):
        rmse, nees, held, score = numbers[:, i].T
        lead = average(numbers[:, 0, 3] - score)
        row = {
            "filter": name,
            "rms / deg": math.degrees(float(np.sqrt(np.mean(rmse**2)))),
            "median NEES": float(np.median(nees)),
            "in 95 % / %": 100.0 * float(np.mean(held)),
            "log score lost": [float(lead.value), float(lead.low), float(lead.high)],
        }
        rows.append(row)
        console.print(row, highlight=False)
    if out is not None:
        write_text(out, json.dumps({"n": len(numbers), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    from sideslip.benchmarks.tuning import levels  # by its name, so that workers can import it

    levels.app()
