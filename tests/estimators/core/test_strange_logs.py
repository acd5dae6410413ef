"""What a log of somebody else's car has: loose contacts, another scale, rows 10 ms apart."""

import dataclasses
import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs import Log
from sideslip.envs.record import FAST
from sideslip.estimators import Estimator, make_estimator
from tests.estimators.dense import WITH_TYRES

LINEAR: dict[str, Any] = {"base": "random-steering", "small_angle": True, "tyres": "linear"}
LINEAR |= {"amplitude": 0.05, "amplitude_2": 0.04, "roll": True, "duration": 8.0}


@functools.cache
def drive() -> tuple[Any, Log]:
    env: Any = gym.make("sideslip/YawVision-v0", scenario=LINEAR)
    return env.unwrapped, rollout(env, seed=3).log


def built(name: str, log: Log, **options: Any) -> Estimator:
    slow = {"sensors": log.slow, "slow": list(log.slow), "dt": log.record.dt}
    return make_estimator(name, vehicle=drive()[0].nominal, **slow, **options)


def with_steer(log: Log, rows: Any, angle: float) -> Log:
    fast = log.record.fast.copy()
    fast[rows, FAST.steer] = angle
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


def test_a_steering_angle_that_the_next_row_does_not_confirm_is_skipped() -> None:
    """As if the last good angle had lasted until the second row after it, and counted."""
    _, log = drive()
    before = log.record.fast[2999, FAST.steer]
    hit, lasted = with_steer(log, 3000, 0.3), with_steer(log, [3000, 3001], before)
    filters = [built("joint", log) for _ in range(2)]
    ours, wanted = (filter_.run(each) for filter_, each in zip(filters, (hit, lasted), strict=True))
    assert np.array_equal(ours.x, wanted.x)
    assert [filter_.counts["invalid"] for filter_ in filters] == [2, 0]
    believed = built("joint", log, steer_rate=0.0).run(hit)
    assert np.abs(believed.x - wanted.x)[3000:3010, :2].max() > 1e-4


def test_a_step_of_the_steering_comes_a_row_late() -> None:
    _, log = drive()
    before = log.record.fast[2999, FAST.steer]
    step, later = with_steer(log, slice(3000, None), 0.1), with_steer(log, slice(3001, None), 0.1)
    later = with_steer(later, 3000, before)
    ours = built("joint", log).run(step)
    wanted = built("joint", log, steer_rate=0.0).run(later)
    assert np.array_equal(ours.x, wanted.x)


@pytest.mark.parametrize("wrong", [-0.06, 0.08])
def test_the_scale_of_the_accelerometer_is_found(wrong: float) -> None:
    _, log = drive()
    fast = log.record.fast.copy()
    fast[:, FAST.accel_y] *= 1.0 + wrong
    log = dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))
    known = {"fast": ["gyro", "accel_y"], "accel_bias_sd": 0.05}
    run = built("exact-kf", log, **WITH_TYRES, accel_scale_sd=0.1, **known).run(log)
    found, sd = (each[-1, run.names.index("accel_scale")] for each in (run.x, run.std))
    assert abs(found - wrong) < 3.0 * sd and sd < 0.02
    plain = built("exact-kf", log, **WITH_TYRES, **known).run(log)
    errors = [np.std((each["beta"] - log.truth["beta"])[2000:]) for each in (run, plain)]
    assert errors[0] < 0.9 * errors[1]


def test_tyres_are_expanded_every_row_of_a_slow_log() -> None:
    """Every 4 ms, or every row where rows are further apart."""
    _, log = drive()
    assert built("exact-kf", log, **WITH_TYRES).filters[0].linearise_every == 4
    facts = {"vehicle": drive()[0].nominal, "sensors": {}, "slow": []}
    assert make_estimator("joint", dt=0.01, **facts).filters[0].linearise_every == 1
