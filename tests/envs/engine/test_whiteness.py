"""Noise is fresh at every tick of an episode, not at every tick of an env-step alone.

The same seed without noise gives the same drive, so the difference is the noise. It is white over
many env-steps: at lags within a step, of one step and of several. Noise that starts anew with every
step would be as large and as normal, but it would repeat itself with the control period.
"""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from sideslip.envs import COMS, StabilityEnv
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.numerics.simd import LANES
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.inertial import Noise
from sideslip.envs.sensors.slow import CAMERA, GPS
from sideslip.envs.vehicle.linear import LinearModel, make_bicycle_model

from ..batches import batch
from ..helpers import LINEAR, fast_rows, packets, play

NOISE = Noise()
FAST_SIZES = {
    FAST.gyro: NOISE.gyro, FAST.accel_y: NOISE.accel, FAST.accel_x: NOISE.accel,
    FAST.roll_rate: NOISE.roll_rate, FAST.wheel_left: NOISE.wheel, FAST.wheel_right: NOISE.wheel,
}  # fmt: skip
SPEED = 25.0 / 3.6  # m/s
SLOW_SIZES = {
    CAMERA: [NOISE.camera_psi, NOISE.camera_y],
    GPS: [NOISE.course / SPEED, NOISE.gps_speed, NOISE.gps_position, NOISE.gps_position],
}
ROUTE = [PACKET.captured, PACKET.arrived]
STRAIGHT = LINEAR | {"duration": 1e3, "hdop_law": "constant"}
NOISY = STRAIGHT | {"noise": {}}


def assert_white(x: np.ndarray, lags: range) -> None:
    """x: (samples, columns), each to be standard normal and independent of all others."""
    N = len(x)
    for column in x.T:
        assert stats.kstest(column, "norm").pvalue > 1e-5  # fixed seeds: passed once and for all
    for lag in lags:
        again = np.mean(x[lag:] * x[:-lag], axis=0)
        assert np.abs(again).max() < 6.0 / np.sqrt(N - lag), lag  # standard errors
    mixed = np.corrcoef(x.T) - np.eye(x.shape[1])
    assert np.abs(mixed).max() < 6.0 / np.sqrt(N)


def fast_noise(noisy: np.ndarray, silent: np.ndarray) -> np.ndarray:
    """(ticks, noisy fast sensors) in units of each one's standard deviation."""
    return np.asarray((noisy - silent)[:, list(FAST_SIZES)] / list(FAST_SIZES.values()))


def driven(steps: int, n: int, scenario: dict[str, Any], **slow: Any) -> tuple[Any, Any]:
    """(fast rows, packets) of env-steps of n ticks; the slow sensors sample every 10 ms."""
    each = {"period": 0.01, "delays": [0.0]} | slow
    env = StabilityEnv("fusion", scenario=scenario, control_period=n, camera=each, gps=each)
    env.reset(seed=11)
    moments = play(env, [0.0] * steps)
    return fast_rows(moments), packets(moments)


@pytest.mark.parametrize("n", [1, 10, 33])
def test_the_fast_sensors_noise_is_white_across_env_steps(n: int) -> None:
    noisy, silent = (driven(4000 // n, n, scenario)[0] for scenario in (NOISY, STRAIGHT))
    assert_white(fast_noise(noisy, silent), range(1, 4 * n + 1))


@pytest.mark.parametrize("n", [10, 33])
@pytest.mark.parametrize("sensor", SLOW_SIZES)
def test_the_slow_sensors_noise_is_white_across_env_steps(sensor: int, n: int) -> None:
    sizes = SLOW_SIZES[sensor]
    values = slice(PACKET.value, PACKET.value + len(sizes))
    noisy, silent = (driven(20_000 // n, n, scenario)[1] for scenario in (NOISY, STRAIGHT))
    mine = noisy[:, PACKET.sensor] == sensor
    assert_white((noisy - silent)[mine, values] / sizes, range(1, 41))


@pytest.mark.parametrize("n", [10, 33])
def test_the_satellites_wander_by_fresh_numbers(n: int) -> None:
    """The innovations of log HDOP, an Ornstein-Uhlenbeck process sampled every 10 ms."""
    keep = np.exp(-0.01 / 0.05)
    sky = STRAIGHT | {"hdop": 1.4, "hdop_spread": 0.2, "hdop_time": 0.05}
    found = driven(20_000 // n, n, sky)[1]
    logs = np.log(found[found[:, PACKET.sensor] == GPS, PACKET.value + 4] / 1.4) / 0.2
    fresh = (logs[1:] - keep * logs[:-1]) / np.sqrt(1.0 - keep**2)
    assert_white(fresh[:, None], range(1, 41))


def test_links_lose_delay_and_double_by_fresh_numbers() -> None:
    found = driven(4000, 10, STRAIGHT, loss=0.3, jitter=0.003, duplicate=0.3)[1]
    for sensor in SLOW_SIZES:
        captured, arrived = found[found[:, PACKET.sensor] == sensor][:, ROUTE].T
        frames, copies = np.unique(captured, return_counts=True)
        first = np.full(len(frames), np.inf)
        np.minimum.at(first, np.searchsorted(frames, captured), arrived)
        came = np.isin(np.arange(0.0, frames[-1], 10.0), frames)
        for x, mean in ((came, 0.7), (copies, 1.3), (first - frames, 1.5)):
            y = (x - mean) / np.std(x)
            assert abs(y.mean()) < 5.0 / np.sqrt(len(y))
            for lag in range(1, 41):
                assert abs(np.mean(y[lag:] * y[:-lag])) < 5.0 / np.sqrt(len(y) - lag)


@pytest.mark.parametrize("n", [1, 10])
def test_force_and_moment_are_driven_by_fresh_numbers(n: int) -> None:
    """What acts on a linear car is read from how it moves: x+ = G x + H (F_d, N_d) at each tick."""
    levels = np.array([50.0, 20.0])  # N, N m
    pushed = {"disturbance_force": levels[0], "disturbance_moment": levels[1]}
    rows = driven(4000 // n, n, STRAIGHT | pushed | {"disturbance_time": 0.05})[0]
    gamma, a_y = rows[:, FAST.gyro], rows[:, FAST.accel_y]
    turn = 0.5 * SPEED * (gamma[1:] + gamma[:-1])
    v_y = np.cumsum(TICK * (a_y[1:] - turn))  # but for where it starts, which decays
    x = np.stack([v_y / SPEED, gamma[1:]])
    model = make_bicycle_model(COMS, SPEED)
    push = np.diag([1.0 / (COMS.mass * SPEED), 1.0 / COMS.yaw_inertia])
    G, H = LinearModel(model.A, push, np.eye(2), model.states, (), ()).discretise(TICK)
    acting = np.linalg.solve(H, x[:, 1:] - G @ x[:, :-1])[:, 1000:] / levels[:, None]
    keep = np.exp(-TICK / 0.05)
    fresh = (acting[:, 1:] - keep * acting[:, :-1]) / np.sqrt(1.0 - keep**2)
    assert_white(fresh.T, range(1, 4 * n + 1))


@pytest.mark.parametrize("count", [2, LANES + 5])
def test_rows_of_a_batch_have_white_noise_of_their_own(count: int) -> None:
    """One by one and in lanes; no row's noise is another's, at this or at another env-step."""
    fast, slow = zip(*(driven_rows(count, 200, scene) for scene in (NOISY, STRAIGHT)), strict=True)
    columns = [fast_noise(*each) for each in zip(*fast, strict=True)]
    assert_white(np.concatenate(columns, axis=1), range(1, 41))
    columns = []
    for noisy, silent in zip(*slow, strict=True):
        for sensor, sizes in SLOW_SIZES.items():
            mine = noisy[:, PACKET.sensor] == sensor
            values = slice(PACKET.value, PACKET.value + len(sizes))
            columns.append((noisy - silent)[mine, values] / sizes)
    assert_white(np.concatenate(columns, axis=1), range(1, 41))


def driven_rows(count: int, steps: int, scenario: dict[str, Any]) -> tuple[Any, Any]:
    """(fast rows, packets) of each row of a batch; a step of 10 ms is a slow sensor's period."""
    each = {"period": 0.01, "delays": [0.0]}
    env = batch("sideslip/YawFusion-v0", count, scenario=scenario, camera=each, gps=each)
    env.reset(seed=11)
    fast: list[list[np.ndarray]] = [[] for _ in range(count)]
    slow: list[list[np.ndarray]] = [[] for _ in range(count)]
    for _ in range(steps):
        env.step(np.zeros((count, 1), np.float32))
        for i, record in enumerate(env.record):
            fast[i].append(record.fast.copy())
            slow[i].append(record.packets.copy())
    return [np.concatenate(parts) for parts in fast], [np.concatenate(parts) for parts in slow]
