"""The table of slow sensors, and what accelerometers feel."""

import math

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.numerics.functions import CHANNELS, draw_uniforms
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.slow import (
    BLOCKS,
    SENSOR_SETS,
    SLOW,
    SLOW_NAMES,
    VALUES,
    WIDTHS,
    _make_blocks,
)
from sideslip.envs.task import make_observation_layout

from ..helpers import FULL, LINEAR, fast_rows, play

pytestmark = pytest.mark.plain


def test_no_two_uses_share_random_numbers() -> None:
    """A sensor's three blocks may be one where it makes no use of the others."""
    later = map(_make_blocks, range(len(SLOW), 20))
    of_slow = [number for own in (*BLOCKS, *later) for number in sorted(set(own))]
    of_others = [CHANNELS.inertial, CHANNELS.wheels, CHANNELS.initial, CHANNELS.scenario]
    assert len(set(of_slow + of_others)) == len(of_slow + of_others)


def test_sensors_that_were_there_keep_their_random_words() -> None:
    assert SLOW_NAMES[:2] == ("camera", "gps")
    assert [BLOCKS[0].noise, BLOCKS[0].link] == [2, 4]
    assert list(BLOCKS[1]) == [3, 5, 8]


@pytest.mark.parametrize("sensors", SENSOR_SETS)
def test_the_observation_has_each_sensors_values_in_the_order_of_the_table(sensors: str) -> None:
    present = tuple(SENSOR_SETS[sensors])
    names = [entry.name for entry in make_observation_layout(present, 10, "summary")]
    expected = [
        f"{kind.name}_{name}"
        for kind in SLOW
        if kind.name in present
        for name in (*(value.name for value in kind.values), "age", "fresh")
    ]
    first = names.index(expected[0])
    assert names[first : first + len(expected)] == expected
    assert len(names) == len(set(names))
    bounds = {entry.name: entry for entry in make_observation_layout(present, 10, "summary")}
    for kind in SLOW:
        for value in kind.values if kind.name in present else ():
            entry = bounds[f"{kind.name}_{value.name}"]
            assert (entry.unit, entry.low, entry.high) == (value.unit, -value.bound, value.bound)


def test_a_packet_is_filled_up_with_zeros() -> None:
    env = StabilityEnv("fusion", control_period=500)
    env.reset(seed=0)
    env.step([0.2])
    seen = set()
    for packet in env.record.packets:
        sensor = int(packet[PACKET.sensor])
        seen.add(sensor)
        values = packet[PACKET.value :]
        assert len(values) == VALUES
        assert np.all(values[: WIDTHS[sensor]] != 0.0)
        assert np.all(values[WIDTHS[sensor] :] == 0.0)
    assert seen == {0, 1}


def test_sensors_lose_packets_independently() -> None:
    """Each link has numbers of its own."""
    lost = [[draw_uniforms(1, 2, tick, blocks.link)[1] for tick in range(400)] for blocks in BLOCKS]
    assert abs(np.corrcoef(lost)[0, 1]) < 0.15


def test_the_roll_gyro_and_the_accelerometer_sense_the_body() -> None:
    turning = FULL | {"roll": True, "steering": "sine", "amplitude": 0.05}
    env = StabilityEnv(scenario=turning, control_period=1)
    env.reset(seed=0)
    before, most = env.motion, 0.0
    for _ in range(1500):
        (moment,) = play(env, [0.0])
        row, now = moment.record.fast[0], env.motion
        assert row[FAST.roll_rate] == now.phi_dot
        lateral = (now.v_y - before.v_y) / 1e-3 + 0.5 * (
            now.gamma * now.v_x + before.gamma * before.v_x
        )
        gravity = 9.81 * 0.5 * (now.phi + before.phi)
        assert row[FAST.accel_y] == pytest.approx(lateral + gravity, abs=1e-12)
        before, most = now, max(most, abs(gravity))
    assert most > 0.2


@pytest.mark.parametrize("small_angle", [True, False])
def test_accelerometers_on_a_slope_feel_gravity(small_angle: bool) -> None:
    """The driver holds speed and line against it: what is felt is the road's reaction."""
    slope = {"bank": 0.1, "grade": 0.05, "curve_start": -1e3, "lags": False, "friction": 5.0}
    plant = {"small_angle": small_angle, "tyres": "linear", "acceleration": 0.0}
    env = StabilityEnv(scenario=LINEAR | plant | slope | {"duration": 1.0}, strict=False)
    env.reset(seed=0)
    start = env.record.fast[0]
    assert start[FAST.accel_x] == pytest.approx(9.81 * math.sin(0.05), rel=1e-14)
    assert start[FAST.accel_y] == pytest.approx(9.81 * math.sin(0.1), rel=1e-14)
    rows = fast_rows(play(env, [0.0] * 2))
    # nobody drives: along the road the car falls freely; the tyres begin to hold it across
    np.testing.assert_allclose(rows[:, FAST.accel_x], 0.0, atol=2e-3)
    assert 0.0 < rows[-1, FAST.accel_y] < 9.81 * math.sin(0.1)
    assert env.motion.v_x < 25.0 / 3.6 - 0.019 * 9.81 * math.sin(0.05)
    assert env.motion.v_y < 0.0
