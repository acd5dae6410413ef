"""Sensors that contradict: refused, counted, believed again; the deviation stays honest."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs import Log
from sideslip.envs.record import PACKET, Array
from sideslip.envs.sensors.slow import SLOW_NAMES
from sideslip.estimators import Estimator, make_estimator
from tests.estimators.core.test_tyres import LINEAR
from tests.estimators.dense import WITH_TYRES

FROM, TO = 4000, 7000  # ticks between which a sensor fails
VALUE, CAPTURED, ARRIVED = PACKET.value, PACKET.captured, PACKET.arrived
CAMERA, GPS = map(SLOW_NAMES.index, ("camera", "gps"))
IDS = {"camera": "YawVision", "gps": "YawGps", "camera gps": "YawFusion"}


@functools.cache
def drives(sensors: str, count: int = 4) -> tuple[Any, list[Log]]:
    env: Any = gym.make(f"sideslip/{IDS[sensors]}-v0", scenario=LINEAR)
    return env.unwrapped, [rollout(env, seed=seed).log for seed in range(count)]


def built(base: Any, log: Log, **options: Any) -> Estimator:
    held = {"vehicle": base.nominal, "sensors": log.slow, "speed": base.held_speed}
    return make_estimator("exact-kf", **held, slow=list(log.slow), **WITH_TYRES | options)


def with_packets(log: Log, packets: Array) -> Log:
    return dataclasses.replace(log, record=dataclasses.replace(log.record, packets=packets))


def spoilt(log: Log, spoil: Callable[[Array], None], sensor: int, end: int = TO) -> Log:
    """The log with some packets (count, PACKET_WIDTH) of a sensor changed."""
    packets = log.record.packets.copy()
    captured = packets[:, CAPTURED]
    mine = (packets[:, PACKET.sensor] == sensor) & (captured >= FROM) & (captured < end)
    chosen = packets[mine]
    spoil(chosen)
    packets[mine] = chosen
    return with_packets(log, packets)


def lose(packets: Array) -> None:
    packets[:, PACKET.quality] = 0.0


def stick(packets: Array) -> None:
    packets[:, VALUE:] = packets[0, VALUE:]


def turn(packets: Array) -> None:
    packets[:, VALUE] += np.pi


def turn_now_and_then(packets: Array) -> None:
    packets[packets[:, CAPTURED] // 700 % 2 == 0, VALUE] += np.pi


def change_lane(packets: Array) -> None:
    packets[:, VALUE + 1] += 3.5


def stick_with_noise(packets: Array) -> None:
    stick(packets)
    rng = np.random.default_rng(0)
    packets[:, VALUE : VALUE + 2] += (0.0035, 0.02) * rng.standard_normal((len(packets), 2))


def lie(packets: Array) -> None:
    packets[:, VALUE : VALUE + 2] = np.random.default_rng(0).uniform(-3.0, 3.0, (len(packets), 2))


def scored(
    sensors: str, spoil: Callable[[Array], None], sensor: int, end: int = TO, **options: Any
) -> tuple[Array, dict[str, int]]:
    """Mean NEES of beta while and after a sensor fails, and what was skipped, over some seeds."""
    base, logs = drives(sensors)
    nees, counts = [], dict[str, int]()
    for log in logs:
        filter_ = built(base, log, **options)
        run = filter_.run(spoilt(log, spoil, sensor, end))
        squares = ((run["beta"] - log.truth["beta"]) / run.std[:, 0]) ** 2
        nees.append((squares[FROM:TO].mean(), squares[TO:].mean()))
        for name, count in filter_.counts.items():
            counts[name] = counts.get(name, 0) + count
    return np.mean(nees, axis=0), {name: count for name, count in counts.items() if count}


@pytest.mark.parametrize("sensors", IDS)
def test_good_sensors_are_believed(sensors: str) -> None:
    base, logs = drives(sensors)
    for log in logs:
        wary, trusting = built(base, log), built(base, log, wary=0)
        np.testing.assert_array_equal(wary.run(log).x, trusting.run(log).x)
        assert not any(wary.counts.values())


@pytest.mark.parametrize(
    ("sensors", "spoil", "sensor", "reason"),
    [
        ("camera", stick, CAMERA, "stuck"),
        ("camera", stick_with_noise, CAMERA, "gated"),
        ("camera", lie, CAMERA, "gated"),
        ("camera", change_lane, CAMERA, "gated"),
        ("camera gps", stick, CAMERA, "stuck"),
        ("gps", turn, GPS, "gated"),
        ("gps", lie, GPS, "gated"),
        ("gps", turn_now_and_then, GPS, "gated"),
        ("camera gps", turn, GPS, "gated"),
        ("camera gps", turn_now_and_then, GPS, "gated"),
    ],
)
def test_a_sensor_that_fails_is_refused_and_the_deviation_stays_honest(
    sensors: str, spoil: Callable[[Array], None], sensor: int, reason: str
) -> None:
    """As honest as if it had sent nothing."""
    nees, counts = scored(sensors, spoil, sensor)
    assert (nees < 1.4 * scored(sensors, lose, sensor)[0]).all()
    assert set(counts) == {reason} and counts[reason] >= 4 * 8
    assert scored(sensors, spoil, sensor, wary=0)[0].max() > 30.0


def test_what_jumped_for_good_is_believed_after_ten_and_another_sensor_can_forbid_it() -> None:
    """Ten alone; beside a camera, which measures the heading too, none as long as it lasts."""
    base, logs = drives("gps")
    nees, counts = scored("gps", turn, GPS, end=10**9)
    assert (nees < 1.5).all() and counts == {"gated": 9 * len(logs)}
    base, logs = drives("camera gps")
    filter_ = built(base, logs[0])
    found = filter_.run(spoilt(logs[0], turn, GPS))
    of_gps = logs[0].record.packets[logs[0].record.packets[:, PACKET.sensor] == GPS]
    wrong = (of_gps[:, CAPTURED] >= FROM) & (of_gps[:, CAPTURED] < TO)
    assert filter_.counts["gated"] == wrong.sum() > 10
    assert abs(found["psi"][-1] - logs[0].truth["psi"][-1]) < 0.05
    nees, counts = scored("camera gps", change_lane, CAMERA, end=10**9)
    assert (nees < 1.5).all() and counts == {"gated": 9 * len(logs)}  # no GPS measures the lane


@pytest.mark.parametrize("delay", ["clone", "buffer"])
def test_a_first_course_that_is_turned_is_found_out(delay: str) -> None:
    base, (log, *_) = drives("gps")
    packets = log.record.packets.copy()
    packets[:3, VALUE] += np.pi
    filter_ = built(base, log, delay=delay)
    run = filter_.run(with_packets(log, packets))
    assert filter_.counts["gated"] == 9
    assert abs(run["psi"][-1] - log.truth["psi"][-1]) < 0.05
    errors = (run["beta"] - log.truth["beta"])[4000:] / run.std[4000:, 0]
    assert np.mean(errors**2) < 2.0


@pytest.mark.parametrize(
    ("shift", "reason"), [(-200, "refused"), (-3, "unknown"), (200, "unknown"), (777, "unknown")]
)
def test_stamps_that_jump_are_counted_and_the_samples_do_no_harm(shift: int, reason: str) -> None:
    def jump(packets: Array) -> None:
        packets[:, CAPTURED] += shift

    nees, counts = scored("gps", jump, GPS)
    assert (nees < 1.5).all() and counts[reason] >= 4 * 10
    assert set(counts) <= {reason, "duplicates"}


def test_a_receiver_whose_rounded_course_repeats_is_not_stuck() -> None:
    """It sends a position as well; a packet with one number alone may repeat it."""
    base, (log, *_) = drives("gps")
    packets = log.record.packets.copy()
    filter_ = built(base, log)
    for columns, value, stuck in (
        (VALUE, 0.0, 0),
        (slice(VALUE + 1, None), np.nan, 0),
        (VALUE + 1, 5.0, len(packets) - 1),
    ):
        packets[:, columns] = value
        filter_.run(with_packets(log, packets))
        assert filter_.counts["stuck"] == stuck
