"""BatchEstimator: every row has the bits of the filter that works alone."""

import copy
import dataclasses
import pickle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, Log, SlowSensor
from sideslip.envs.record import FAST, PACKET, PACKET_WIDTH
from sideslip.estimators import FILTERS, make_estimator
from sideslip.estimators.vector.batch import BatchedRecords, BatchEstimator
from sideslip.estimators.wrappers.estimate import EstimatorSpec
from tests.estimators.simulation import CAMERA, FIG7, GPS, KMH, simulate
from tests.estimators.vector.fleets import covariances, make_batch, states, step

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

JITTERY = SlowSensor(period=0.033, delays=(0.010,), jitter=0.020)
SPEED = 25.0 * KMH


def drives(count: int, sensor: str, clock: SlowSensor, seconds: float = 0.5) -> list[Log]:
    """Drives whose sensor has the same clock, of another phase each."""
    drive = dataclasses.replace(FIG7, duration=seconds)
    clocks = [dataclasses.replace(clock, phase=0.003 * i) for i in range(count)]
    logs = [simulate(drive, {sensor: each}, seed) for seed, each in enumerate(clocks)]
    for seed, log in enumerate(logs):  # the linear car has neither
        for column in (FAST.accel_y, FAST.roll_rate):
            log.record.fast[:, column] = np.random.default_rng(seed).normal(size=len(log.time))
    return logs


def feed(batch: BatchEstimator, logs: list[Log], n: int, first: int = 0, last: int = 10**9) -> None:
    """Let the batch take the logs' ticks from `first` to before `last` in steps of n ticks."""
    end = min(last, len(logs[0].record.fast))
    for k in range(first, end, n):
        rows = [record.fast[k : min(k + n, end)] for record in (log.record for log in logs)]
        came = []
        for log in logs:
            arrived = log.record.packets[:, PACKET.arrived]
            came.append(log.record.packets[(arrived >= k) & (arrived < k + len(rows[0]))])
        packets = np.full((len(logs), max(map(len, came)), PACKET_WIDTH), np.nan)
        for i, each in enumerate(came):
            packets[i, : len(each)] = each
        step(batch, np.array(rows), packets, [len(each) for each in came])


def home(name: str) -> tuple[str, SlowSensor]:
    """A slow sensor that a filter can use."""
    slow = FILTERS[name].slow
    return ("gps", GPS) if slow and "camera" not in slow else ("camera", CAMERA)


def same_bits(batch: BatchEstimator, singles: list[Any]) -> None:
    np.testing.assert_array_equal(states(batch), [each.x for each in singles], strict=True)
    np.testing.assert_array_equal(covariances(batch), [each.P for each in singles], strict=True)
    assert [each.counts for each in batch] == [each.counts for each in singles]


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("speed", [SPEED, None])
def test_every_row_is_the_filter_alone(name: Any, speed: Any) -> None:
    """Own phases, own noise, own car; gains that are missing are made on the way."""
    logs = drives(3, *home(name))
    cars = [COMS, COMS.scale_stiffness(0.9), COMS]
    told = [log.slow for log in logs]
    batch = make_batch(name, 3, vehicle=cars, sensors=told, speed=speed)
    singles = [
        make_estimator(name, vehicle=car, sensors=slow, speed=speed)
        for car, slow in zip(cars, told, strict=True)
    ]
    feed(batch, logs, 33)
    found = [single.run(log) for single, log in zip(singles, logs, strict=True)]
    same_bits(batch, singles)
    assert len(np.unique(states(batch)[:, 0])) == 3
    for i, other in enumerate(found):
        one = batch[i].run(logs[i])
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.std, other.std)


def test_a_row_that_is_told_something_new_is_the_filter_for_that() -> None:
    """Of other delays and gains of another shape, while the others keep what they know."""
    logs = drives(2, "camera", CAMERA, 0.3)
    uneven = dataclasses.replace(CAMERA, delays=(0.020, 0.015, 0.010, 0.025))
    later = simulate(dataclasses.replace(FIG7, duration=0.3), {"camera": uneven}, 9)
    batch = make_batch("multirate-kf", 2, sensors=[log.slow for log in logs], speed=SPEED)
    feed(batch, logs, 10, 0, 150)
    batch.configure([1], [EstimatorSpec(COMS, later.slow, SPEED)])
    batch.reset(np.array([False, True]))
    fast, packets = later.record.fast[:100], later.record.packets
    for k in range(0, 100, 10):
        came = packets[(packets[:, PACKET.arrived] >= k) & (packets[:, PACKET.arrived] < k + 10)]
        empty = np.zeros((2, len(came), PACKET_WIDTH))
        empty[1] = came
        step(batch, np.array([fast[k : k + 10]] * 2), empty, [0, len(came)], [0, 10])
    alone = make_estimator("multirate-kf", sensors=later.slow, speed=SPEED)
    alone.step(fast, packets[packets[:, PACKET.arrived] < 100])
    kept = make_estimator("multirate-kf", sensors=logs[0].slow, speed=SPEED)
    arrived = logs[0].record.packets[:, PACKET.arrived]
    kept.step(logs[0].record.fast[:150], logs[0].record.packets[arrived < 150])
    same_bits(batch, [kept, alone])


def test_snapshots_and_copies_continue_bit_for_bit() -> None:
    logs = drives(3, "camera", JITTERY, 0.4)
    batch = make_batch("exact-kf", 3, sensors=[log.slow for log in logs])
    feed(batch, logs, 10, 0, 200)
    snapshot, twin = batch.get_state(), copy.deepcopy(batch)
    thawed = pickle.loads(pickle.dumps(batch))
    feed(batch, logs, 10, 200)
    once = states(batch), covariances(batch)
    batch.set_state(snapshot)
    for each in (batch, twin, thawed):
        feed(each, logs, 10, 200)
        np.testing.assert_array_equal(states(each), once[0])
        np.testing.assert_array_equal(covariances(each), once[1])


def test_an_env_without_a_scenario_tells_its_car_as_it_is() -> None:
    facts: Any = {"nominal": [COMS] * 2, "slow_sensors": [{}] * 2, "held_speed": [5.0] * 2}
    fleet = SimpleNamespace(layout=(), dt=0.001, **facts)
    assert [spec.vehicle for spec in BatchedRecords(fleet).make_specs([0, 1])] == [COMS] * 2
    named = BatchedRecords(SimpleNamespace(**vars(fleet), scenario=["rainy", "dry"]))
    assert named.make_specs([1])[0].vehicle == COMS
