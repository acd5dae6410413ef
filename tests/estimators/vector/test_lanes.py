"""Filters in lanes have the bits of each alone, whatever happens to their neighbours."""

import copy
import dataclasses
import pickle
from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS
from sideslip.envs.numerics.simd import LANES
from sideslip.envs.record import FAST, PACKET_WIDTH
from sideslip.estimators import FILTERS, make_estimator
from sideslip.estimators.core.late_samples import RULES
from sideslip.estimators.core.memory import FILTER, N_CORE, N_TOTAL
from sideslip.estimators.vector.batch import BLOCK, _read_shape
from sideslip.estimators.vector.lanes import MIN_LANES
from tests.estimators.dense import WITH_TYRES
from tests.estimators.simulation import CAMERA, GPS
from tests.estimators.vector.fleets import make_batch, states, step
from tests.estimators.vector.test_batch import drives, feed, home, same_bits

pytestmark = [
    pytest.mark.compiled,
    pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning"),
]
COUNT = 19  # whole blocks, and three filters that are alone
LOOKED_AT = (0, 1, 2, 4, 18)


def troubled(name: str) -> list[Any]:
    """Drives of which some speed up, or lose a row, or have numbers beyond all measure."""
    logs = drives(COUNT, *home(name), seconds=0.3)
    for i, log in enumerate(logs):
        fast = log.record.fast
        gain = 1.0 + 0.01 * i * np.linspace(0, 1, len(fast))
        fast[:, [FAST.wheel_left, FAST.wheel_right]] *= gain[:, None]
        fast[50 + i, FAST.gyro] = np.nan if i % 3 == 0 else fast[50 + i, FAST.gyro]
        fast[120, FAST.steer] = np.inf if i % 5 == 1 else fast[120, FAST.steer]
        fast[140, FAST.wheel_left] = np.nan if i % 7 == 2 else fast[140, FAST.wheel_left]
    for tick, size in ((60, 9e14), (61, -9e14), (62, 9e14)):  # residuals that are none
        logs[4].record.fast[tick, [FAST.gyro, FAST.accel_y]] = size
    return logs


def same_as_alone(
    name: str, n: int, speed: float | None, logs: list[Any] | None = None, **options: Any
) -> None:
    logs = troubled(name) if logs is None else logs
    cars = [COMS.scale_stiffness(1.0 - 0.1 * (i % 2)) for i in range(COUNT)]
    told = [log.slow for log in logs]
    batch = make_batch(name, COUNT, vehicle=cars, sensors=told, speed=speed, **options)
    feed(batch, logs, n)
    for i in LOOKED_AT:
        alone = make_estimator(name, vehicle=cars[i], sensors=told[i], speed=speed, **options)
        alone.run(logs[i])
        np.testing.assert_array_equal(batch[i].x, alone.x, strict=True)
        np.testing.assert_array_equal(batch[i].P, alone.P, strict=True)
        assert batch[i].counts == alone.counts


INERTIAL = ["gyro", "accel_y"]
OPTIONS: list[dict[str, Any]] = [
    {"gains": "covariance", "bias_sd": 0.01, "fast": INERTIAL},
    {"camera_yaw_sd": 0.005, "steer_offset_sd": 0.002, "fast": INERTIAL},
    {"gains": "covariance", "robust": 2.0},
    {"delay": "stored", "gains": "covariance"},
    {"delay": "buffer"},
]
CASES = [
    *((name, 10, None, {}) for name in FILTERS),
    *((name, 1, None, {}) for name in ("exact-kf", "multirate-kf", "uneven-delay-kf")),
    *((name, 64, 7.0, {}) for name in ("exact-kf", "multirate-kf", "uneven-delay-kf")),
    *(("exact-kf", 10, 7.0, options) for options in OPTIONS),
]


@pytest.mark.parametrize(("name", "n", "speed", "options"), CASES)
def test_every_lane_is_the_filter_alone(name: Any, n: int, speed: Any, options: Any) -> None:
    """Own phases, cars, speeds and troubles; gains that are missing are made on the way."""
    same_as_alone(name, n, speed, **options)


def test_a_capture_is_of_its_own_tick() -> None:
    """A car so much faster that its model is another in most ticks, or by some captures alone."""
    clock = dataclasses.replace(GPS, delays=(0.03,))
    logs = drives(COUNT, "gps", clock, seconds=0.6)
    for i, log in enumerate(logs):
        fast = log.record.fast
        fast[:, FAST.curvature] = np.random.default_rng(i).normal(0.02, 0.02, len(fast))
        gain = 1.0 + 0.2 * i * np.linspace(0, 1, len(fast))
        fast[:, [FAST.wheel_left, FAST.wheel_right]] *= gain[:, None]
    same_as_alone("exact-kf", 10, None, logs, slow=["gps"], gains="covariance")


def test_rows_that_stand_still_or_begin_anew_leave_their_block_alone() -> None:
    logs = drives(COUNT, *home("exact-kf"), seconds=0.1)
    told = [log.slow for log in logs]
    batch = make_batch("exact-kf", COUNT, sensors=told, speed=7.0)
    other = [make_estimator("exact-kf", sensors=slow, speed=7.0) for slow in told]
    none = np.zeros((0, PACKET_WIDTH))
    for k in range(0, 100, 10):
        rows = [(i + k // 10) % 3 * 5 for i in range(COUNT)]  # 0, 5 or 10 of them
        fast = np.array([log.record.fast[k : k + 10] for log in logs])
        step(batch, fast, np.zeros((COUNT, 0, PACKET_WIDTH)), rows=rows)
        for i, each in enumerate(other):
            each.step(fast[i, : rows[i]], none)
        if k == 50:
            batch.reset(np.arange(COUNT) == 7)
            other[7].reset()
    same_bits(batch, other)


def test_a_snapshot_of_another_speed_brings_its_model_along() -> None:
    """A lane's model is not that of before, though nobody told the block."""
    logs = drives(COUNT, *home("exact-kf"), seconds=0.2)
    for i, log in enumerate(logs):
        log.record.fast[:, [FAST.wheel_left, FAST.wheel_right]] += (
            0.02 * i * np.arange(len(log.record.fast))[:, None]
        )
    batch = make_batch("exact-kf", COUNT, sensors=[log.slow for log in logs])
    feed(batch, logs, 10, last=60)
    snapshot = batch.get_state()
    feed(batch, logs, 10, first=60)
    once = states(batch)
    batch.set_state(snapshot)
    feed(batch, logs, 10, first=60)
    np.testing.assert_array_equal(states(batch), once)


def test_which_filters_are_in_lanes() -> None:
    """All of one shape: a block of five is counted by what it has loaded."""
    cases: list[tuple[str, dict[str, Any], int]] = [
        ("exact-kf", {}, 5), ("multirate-kf", {}, 5), ("exact-kf", {"delay": "stored"}, 5),
        ("exact-kf", WITH_TYRES, 0), ("exact-kf", {"delay": "buffer"}, 0),
    ]  # fmt: skip
    for name, options, there in cases:
        logs = drives(5, *home(name), seconds=0.05)
        batch = make_batch(name, 5, sensors=[log.slow for log in logs], speed=7.0, **options)
        feed(batch, logs, 10)
        assert (batch._lanes["shaped"][0] == 1).sum() == there
        assert (batch._lanes["here"][0] == 1.0).sum() == there
    few = make_batch("exact-kf", MIN_LANES - 1, sensors={"camera": CAMERA}, speed=7.0)
    feed(few, logs[: MIN_LANES - 1], 10)
    assert (few._lanes["model_speed"] == 0.0).all()


def test_blocks_and_records_lie_on_cache_lines() -> None:
    """A copy's, too."""
    batch = make_batch("exact-kf", 3, sensors={"camera": CAMERA}, speed=7.0)
    many = make_batch("exact-kf", 33, sensors={"camera": CAMERA}, speed=7.0)._lanes
    assert len(many) == -(-33 // LANES) and many.dtype == BLOCK
    copies = [batch, copy.deepcopy(batch), pickle.loads(pickle.dumps(batch))]
    for array in (many, *(each.filters for each in copies), *(each._lanes for each in copies)):
        assert array.dtype.itemsize % 64 == 0 and array.ctypes.data % 64 == 0
    by_state = [
        name for name in FILTER.names or () if FILTER[name].shape[-1:] in ((N_CORE,), (N_TOTAL,))
    ]
    for kind, names in ((BLOCK, ["x", "P", "GT", "row"]), (FILTER, by_state)):
        assert kind.fields is not None
        assert all(kind.fields[name][1] % 64 == 0 for name in names)


def test_a_rule_that_lanes_do_not_have_is_computed_alone() -> None:
    filters = make_estimator("exact-kf", sensors={"camera": CAMERA}).filters
    assert _read_shape(filters) is not None
    filters[0].delay_rule = len(RULES)
    assert _read_shape(filters) is None
