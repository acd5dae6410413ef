"""What the seed draws of sensors, road and start: biases, a late GPS, a bank, a sliding car."""

import math
from typing import Any

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.record import FAST, PACKET

from ..helpers import FULL, LINEAR, bits, fast_rows, play

pytestmark = pytest.mark.plain

GPS = 1.0  # a packet's sensor


def drawn(changes: dict[str, Any], seed: int, sensors: str = "fusion") -> StabilityEnv:
    """An env on the noise-free full plant, reset."""
    env = StabilityEnv(sensors, scenario=FULL | changes)
    env.reset(seed=seed)
    return env


@pytest.mark.compiled
def test_the_mean_error_of_an_episode_is_the_drawn_bias() -> None:
    ranges = {"gyro_bias": (-0.01, 0.01), "accel_y_bias": (-0.3, 0.2)}
    loud = {"gyro": 0.005, "accel": 0.1}
    found = []
    for seed in range(20):
        rows = [
            fast_rows(play(drawn(changes, seed), [0.0] * 300))[:, [FAST.gyro, FAST.accel_y]]
            for changes in (ranges | {"noise": FULL["noise"] | loud}, ranges, {})
        ]
        bias = (rows[1] - rows[2])[0]  # without noise
        error = np.mean(rows[0] - rows[2], axis=0)
        assert np.all(np.abs(error - bias) < 5.0 * np.array([0.005, 0.1]) / math.sqrt(3000))
        np.testing.assert_allclose(rows[1] - rows[2], np.tile(bias, (3000, 1)), atol=1e-14)
        found.append(bias)
    gyro, accel = np.array(found).T
    assert np.all((np.abs(gyro) <= 0.01) & (accel >= -0.3) & (accel <= 0.2))
    assert gyro.min() < -0.004 < 0.004 < gyro.max()
    assert len(set(gyro)) == len(set(accel)) == 20


def test_a_drawn_bias_adds_to_that_of_the_noise() -> None:
    fixed = {"gyro_bias": 0.02, "accel_y_bias": -0.3}
    by_noise = {"noise": FULL["noise"] | fixed}
    both = drawn(fixed | by_noise, 0)
    twice = drawn({"noise": FULL["noise"] | {k: 2.0 * v for k, v in fixed.items()}}, 0)
    assert bits(play(both, [0.0] * 20)) == bits(play(twice, [0.0] * 20))


def gps_of(env: StabilityEnv) -> Any:
    """The GPS packets of the four seconds since the reset."""
    records = [env.record, *(moment.record for moment in play(env, [0.0] * 400))]
    packets = np.concatenate([record.packets for record in records])
    return packets[packets[:, PACKET.sensor] == GPS]


@pytest.mark.compiled
@pytest.mark.parametrize("delays", [(0.0,), (0.02, 0.05)])
def test_gps_packets_arrive_later_by_one_latency_and_keep_their_stamps(
    delays: tuple[float, ...],
) -> None:
    latencies = set()
    for seed in range(12):
        env = drawn({"gps_latency": (0.1, 0.3), "gps_delays": delays}, seed)
        gps = env.slow_sensors["gps"]
        packets = gps_of(env)[:18]
        assert packets[:, PACKET.captured].tolist() == [200.0 * i for i in range(18)]
        delay = [1000.0 * delays[i % len(delays)] for i in range(18)]
        (late,) = set(packets[:, PACKET.arrived] - packets[:, PACKET.captured] - delay)
        assert 100.0 <= late <= 300.0
        latencies.add(late)
        # whatever is drawn lies within what filters are designed for
        assert min(gps.delays) == pytest.approx(min(delays) + 0.1, abs=1e-12)
        assert gps.longest_delay == pytest.approx(max(delays) + 0.3, abs=1e-12)
    assert len(latencies) > 8


def test_more_packets_under_way_than_the_queue_holds_are_refused_by_the_worst_case() -> None:
    with pytest.raises(ValueError, match=r"'late': gps: .* delays up to 0.5 s .* puts 11 "):
        late = {"base": "straight", "name": "late", "gps_period": 0.05, "gps_latency": (0.0, 0.5)}
        StabilityEnv("gps", scenario=late)
    StabilityEnv("vision", scenario="coms-random").reset(seed=0)  # no GPS: nothing to be late


def test_bank_is_drawn_and_leans_to_the_drawn_side() -> None:
    banked = {"bank": (0.01, 0.05), "curve_start": -1e3, "mirror": True}
    sides, sizes = set(), set()
    for seed in range(20):
        felt = drawn(banked, seed).record.fast[0, FAST.accel_y]
        sides.add(felt > 0.0)
        sizes.add(abs(felt))
    assert sides == {False, True}
    assert 9.81 * math.sin(0.01) < min(sizes) < max(sizes) < 9.81 * math.sin(0.05)
    assert len(sizes) == 20


@pytest.mark.parametrize("plant", [LINEAR, FULL])
def test_a_car_starts_with_its_sideslip_and_yaw_rate(plant: dict[str, Any]) -> None:
    start = {"initial_beta": (0.1, 0.2), "initial_gamma": (-0.3, -0.1), "mirror": True}
    found = set()
    for seed in range(20):
        env = StabilityEnv("fusion", scenario=plant | start)
        _, info = env.reset(seed=seed)
        side = math.copysign(1.0, info["beta"])
        assert 0.1 <= side * info["beta"] <= 0.2
        assert -0.3 <= side * info["gamma"] <= -0.1  # mirrored together
        assert env.motion.v_x == 25.0 / 3.6
        found.add(side)
    assert found == {-1.0, 1.0}
    env = StabilityEnv("fusion", scenario=plant | start)
    env.reset(seed=1, options={"state": {"v_y": 0.5, "gamma": 0.0}})
    assert (env.motion.v_y, env.motion.gamma) == (0.5, 0.0)


def test_older_draws_keep_their_bits() -> None:
    """New quantities are drawn after all others: who draws them too has the same car."""
    more = {"gyro_bias": (-0.1, 0.1), "initial_beta": (0.0, 0.1), "bank": (0.0, 0.1)}
    for seed in range(5):
        cars = []
        for changes in ({}, more):
            env = StabilityEnv("fusion", scenario={"base": "random-steering"} | changes)
            env.reset(seed=seed)
            cars.append((env.vehicle, env.motion.v_x))
        assert cars[0] == cars[1]
