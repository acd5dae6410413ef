"""Levels of `joint`, found on simulated cars of world v1 by a log score.

`python -m sideslip.benchmarks.tuning.levels --trials 2000 --out levels.json` goes on from the
levels in use. Every drive has a car, errors, a road and an event of its own; in 60 % of them the
ranges of two groups of errors are doubled, since the next car is none of these.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ...envs.record import FAST, PACKET, Array, Log
from ...envs.scenarios.world import GROUPS, make_world
from ...envs.sensors.link import SlowSensor
from ...envs.vehicle.parameters import Vehicle
from ...estimators.design.models import BIASES, COURSE_SPEED
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
_POPULATION = 12


def _draw_event(rng: np.random.Generator, is_small: bool) -> dict[str, object]:
    """Draw what happens in half of the drives, as fields of a scenario."""
    when = float(rng.uniform(5.0, 12.0))
    force = (150.0, 500.0) if is_small else (500.0, 2000.0)
    changes: dict[str, object] = {
        f"{axle}_change": float(rng.uniform(0.6, 1.2)) for axle in ("front", "rear")
    }
    events: tuple[dict[str, object], ...] = (
        changes | {"tyre_change_time": when},
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


def draw_drive(seed: int, duration: float = 14.0) -> LoggedEpisode:
    """Drive a drawn car of world v1 under drawn steering.

    Args:
        seed: Seed of everything.
        duration: Duration (s).

    Returns:
        Its log with the true sideslip angle, and the arguments of a filter that has a data sheet.
    """
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


def run_filter(episode: LoggedEpisode, options: Mapping[str, object]) -> tuple[Array, Array]:
    """Run `joint` over a drive.

    Args:
        episode: A drive of `draw_drive`.
        options: Options of the filter over its defaults.

    Returns:
        Errors of the sideslip angle and their deviations (rad), once settled, every 10 ms.
    """
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


_draw_once = cache(draw_drive)


def _score(case: tuple[Mapping[str, float], Sequence[int]]) -> list[float]:
    """Compute the negative log score of every drive, an outlier bounded."""
    levels, seeds = case
    scores = []
    for seed in seeds:
        episode = _draw_once(seed)
        error, deviation = run_filter(episode, _convert_levels(levels, episode.log))
        if not len(error):  # it spun before the filter had settled
            continue
        squares = np.minimum((error / deviation) ** 2, _WORST)
        scores.append(float(np.mean(0.5 * squares + np.log(deviation))))
    return scores


def _search(
    start: Mapping[str, float], trials: int, drives: int, jobs: int | None, console: Console
) -> tuple[dict[str, float], float, float]:
    """Search by CMA-ES on the logs of factors; best levels, their log score (rad), the start's."""
    from cmaes import CMA  # of the extra `tune`

    names, scores = list(start), list[float]()
    search_state = CMA(np.zeros(len(names)), 0.3, seed=1, population_size=_POPULATION)
    best, best_score = dict(start), math.inf
    while len(scores) < trials:
        asked = [search_state.ask() for _ in range(_POPULATION)]
        if not scores:
            asked[0] = np.zeros(len(names))  # the start itself
        levels = [{k: start[k] * math.exp(v) for k, v in zip(names, x, strict=True)} for x in asked]
        cases = [(x, range(i, drives, 2)) for x in levels for i in range(2)]
        title = f"{len(scores)} of {trials} trials"
        halves = run_cases(_score, cases, title, jobs, console)
        results = [float(np.mean([*halves[2 * i], *halves[2 * i + 1]])) for i in range(len(levels))]
        search_state.tell(list(zip(asked, results, strict=True)))
        scores += results
        lowest = int(np.argmin(results))
        if results[lowest] < best_score:
            best, best_score = levels[lowest], results[lowest]
        console.print(f"{title}: {best_score:.3f}", highlight=False)
    return best, best_score, scores[0]


def get_levels() -> dict[str, float]:
    """Return the levels in use, of the options that are searched."""
    row = dict(FILTERS[NAME].options)
    return {name: float(row[name]) for name in _SEARCHED}


def main(
    trials: Annotated[int, typer.Option(min=1, help="Trials.")] = 1200,
    drives: Annotated[int, typer.Option(min=5, help="Drives, the same for all.")] = 120,
    start: Annotated[
        Path | None, typer.Option(help="JSON of levels; default: those in use.")
    ] = None,
    out: Annotated[Path, typer.Option(help="JSON for the levels.")] = Path("levels.json"),
    jobs: Annotated[int | None, typer.Option(help="Processes.")] = None,
) -> None:
    """Search the levels of `joint` and write them."""
    first = get_levels() if start is None else json.loads(start.read_text(encoding="utf-8"))
    best, score, before = _search(first, trials, drives, jobs, Console())
    levels = {name: float(f"{value:.3g}") for name, value in best.items()}
    write_text(out, json.dumps({"score": score, "before": before, "levels": levels}, indent=1))


if __name__ == "__main__":
    from sideslip.benchmarks.tuning import levels  # by its name, so that workers can import it

    typer.run(levels.main)
