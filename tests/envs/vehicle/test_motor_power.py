"""A motor's power: what it gives at a speed, driving and braking, alone and shared."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.tick import compute_motor_torques
from sideslip.envs.record import FAST
from sideslip.envs.scenarios.driver import SpeedProfile
from sideslip.envs.ticks import FOREVER
from sideslip.envs.vehicle.actuators import compute_torque_limit, compute_yaw_moment

from ..helpers import FULL, play

pytestmark = pytest.mark.plain

WEAK = COMS.replace(motor_power=2000.0)
CAR, FREE = make_car(WEAK), make_car(COMS)
HOLD = SpeedProfile(speed=7.0, hold=1.0, acceleration=0.0, start=0.0, end=FOREVER, k_p=2.0, k_i=0.5)
speeds, either = st.floats(-40.0, 40.0), st.sampled_from([0.0, 1.0])


@given(speeds, st.floats(-1e3, 1e3), st.floats(-20.0, 20.0), either, either)
def test_no_wheel_takes_or_gives_more_than_its_power(
    v: float, N_z: float, asked: float, hold: float, yaw_first: float
) -> None:
    """P = T omega, omega = v / r, whatever moment and acceleration are asked for."""
    pace = HOLD._replace(speed=v + asked, hold=hold, acceleration=asked * (1.0 - hold))
    T_l, T_r, _, _ = compute_motor_torques(N_z, 0.0, v, 0.0, pace, CAR, yaw_first)
    for torque in (T_l, T_r):
        assert abs(torque * v / WEAK.wheel_radius) <= 2000.0 * (1.0 + 1e-14)  # roundings
        assert abs(torque) <= WEAK.motor_torque * (1.0 + 1e-14)
    if abs(v) > 0.5:
        most = 2000.0 * WEAK.rear_track / abs(v)
        assert abs(compute_yaw_moment(T_l, T_r, CAR)) <= most * (1.0 + 1e-14)


@given(speeds)
def test_up_to_P_over_T_max_the_torque_is_what_limits(v: float) -> None:
    corner = 2000.0 / 100.0 * 0.22  # m/s
    expected = 100.0 if abs(v) <= corner else 2000.0 * 0.22 / abs(v)
    assert compute_torque_limit(v, CAR) == pytest.approx(expected, rel=1e-15)
    assert compute_torque_limit(v, FREE) == 100.0  # 0: no limit, bit for bit


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_env_delivers_no_more_moment_than_the_power_allows(sign: float) -> None:
    power: dict[str, Any] = {"vehicle": {"motor_power": 2000.0}, "steering": "straight"}
    env = StabilityEnv(scenario=FULL | power, control_period=1)
    env.reset(seed=0)
    assert env.vehicle.motor_power == 2000.0
    moments = play(env, [sign] * 100)
    for moment in moments[1:]:
        row = moment.record.fast[0]
        v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])  # noise-free, a tick later
        most = 2000.0 * COMS.rear_track / v
        assert sign * moment.info["yaw_moment"] == pytest.approx(most, rel=1e-3)
        assert most < 0.8 * COMS.yaw_moment_limit


def test_braking_is_limited_too() -> None:
    """Both motors brake with 2 kW: the car loses at most 2 P / m v a second."""
    power = {"vehicle": {"motor_power": 2000.0}, "acceleration": -5.0, "speed": 8.0}
    env = StabilityEnv(scenario=FULL | power, control_period=10)
    env.reset(seed=0)
    before = env.motion.v_x
    play(env, [0.0])
    fall = (before - env.motion.v_x) / 0.01
    assert fall == pytest.approx(2.0 * 2000.0 / (COMS.mass * 8.0), rel=2e-3)
