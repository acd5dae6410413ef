"""Drives of a condition, every filter over the same records, and what the bound is there."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from scipy.stats import norm

from ...agents.rollout import iterate_steps
from ...agents.rungs import compute_range_rms
from ...envs.record import FAST, Array, Log, Record, concatenate
from ...envs.vehicle.vehicle import Vehicle
from ...estimators.analysis.bound import Gust, VehicleChange, compute_error_bound
from ...estimators.make import make_estimator
from ..harness.drives import call_quietly, make_filter_arguments
from ..harness.parallel import run_cases, split_seeds
from .conditions import LINEAR, TRUE, Condition

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Confidences of the intervals that are counted."""
_Z = norm.ppf(0.5 + 0.5 * np.array(LEVELS))
_CHUNK = 16


@dataclass
class ConditionResult:
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
    variances: Array
    left_out: int

    def select(self, label: str) -> tuple[Array, Array, Array]:
        """Squares (seeds,), NEES (seeds,) and shares (seeds, levels) of a filter."""
        at = self.labels.index(label)
        return self.squares[:, at], self.nees[:, at], self.inside[:, at]


def measure_all(
    conditions: Sequence[Condition],
    seeds: int,
    title: str,
    jobs: int | None = None,
    console: Console | None = None,
) -> list[ConditionResult]:
    """Every condition on the seeds 0 .. seeds-1."""
    cases = [(condition, chunk) for condition in conditions for chunk in split_seeds(seeds, _CHUNK)]
    results = iter(run_cases(measure, cases, title, jobs, console))
    return [_join_results([next(results) for _ in split_seeds(seeds, _CHUNK)]) for _ in conditions]


def _join_results(parts: Sequence[ConditionResult]) -> ConditionResult:
    squares, best, nees, inside, variances = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("squares", "best", "nees", "inside", "variances")
    )
    left_out = sum(part.left_out for part in parts)
    seeds = tuple(seed for part in parts for seed in part.seeds)
    return ConditionResult(parts[0].labels, seeds, squares, best, nees, inside, variances, left_out)


def measure(case: tuple[Condition, Iterable[int]]) -> ConditionResult:
    """Drive some seeds of a condition."""
    condition, seeds = case
    scenario = LINEAR | dict(condition.scenario)
    env: Any = gym.make(
        condition.env_id, scenario=scenario, control_period=10, vehicle=condition.vehicle
    )
    filters, left_out = dict[str, Any](), 0
    labels = tuple(condition.all_filters)
    squares, nees, inside, best, variances, driven_seeds = (list[Any]() for _ in range(6))
    for seed in seeds:
        episode = _run_episode(env, seed)
        if episode is None:
            left_out += 1
            continue
        log, cars = episode
        driven_seeds.append(seed)
        settled = log.time >= condition.since - 1e-9
        if not filters or TRUE in filters:  # else only clocks differ, and the log has them
            filters = _make_filters(condition, env.unwrapped, log)
        felt, errors, sds = _delay_gyro(log, condition.gyro_late), [], []
        for filter_ in filters.values():
            estimates = filter_.run(felt)
            errors.append((estimates["beta"] - log.truth["beta"])[settled])
            sds.append(estimates.std[settled, estimates.names.index("beta")])
        sizes = np.abs(errors) / sds
        squares.append(np.mean(np.square(errors), axis=1))
        nees.append(np.mean(sizes**2, axis=1))
        variances.append(np.mean(np.square(sds), axis=1))
        inside.append(np.mean(sizes[:, :, None] < _Z, axis=1))
        best.append(
            np.mean(_compute_bound(env.unwrapped, log, cars, condition.gyro_late)[settled] ** 2)
            if condition.bounded
            else np.nan
        )
    n = len(labels)
    tables = [np.reshape(values, (-1, n)) for values in (squares, nees, variances)]
    shares = np.reshape(inside, (-1, n, len(LEVELS)))
    return ConditionResult(
        labels,
        tuple(driven_seeds),
        tables[0],
        np.array(best),
        tables[1],
        shares,
        tables[2],
        left_out,
    )


def run_with_bound(env: Any, seed: int) -> tuple[Log, Array]:
    """An episode's record, and the least deviation at every row; RuntimeError if it ends early."""
    episode = _run_episode(env, seed)
    if episode is None:
        raise RuntimeError(f"the episode of seed {seed} ends early")
    return episode[0], _compute_bound(env.unwrapped, *episode)


def _delay_gyro(log: Log, late: float) -> Log:
    """A log whose gyro is read so many seconds after it measured; the first value until then."""
    if late == 0.0:
        return log
    fast, rows = log.record.fast.copy(), round(late / log.record.dt)
    fast[rows:, FAST.gyro], fast[:rows, FAST.gyro] = fast[:-rows, FAST.gyro], fast[0, FAST.gyro]
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


def _run_episode(env: Any, seed: int) -> tuple[Log, tuple[Vehicle, Vehicle]] | None:
    """The record of an episode with its true sideslip angle, and the car at its start and its end;
    None where it ended early."""
    base, records, times, slips = env.unwrapped, list[Record](), [], []
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


def _get_levels(scenario: Any) -> dict[str, Any]:
    """The true levels of disturbances, as options of a filter."""
    return {
        "force_sd": scenario.disturbance_force,
        "moment_sd": scenario.disturbance_moment,
    }


def _make_filters(condition: Condition, base: Any, log: Log) -> dict[str, Any]:
    facts, filters = make_filter_arguments(base) | {"slow": list(log.slow)}, {}
    for label, (name, options) in condition.all_filters.items():
        known = facts | (
            {"vehicle": base.vehicle} | _get_levels(base.scenario) if label == TRUE else {}
        )
        filters[label] = call_quietly(make_estimator, name, **known, **options)
    return filters


def _compute_bound(
    base: Any, log: Log, cars: tuple[Vehicle, Vehicle], gyro_late: float = 0.0
) -> Array:
    """The least deviation at every row; tyres that change, a gust and by how many s the gyro is
    late are known but for what no filter can know: the strength of a gust."""
    scene, passing = base.scenario, dict[str, Any]()
    if scene.tyre_change_time is not None:
        passing["change"] = VehicleChange(scene.tyre_change_time, cars[1])
    if scene.wind_force != 0.0:
        end = scene.wind_start + scene.wind_length
        passing["gust"] = Gust(
            compute_range_rms(scene, "wind_force"), scene.wind_arm, scene.wind_start, end
        )
    facts = (
        make_filter_arguments(base)
        | {"vehicle": cars[0], "latency": {"gyro": gyro_late}}
        | _get_levels(scene)
    )
    return compute_error_bound(record=log.record, **facts, **passing)
