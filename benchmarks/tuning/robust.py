"""Search of the levels that make `joint-robust` most accurate on cars with unknown parameters.

`python -m sideslip.benchmarks.tuning.robust` simulates drives up to the limit of grip, of our car
and of CommonRoad's drift and multi-body models, logged at 100 Hz with random sensor errors. The
filter is configured with other tyres, friction and roll stiffness.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ...agents.rollout import rollout
from ...envs.numerics.kernel_cache import hash_sources
from ...envs.record import FAST, Array, Log
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, LoggedEpisode, call_quietly
from ..harness.parallel import run_cases
from ..recorded.emulate import Emulation
from .estimator import FIRST_SEED, STORAGE, Range
from .study import create_study, search_on_drives

_PLANTS = ("", "drift", "multi-body")  # of a drive: ours, then CommonRoad's
_EVERY = 10  # ticks between two rows of a log
DURATION = 30.0  # s
_LATE_COURSE = Emulation(delay=0.2)
_SPACE: dict[str, Range] = {
    "inverse_friction_sd": (0.02, 0.6),
    "q_front_tyres": (1e-4, 0.2),
    "force_share": (3e-3, 0.3),
    "moment_share": (1e-3, 0.1),
    "model_error": (3e-3, 0.3),
    "disturbance_time": (0.03, 3.0),
    "accel_bias_sd": (0.03, 1.0),
    "accel_bias_time": (1.0, 60.0),
    "accel_scale_sd": (0.003, 0.1),
    "gyro_noise": (1e-3, 0.03),
}
"""Ranges of the levels; the rear tyres have those of the front tyres."""


def _make_scenario(draw: np.random.Generator, outside: bool) -> dict[str, Any]:
    """Draw a random steering whose lateral acceleration reaches a fraction of the grip."""
    speed, friction = draw.uniform(12.0, 32.0), draw.uniform(0.6, 1.1)
    peak = draw.uniform(0.35, 0.9) * friction * GRAVITY
    steer = 0.25 * peak * (2.6 / speed**2 + 0.0025)
    fields = {"base": "random-steering", "speed": speed, "duration": DURATION, "friction": friction}
    fields |= {"amplitude": steer, "amplitude_2": steer, "half_width": 1e4, "hdop_law": "constant"}
    fields |= {"surge": draw.uniform(0.0, 2.0), "surge_frequency": draw.uniform(0.05, 0.2)}
    fields |= dict.fromkeys(("disturbance_force", "disturbance_moment"), draw.uniform(20.0, 200.0))
    return fields if outside else fields | {"bank": draw.uniform(-0.03, 0.03), "roll": True}


def _simulate_drive(seed: int) -> LoggedEpisode | None:
    """Simulate a log at 100 Hz with what a filter is configured with; None for a spin."""
    draw = np.random.default_rng(seed)
    plant = _PLANTS[seed % len(_PLANTS)]
    native_env: dict[str, Any] = {"id": "sideslip/YawGps-v0", "vehicle": "passenger-car"}
    outside_env: dict[str, Any] = {"id": "sideslip/Outside-v0", "model": plant, "sensors": "gps"}
    scenario = _make_scenario(draw, bool(plant))
    made = outside_env if plant else native_env
    env: Any = gym.make(**made, scenario=scenario, control_period=_EVERY)
    done = rollout(env, seed=seed)
    log, base = done.log, env.unwrapped
    if log.time[-1] < DURATION - 1.0:
        return None
    n, dt = -(-len(log.record.fast) // _EVERY), _EVERY * log.record.dt
    truth = np.interp(np.arange(n) * dt, log.time - log.time[0], log.truth["beta"])
    rows = dataclasses.replace(log.record, fast=log.record.fast[::_EVERY].copy(), first=0, dt=dt)
    noisy_log = _LATE_COURSE.add_course(Log(rows, {}, {"beta": truth}, f"drive {seed}"), seed)
    _add_sensor_errors(noisy_log.record.fast, dt, draw)
    vehicle = _vary_vehicle(base.nominal, scenario["friction"], draw)
    return LoggedEpisode(noisy_log, {"vehicle": vehicle, "dt": dt})


def _vary_vehicle(car: Vehicle, friction: float, draw: np.random.Generator) -> Vehicle:
    """Draw the car of a data sheet: stiffness, friction, roll, weight and balance differ."""
    car, moved = car.scale_stiffness(*draw.uniform(0.7, 1.3, 2)), draw.uniform(-0.08, 0.08)
    return dataclasses.replace(
        car,
        friction=friction * draw.uniform(0.8, 1.25),
        roll_stiffness=car.roll_stiffness * 10.0 ** draw.uniform(-0.15, 0.6),
        mass=car.mass * draw.uniform(0.9, 1.1),
        yaw_inertia=car.yaw_inertia * draw.uniform(0.8, 1.25),
        front_arm=car.front_arm + moved,
        rear_arm=car.rear_arm - moved,
    )


def _add_sensor_errors(fast: Array, dt: float, draw: np.random.Generator) -> None:
    """Add drawn noise, biases, scale errors and dropouts to fast rows, in place."""
    n = len(fast)
    wander = _draw_ou_path(draw, n, dt / draw.uniform(3.0, 30.0)) * draw.uniform(0.0, 0.4)
    fast[:, FAST.accel_y] *= 1.0 + draw.uniform(-0.03, 0.03)
    fast[:, FAST.accel_y] += wander + 10.0 ** draw.uniform(-1.0, 0.3) * draw.standard_normal(n)
    noise = np.radians(draw.uniform(0.0, 0.4)) * draw.standard_normal(n)
    fast[:, FAST.gyro] += np.radians(draw.uniform(-0.3, 0.3)) + noise
    turning = np.gradient(fast[:, FAST.gyro], dt)
    smooth = np.convolve(turning, np.ones(20) / 20, "same")
    fast[:, FAST.accel_y] += draw.uniform(-0.3, 0.3) * smooth
    fast[:, [FAST.wheel_left, FAST.wheel_right]] *= draw.uniform(0.98, 1.02)
    fast[:, FAST.steer] *= draw.uniform(0.94, 1.06)
    fast[:, FAST.steer] += np.radians(draw.uniform(-0.1, 0.1))
    fast[draw.integers(n, size=2), FAST.steer] = draw.uniform(-0.2, 0.2, 2)


def _draw_ou_path(draw: np.random.Generator, n: int, share: float) -> Array:
    """Draw an Ornstein-Uhlenbeck path (n,) of deviation 1; share: step over time constant."""
    left, path = math.exp(-share), np.empty(n)
    path[0] = draw.standard_normal()
    for i in range(1, n):
        path[i] = left * path[i - 1] + math.sqrt(1.0 - left * left) * draw.standard_normal()
    return path


def _make_options(values: Mapping[str, float]) -> dict[str, float]:
    """Make the options of `joint-robust` from levels, both axles alike."""
    both = {name.replace("front", "rear"): value for name, value in values.items()}
    return both | dict(values)


def _compute_errors(options: Mapping[str, Any], drives: Sequence[LoggedEpisode]) -> Array:
    """Compute RMSE of beta (rad) and NEES, without and with late course: (drives, 2, 2)."""
    results = np.empty((len(drives), 2, 2))
    for i, sample in enumerate(drives):
        for j, slow in enumerate(({}, sample.log.slow)):
            log = dataclasses.replace(sample.log, slow=slow)
            if not slow:
                log.record = dataclasses.replace(log.record, packets=log.record.packets[:0])
            facts = sample.facts | {"sensors": slow, "slow": list(slow)}
            facts |= {"course_noise": math.radians(_LATE_COURSE.course_noise_deg)} if slow else {}
            estimates = call_quietly(make_estimator, "joint-robust", **facts, **options).run(log)
            settled = log.time >= SETTLED
            off = (estimates["beta"] - log.truth["beta"])[settled]
            std = estimates.std[settled, estimates.names.index("beta")]
            results[i, j] = math.sqrt(np.mean(off**2)), np.mean((off / std) ** 2)
    return np.where(np.isfinite(results), results, np.inf)


def _compute_objective(results: Array) -> float:
    """Compute the mean logarithm of the RMSE, and a tenth of the NEES' distance from 1."""
    rmse, nees = np.log(results[..., 0]), np.log(results[..., 1])
    return float(np.mean(rmse + 0.1 * np.abs(nees)))


@dataclasses.dataclass(frozen=True)
class _Levels:
    """Question of the study."""

    study: str
    search: Mapping[str, Range] = dataclasses.field(default_factory=lambda: _SPACE)


def _evaluate_levels(drives: Sequence[LoggedEpisode], values: dict[str, float]) -> float:
    return _compute_objective(_compute_errors(_make_options(values), drives))


def _main(
    trials: Annotated[int, typer.Option(help="Of the study, the finished ones included.")] = 600,
    drives: Annotated[int, typer.Option(help="Training drives; as many for the test.")] = 24,
    jobs: Annotated[int | None, typer.Option("--jobs", "-j", help="Processes.")] = None,
    storage: Annotated[str, typer.Option(help="RDB URL or SQLite file.")] = STORAGE,
) -> None:
    """Search the levels; print them, and what they give on drives not seen."""
    console = Console()
    seeds = range(FIRST_SEED, FIRST_SEED + 2 * drives)
    simulated = run_cases(_simulate_drive, seeds, "drives", jobs, console)
    all_drives = [drive for drive in simulated if drive is not None]
    training, test = all_drives[0::2], all_drives[1::2]
    task = _Levels(f"joint-robust {hash_sources('estimators')}")
    study = create_study(task, storage)
    search_on_drives(study, task, trials, _evaluate_levels, training, jobs, console)
    best = {name: float(f"{value:.2g}") for name, value in study.best_params.items()}
    for name, value in _make_options(best).items():
        console.print(f"{name} = {value}")
    for label, options in (("as shipped", {}), ("found", _make_options(best))):
        results = _compute_errors(options, test)
        rmse = np.degrees(np.exp(np.mean(np.log(results[..., 0]), axis=0)))
        nees = np.median(results[..., 1], axis=0)
        text = f"{label}, {len(test)} test drives: {rmse[0]:.3f} deg inertial, {rmse[1]:.3f} with"
        console.print(f"{text} a late course; median NEES {nees[0]:.2f}, {nees[1]:.2f}")


if __name__ == "__main__":
    typer.run(_main)
