"""Drives of a condition, every filter over the same records, and what the bound is there."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from scipy.stats import norm

from ...agents.rollout import steps_of
from ...agents.rungs import spread_of
from ...envs.record import FAST, Array, Log, Record, concatenate
from ...envs.vehicle.vehicle import Vehicle
from ...estimators.analysis.bound import Change, Gust, bound
from ...estimators.make import make_estimator
from ..harness.drives import filter_arguments, quietly
from ..harness.parallel import chunked, run_cases
from .conditions import LINEAR, TRUE, Condition

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Confidences of the intervals that are counted."""
_Z = norm.ppf(0.5 + 0.5 * np.array(LEVELS))
_CHUNK = 16


@dataclass
class Measured:
    """Of some seeds: mean squared errors, NEES and filters' own variances (seeds, filters), mean
    squares of the bound (seeds,), NaN where there is none, and shares of the errors within `LEVELS`
    (seeds, filters, levels). Episodes that ended early are left out, `seeds` are the others'.
    """

    labels: tuple[str, ...]
    seeds: tuple[int, ...]
    squares: Array
    best: Array
    nees: Array
    inside: Array
    own: Array
    left_out: int

    def of(self, label: str) -> tuple[Array, Array, Array]:
        """Squares (seeds,), NEES (seeds,) and shares (seeds, levels) of a filter."""
        at = self.labels.index(label)
        return self.squares[:, at], self.nees[:, at], self.inside[:, at]


def measure_all(
    conditions: Sequence[Condition],
    seeds: int,
    title: str,
    jobs: int | None = None,
    console: Console | None = None,
) -> list[Measured]:
    """Every condition on the seeds 0 .. seeds-1."""
    cases = [(what, chunk) for what in conditions for chunk in chunked(seeds, _CHUNK)]
    found = iter(run_cases(measure, cases, title, jobs, console))
    return [_together([next(found) for _ in chunked(seeds, _CHUNK)]) for _ in conditions]


def _together(parts: Sequence[Measured]) -> Measured:
    squares, best, nees, inside, own = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("squares", "best", "nees", "inside", "own")
    )
    left_out = sum(part.left_out for part in parts)
    seeds = tuple(seed for part in parts for seed in part.seeds)
    return Measured(parts[0].labels, seeds, squares, best, nees, inside, own, left_out)


def measure(case: tuple[Condition, Iterable[int]]) -> Measured:
    """Drive some seeds of a condition."""
    what, seeds = case
    scenario = LINEAR | dict(what.scenario)
    env: Any = gym.make(what.env_id, scenario=scenario, control_period=10, vehicle=what.vehicle)
    filters, left_out = dict[str, Any](), 0
    labels = tuple(what.all_filters)
    squares, nees, inside, best, own, there = (list[Any]() for _ in range(6))
    for seed in seeds:
        driven = _drive(env, seed)
        if driven is None:
            left_out += 1
            continue
        log, cars = driven
        there.append(seed)
        late = log.time >= what.since - 1e-9
        if not filters or TRUE in filters:  # else only clocks differ, and the log has them
            filters = _filters(what, env.unwrapped, log)
        felt, errors, sds = _later(log, what.gyro_late), [], []
        for filter_ in filters.values():
            found = filter_.run(felt)
            errors.append((found["beta"] - log.truth["beta"])[late])
            sds.append(found.std[late, found.names.index("beta")])
        sizes = np.abs(errors) / sds
        squares.append(np.mean(np.square(errors), axis=1))
        nees.append(np.mean(sizes**2, axis=1))
        own.append(np.mean(np.square(sds), axis=1))
        inside.append(np.mean(sizes[:, :, None] < _Z, axis=1))
        best.append(
            np.mean(_bound(env.unwrapped, log, cars, what.gyro_late)[late] ** 2)
            if what.bounded
            else np.nan
        )
    n = len(labels)
    tables = [np.reshape(each, (-1, n)) for each in (squares, nees, own)]
    shares = np.reshape(inside, (-1, n, len(LEVELS)))
    return Measured(
        labels, tuple(there), tables[0], np.array(best), tables[1], shares, tables[2], left_out
    )


def drive_and_bound(env: Any, seed: int) -> tuple[Log, Array]:
    """An episode's record, and the least deviation at every row; RuntimeError if it ends early."""
    driven = _drive(env, seed)
    if driven is None:
        raise RuntimeError(f"the episode of seed {seed} ends early")
    return driven[0], _bound(env.unwrapped, *driven)


def _later(log: Log, late: float) -> Log:
    """A log whose gyro is read so many seconds after it measured; the first value until then."""
    if late == 0.0:
        return log
    fast, rows = log.record.fast.copy(), round(late / log.record.dt)
    fast[rows:, FAST.gyro], fast[:rows, FAST.gyro] = fast[:-rows, FAST.gyro], fast[0, FAST.gyro]
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


def _drive(env: Any, seed: int) -> tuple[Log, tuple[Vehicle, Vehicle]] | None:
    """The record of an episode with its true sideslip angle, and the car at its start and its end;
    None where it ended early."""
    base, records, times, slips = env.unwrapped, list[Record](), [], []
    for step in steps_of(env, None, seed):
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


def _levels(scenario: Any) -> dict[str, Any]:
    """The true levels of disturbances, as options of a filter."""
    return {
        "force_sd": scenario.disturbance_force,
        "moment_sd": scenario.disturbance_moment,
    }


def _filters(what: Condition, base: Any, log: Log) -> dict[str, Any]:
    facts, made = filter_arguments(base) | {"slow": list(log.slow)}, {}
    for label, (name, options) in what.all_filters.items():
        known = facts | (
            {"vehicle": base.vehicle} | _levels(base.scenario) if label == TRUE else {}
        )
        made[label] = quietly(make_estimator, name, **known, **options)
    return made


def _bound(base: Any, log: Log, cars: tuple[Vehicle, Vehicle], gyro_late: float = 0.0) -> Array:
    """The least deviation at every row; tyres that change, a gust and by how many s the gyro is
    late are known but for what no filter can know: the strength of a gust."""
    scene, passing = base.scenario, dict[str, Any]()
    if scene.tyre_change_time is not None:
        passing["change"] = Change(scene.tyre_change_time, cars[1])
    if scene.wind_force != 0.0:
        end = scene.wind_start + scene.wind_length
        passing["gust"] = Gust(
            spread_of(scene, "wind_force"), scene.wind_arm, scene.wind_start, end
        )
    facts = (
        filter_arguments(base)
        | {"vehicle": cars[0], "latency": {"gyro": gyro_late}}
        | _levels(scene)
    )
    return bound(record=log.record, **facts, **passing)
