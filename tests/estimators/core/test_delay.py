"""The rules for late samples that are not exact, written out slowly."""

import functools
from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.linear import make_vision_model
from sideslip.envs.vehicle.parameters import COMS
from sideslip.estimators import FILTERS, make_estimator
from sideslip.estimators.core.record import N_RECENT, SNAPSHOT_INTERVAL, WINDOW
from sideslip.estimators.filters import FilterDefinition
from tests.estimators.simulation import CAMERA, FIG7, Drive, simulate

V = FIG7.speed
QUICK = Drive(duration=0.6)
Q: Any = {"q_beta": 2e-3, "q_gamma": 2e-2, "q_psi": 1e-5, "q_y_l": 1e-4}
NOISE = np.diag([2e-3, 2e-2, 1e-5, 1e-4]) * 0.001
R_CAMERA = np.diag([3.5e-3**2, 0.02**2])
UNEVEN = SlowSensor(0.033, (0.020, 0.015, 0.010, 0.025))


# Larsen's update (T. D. Larsen and others, 1998)
def gaps(x: Any, other: Any) -> Any:
    """The largest difference of a row, in standard deviations."""
    states = np.abs((x.x - other.x) / other.std).max(1)
    return np.maximum(states, np.abs(x.std / other.std - 1.0).max(1))


@pytest.mark.parametrize("options", [{}, {"camera_yaw_sd": 0.005, "steer_offset_sd": 0.002}])
@pytest.mark.parametrize("fast", [("gyro",), ("gyro", "accel_y")])
@pytest.mark.parametrize("delays", [(0.030,), (0.033,), (0.020, 0.0, 0.010, 0.031)])
def test_larsen_is_optimal_when_its_one_sample_is_here(
    fast: Any, delays: Any, options: Any, monkeypatch: Any
) -> None:
    row = FilterDefinition(
        slow=("camera",), fast=fast, gains="covariance", disturbances="forces", source=""
    )
    monkeypatch.setitem(FILTERS, "ours", row)
    sensors = {"camera": SlowSensor(0.033, delays)}
    log = simulate(QUICK, sensors, 0)
    log.record.fast[:, FAST.accel_y] = np.random.default_rng(0).normal(0.0, 0.3, 601)
    built = functools.partial(make_estimator, "ours", sensors=sensors, speed=V, **options)
    optimal, larsen = built().run(log), built(delay="larsen").run(log)
    captured, arrived = log.record.packets[:, [PACKET.captured, PACKET.arrived]].T.astype(int)
    under_way = np.zeros(601, bool)
    for c, a in zip(captured, arrived, strict=True):
        under_way[c + 1 : a] = True
    under_way[captured[-1] + 34 :] = True  # the last sample may have missed the record
    apart = gaps(larsen, optimal)
    assert under_way.sum() > 100 and (~under_way).sum() > len(captured)
    assert apart[~under_way].max() < 1e-10
    if 0.030 in delays:
        assert apart[under_way].max() > 1e-2  # in between it is another filter


# stored, constant
def held_residuals(log: Any, age: Any) -> Any:
    """uneven-delay (15): a Kalman filter that uses y - C x^-_{k - age} as if it were of now.

    age: of a packet that arrives at tick k, in ticks.
    """
    G, H = make_vision_model(COMS, V).discretise(0.001)
    gyro, camera = np.eye(1, 4, 1), np.eye(2, 4, 2)
    x, P = np.zeros(4), np.diag([0.02**2, 0.05**2, 0.05**2, 0.3**2])
    due = {int(packet[PACKET.arrived]): packet for packet in log.record.packets}
    predicted, states, stds = [], [], []
    for k, row in enumerate(log.record.fast):
        if k > 0:
            x = G @ x + H[:, :2] @ [row[FAST.steer], 0.0]
            P = G @ P @ G.T + NOISE
        predicted.append(x)
        K = P @ gyro.T / (gyro @ P @ gyro.T + 0.005**2)
        x, P = x + K @ (row[FAST.gyro] - gyro @ x), (np.eye(4) - K @ gyro) @ P
        if k in due:
            held = predicted[max(k - age(due[k]), 0)]
            eps = due[k][PACKET.value : PACKET.value + 2] - camera @ held  # (15)
            K = P @ camera.T @ np.linalg.inv(camera @ P @ camera.T + R_CAMERA)
            x, P = x + K @ eps, (np.eye(4) - K @ camera) @ P
        states.append(x)
        stds.append(np.sqrt(np.diag(P)))
    return np.array(states), np.array(stds)


@pytest.mark.plain
@pytest.mark.parametrize(
    ("age", "options"),
    [
        (lambda packet: int(packet[2] - packet[1]), {"delay": "stored"}),
        (lambda packet: 17, {"delay": "constant", "assumed_delay": 0.017}),
    ],
    ids=["stored", "constant"],
)
def test_a_sample_meets_the_prediction_of_its_capture_or_another(age: Any, options: Any) -> None:
    log = simulate(QUICK, {"camera": UNEVEN}, 3)
    filter_ = make_estimator(
        "multirate-kf", sensors=log.slow, speed=V, gains="covariance", **options, **Q
    )
    found, (x, std) = filter_.run(log), held_residuals(log, age)
    np.testing.assert_allclose(found.x, x, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.std, std, rtol=1e-8)


@pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
def test_clone_and_buffer_agree_in_both_layers() -> None:
    """The second layer's samples keep the noise they were told with."""
    sensors = {"gps": SlowSensor(0.1, (0.020, 0.070), jitter=0.060)}
    log = simulate(Drive(duration=2.0), sensors, 5)
    log.record.fast[:, FAST.accel_y] = 5.0 * log.truth["gamma"]
    clone, buffer = (
        make_estimator(
            "double-layer", sensors=sensors, speed=V, intersample="predict", delay=rule
        ).run(log)
        for rule in ("clone", "buffer")
    )
    assert clone.names[5:] == ("v_x", "v_y", "phi", "phi_rate", "d")
    assert gaps(clone, buffer).max() < 1e-9


def rows(count: int) -> Any:
    fast = np.zeros((count, FAST_WIDTH))
    fast[:, FAST.gyro] = 0.02 * np.random.default_rng(0).standard_normal(count)
    return fast


def sample(captured: int, sensor: int = 1, value: float = 0.02) -> Any:
    packet = np.zeros(PACKET_WIDTH)
    packet[: PACKET.value + 2] = sensor, captured, captured, 1.0, 0, value, value
    return packet


NO_PACKETS = np.zeros((0, PACKET_WIDTH))


def test_buffer_goes_back_as_far_as_its_window_and_no_further() -> None:
    """Every sample up to WINDOW - EVERY ticks old is used as if it had come in time."""
    sensors = {"gps": SlowSensor(0.2)}
    late = make_estimator("exact-kf", sensors=sensors, speed=V, delay="buffer")
    in_time = make_estimator("exact-kf", sensors=sensors, speed=V, delay="buffer")
    now = 3 * WINDOW + 7
    for age in (1, SNAPSHOT_INTERVAL, WINDOW // 2, WINDOW - SNAPSHOT_INTERVAL):
        late.reset()
        late.step(rows(now + 1), NO_PACKETS)
        late.update(sample(now - age))
        in_time.run(Record(rows(now + 1), sample(now - age)[None]))
        assert late.counts["refused"] == 0
        sd = np.sqrt(np.diag(in_time.P))
        assert np.abs((late.x - in_time.x) / sd).max() < 1e-10
    for age in (WINDOW, WINDOW + 1, now):
        late.reset()
        late.step(rows(now + 1), NO_PACKETS)
        before = late.x, late.P
        late.update(sample(now - age))
        assert late.counts["refused"] == 1
        np.testing.assert_array_equal(late.x, before[0])
        np.testing.assert_array_equal(late.P, before[1])


def test_buffer_refuses_what_is_older_than_a_sample_it_had_to_give_up() -> None:
    """More samples than there is room for: none is ever left out of what is told again."""
    filter_ = make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2)}, speed=V, delay="buffer")
    packets = [sample(k) for k in range(100, 100 + 2 * N_RECENT)]
    filter_.run(Record(rows(300), np.array(packets)))
    before = filter_.x
    filter_.update(sample(100 + N_RECENT - 1 - SNAPSHOT_INTERVAL))
    assert filter_.counts["refused"] == 1
    np.testing.assert_array_equal(filter_.x, before)
    filter_.update(sample(100))  # it was used; that is forgotten, but not that it was
    assert filter_.counts["refused"] == 2
    filter_.update(sample(120 + N_RECENT + SNAPSHOT_INTERVAL))
    assert filter_.counts["duplicates"] == 1
    filter_.update(sample(250))
    assert filter_.counts["refused"] == 2
    whole = make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2)}, speed=V, delay="buffer")
    whole.run(Record(rows(300), np.array([*packets, sample(250)])))
    sd = np.sqrt(np.diag(whole.P))
    assert np.abs((filter_.x - whole.x) / sd).max() < 1e-10


@pytest.mark.parametrize("rule", ["clone", "larsen", "stored"])
def test_a_sample_that_nothing_is_held_of_changes_nothing(rule: Any) -> None:
    filter_ = make_estimator("exact-kf", sensors={"camera": CAMERA}, speed=V, delay=rule)
    filter_.step(rows(1000), NO_PACKETS)
    before = filter_.x, filter_.P
    for k in (0, 33, 33 * 12):
        filter_.update(sample(k, 0))
    assert filter_.counts["refused"] == 3 and sum(filter_.counts.values()) == 3
    np.testing.assert_array_equal(filter_.x, before[0])
    np.testing.assert_array_equal(filter_.P, before[1])


def test_the_longest_delays_that_fit() -> None:
    make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2, (0.496,))}, delay="buffer")
    make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2, (0.511,))}, delay="stored")
    sensors = {"camera": SlowSensor(0.033, (0.264,))}
    make_estimator("exact-kf", sensors=sensors, delay="clone")


def test_a_row_that_is_told_again_is_not_counted_again() -> None:
    """A gyro that is silent for a while, and samples from before."""
    filter_ = make_estimator("exact-kf", sensors={"gps": SlowSensor(0.2)}, speed=V, delay="buffer")
    fast = rows(200)
    fast[150:160, FAST.gyro] = np.nan
    filter_.step(fast, NO_PACKETS)
    for k in (120, 140, 155):
        filter_.update(sample(k))
    assert filter_.counts == dict.fromkeys(filter_.counts, 0) | {"invalid": 10}
    assert np.isfinite(filter_.x).all()
