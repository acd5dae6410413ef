"""Question: which levels make `joint-robust` most accurate on cars that nobody has measured?

`python -m sideslip.benchmarks.tuning.robust` searches them on simulated drives up to the limit of
grip: our passenger car and CommonRoad's drift and multi-body models, logged at 100 Hz, with a
noise, a bias, a wandering error of the accelerometer, a steering offset and loose contacts drawn
for each, and a filter that is configured with other tyres, friction and roll stiffness.
"""

import dataclasses
import functools
import math
import tempfile
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import gymnasium as gym
import joblib
import numpy as np
import typer
from rich.console import Console

from ...agents.rollout import rollout
from ...envs.backend.cache import source_stamp
from ...envs.record import FAST, Array, Log
from ...envs.vehicle.vehicle import GRAVITY, Vehicle
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, Drive, quietly
from ..harness.parallel import run_cases
from ..recorded.emulate import Emulation
from .study import open_study, search_on
from .task import FIRST_SEED, STORAGE, Range

PLANTS = ("", "drift", "multi-body")
"""Of a drive: ours, then CommonRoad's."""
EVERY = 10  # ticks between two rows of a log
LASTS = 30.0  # s
LATE = Emulation(delay=0.2)
SPACE: dict[str, Range] = {
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
"""What is searched; the rear tyres' have the front tyres'."""


def _scenario(draw: np.random.Generator, outside: bool) -> dict[str, Any]:
    """Random steering whose lateral acceleration reaches a share of the grip."""
    speed, friction = draw.uniform(12.0, 32.0), draw.uniform(0.6, 1.1)
    peak = draw.uniform(0.35, 0.9) * friction * GRAVITY
    steer = 0.25 * peak * (2.6 / speed**2 + 0.0025)
    found = {"base": "random-steering", "speed": speed, "duration": LASTS, "friction": friction}
    found |= {"amplitude": steer, "amplitude_2": steer, "half_width": 1e4, "hdop_law": "constant"}
    found |= {"surge": draw.uniform(0.0, 2.0), "surge_frequency": draw.uniform(0.05, 0.2)}
    found |= dict.fromkeys(("disturbance_force", "disturbance_moment"), draw.uniform(20.0, 200.0))
    return found if outside else found | {"bank": draw.uniform(-0.03, 0.03), "roll": True}


def drive(seed: int) -> Drive | None:
    """A log at 100 Hz and what a filter is configured with; None where the car spins."""
    draw = np.random.default_rng(seed)
    plant = PLANTS[seed % len(PLANTS)]
    own: dict[str, Any] = {"id": "sideslip/YawGps-v0", "vehicle": "passenger-car"}
    other: dict[str, Any] = {"id": "sideslip/Outside-v0", "model": plant, "sensors": "gps"}
    scenario = _scenario(draw, bool(plant))
    env: Any = gym.make(**(other if plant else own), scenario=scenario, control_period=EVERY)
    done = rollout(env, seed=seed)
    log, base = done.log, env.unwrapped
    if log.time[-1] < LASTS - 1.0:
        return None
    n, dt = -(-len(log.record.fast) // EVERY), EVERY * log.record.dt
    truth = np.interp(np.arange(n) * dt, log.time - log.time[0], log.truth["beta"])
    rows = dataclasses.replace(log.record, fast=log.record.fast[::EVERY].copy(), first=0, dt=dt)
    seen = LATE.with_course(Log(rows, {}, {"beta": truth}, f"drive {seed}"), seed)
    spoil(seen.record.fast, dt, draw)
    return Drive(seen, {"vehicle": misjudged(base.nominal, scenario["friction"], draw), "dt": dt})


def misjudged(car: Vehicle, friction: float, draw: np.random.Generator) -> Vehicle:
    """The car as its data sheet has it: stiffness, friction, roll, weight and balance differ."""
    car, moved = car.scaled(*draw.uniform(0.7, 1.3, 2)), draw.uniform(-0.08, 0.08)
    return dataclasses.replace(
        car,
        friction=friction * draw.uniform(0.8, 1.25),
        roll_stiffness=car.roll_stiffness * 10.0 ** draw.uniform(-0.15, 0.6),
        mass=car.mass * draw.uniform(0.9, 1.1),
        yaw_inertia=car.yaw_inertia * draw.uniform(0.8, 1.25),
        front_arm=car.front_arm + moved,
        rear_arm=car.rear_arm - moved,
    )


def spoil(fast: Array, dt: float, draw: np.random.Generator) -> None:
    """Put the errors of somebody else's sensors on fast rows."""
    n = len(fast)
    wander = _wander(draw, n, dt / draw.uniform(3.0, 30.0)) * draw.uniform(0.0, 0.4)
    fast[:, FAST.accel_y] *= 1.0 + draw.uniform(-0.03, 0.03)
    fast[:, FAST.accel_y] += wander + 10.0 ** draw.uniform(-1.0, 0.3) * draw.standard_normal(n)
    noise = np.radians(draw.uniform(0.0, 0.4)) * draw.standard_normal(n)
    fast[:, FAST.gyro] += np.radians(draw.uniform(-0.3, 0.3)) + noise
    turning = np.gradient(fast[:, FAST.gyro], dt)
    fast[:, FAST.accel_y] += draw.uniform(-0.3, 0.3) * np.convolve(
        turning, np.ones(20) / 20, "same"
    )
    fast[:, [FAST.wheel_left, FAST.wheel_right]] *= draw.uniform(0.98, 1.02)
    fast[:, FAST.steer] *= draw.uniform(0.94, 1.06)
    fast[:, FAST.steer] += np.radians(draw.uniform(-0.1, 0.1))
    fast[draw.integers(n, size=2), FAST.steer] = draw.uniform(-0.2, 0.2, 2)


def _wander(draw: np.random.Generator, n: int, share: float) -> Array:
    """An Ornstein-Uhlenbeck path (n,) of deviation 1; share: of a step in its time."""
    left, path = math.exp(-share), np.empty(n)
    path[0] = draw.standard_normal()
    for i in range(1, n):
        path[i] = left * path[i - 1] + math.sqrt(1.0 - left * left) * draw.standard_normal()
    return path


def options_of(found: Mapping[str, float]) -> dict[str, float]:
    """Options of `joint-robust`: both axles alike."""
    both = {name.replace("front", "rear"): value for name, value in found.items()}
    return both | dict(found)


def errors(options: Mapping[str, Any], drives: Sequence[Drive]) -> Array:
    """(drives, 2, 2): RMSE of beta in rad and NEES; without and with a late course."""
    found = np.empty((len(drives), 2, 2))
    for i, each in enumerate(drives):
        for j, slow in enumerate(({}, each.log.slow)):
            log = dataclasses.replace(each.log, slow=slow)
            if not slow:
                log.record = dataclasses.replace(log.record, packets=log.record.packets[:0])
            facts = each.facts | {"sensors": slow, "slow": list(slow)}
            facts |= {"course_noise": math.radians(LATE.course_noise_deg)} if slow else {}
            estimates = quietly(make_estimator, "joint-robust", **facts, **options).run(log)
            late = log.time >= SETTLED
            off = (estimates["beta"] - log.truth["beta"])[late]
            std = estimates.std[late, estimates.names.index("beta")]
            found[i, j] = math.sqrt(np.mean(off**2)), np.mean((off / std) ** 2)
    return np.where(np.isfinite(found), found, np.inf)


def objective(found: Array) -> float:
    """What the search makes least, of `errors`: the mean logarithm of the RMSE, and a tenth of how
    far the NEES is from 1 on that scale, so that deviations stay honest."""
    rmse, nees = np.log(found[..., 0]), np.log(found[..., 1])
    return float(np.mean(rmse + 0.1 * np.abs(nees)))


@dataclasses.dataclass(frozen=True)
class Levels:
    """The question of a study: `SPACE`."""

    study: str
    search: Mapping[str, Range] = dataclasses.field(default_factory=lambda: SPACE)


def _judge(path: str, found: dict[str, float]) -> float:
    drives = joblib.load(path)
    return objective(errors(options_of(found), drives))


def main(
    trials: Annotated[int, typer.Option(help="Of the study, the finished ones included.")] = 600,
    drives: Annotated[int, typer.Option(help="Training drives; as many for the test.")] = 24,
    jobs: Annotated[int | None, typer.Option("--jobs", "-j", help="Processes.")] = None,
    storage: Annotated[str, typer.Option(help="RDB URL or SQLite file.")] = STORAGE,
) -> None:
    """Search the levels; print them, and what they give on drives not seen."""
    console = Console()
    seeds = range(FIRST_SEED, FIRST_SEED + 2 * drives)
    made = [each for each in run_cases(drive, seeds, "drives", jobs, console) if each is not None]
    training, test = made[0::2], made[1::2]
    study = open_study(Levels(f"joint-robust {source_stamp('estimators')}"), storage)
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/drives"
        joblib.dump(training, path)

        def judge(batch: Sequence[dict[str, float]]) -> list[tuple[float, int]]:
            values = run_cases(functools.partial(_judge, path), batch, jobs=jobs)
            return [(value, len(training)) for value in values]

        search_on(study, Levels(study.study_name), trials, judge, len(training), console)
    best = {name: float(f"{value:.2g}") for name, value in study.best_params.items()}
    for name, value in options_of(best).items():
        console.print(f"{name} = {value}")
    for label, options in (("as shipped", {}), ("found", options_of(best))):
        found = errors(options, test)
        rmse = np.degrees(np.exp(np.mean(np.log(found[..., 0]), axis=0)))
        nees = np.median(found[..., 1], axis=0)
        text = f"{label}, {len(test)} test drives: {rmse[0]:.3f} deg inertial, {rmse[1]:.3f} with"
        console.print(f"{text} a late course; median NEES {nees[0]:.2f}, {nees[1]:.2f}")


if __name__ == "__main__":
    typer.run(main)
