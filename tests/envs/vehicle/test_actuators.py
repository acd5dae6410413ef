"""Torque distribution in ISO axes, and lags that are exact exponentials."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.record import FAST
from sideslip.envs.ticks import TICK
from sideslip.envs.vehicle.actuators import (
    Lag,
    allocate_torques,
    apply_lag,
    compute_yaw_moment,
    make_lag,
)
from sideslip.envs.vehicle.linear import make_bicycle_model

from ..helpers import FULL, LINEAR, fast_rows, play

pytestmark = pytest.mark.plain

CAR = make_car(COMS)
m, r, d_r, T_MAX = CAR.m, CAR.r, CAR.d_r, CAR.T_max
moments, accelerations = st.floats(-2000.0, 2000.0), st.floats(-20.0, 20.0)


def tie_vision_3(a_x: float, N_z: float) -> tuple[float, float]:
    """The law as printed; z points down there, so that a left turn has a negative N_z."""
    T_l = m * r * a_x / 2.0 + r * N_z / d_r
    T_r = m * r * a_x / 2.0 - r * N_z / d_r
    return T_l, T_r


@pytest.mark.smoke
@given(st.floats(-180.0, 180.0), st.floats(-1.1, 1.1))
def test_within_the_limits_it_is_the_papers_law(N_z: float, a_x: float) -> None:
    for yaw_first in (0.0, 1.0):
        # the same operations in another order, on numbers up to 100 N m
        expected = pytest.approx(tie_vision_3(a_x, -N_z), abs=1e-13)
        assert allocate_torques(N_z, a_x, CAR, yaw_first, CAR.T_max) == expected


def test_a_positive_moment_drives_the_right_wheel_and_turns_left() -> None:
    T_l, T_r = allocate_torques(100.0, 0.0, CAR, 1.0, CAR.T_max)
    assert T_r > 0.0 > T_l
    assert T_l == -T_r
    env = StabilityEnv(scenario=LINEAR)
    env.reset(seed=0)
    assert play(env, [1.0])[0].info["gamma"] > 0.0


@given(moments, accelerations, st.sampled_from([0.0, 1.0]))
def test_no_motor_passes_its_limit(N_z: float, a_x: float, yaw_first: float) -> None:
    for torque in allocate_torques(N_z, a_x, CAR, yaw_first, CAR.T_max):
        assert abs(torque) <= T_MAX * (1.0 + 2e-16)  # the sum of two parts rounds


@given(moments, accelerations)
def test_yaw_moment_keeps_its_share_first(N_z: float, a_x: float) -> None:
    T_l, T_r = allocate_torques(N_z, a_x, CAR, 1.0, CAR.T_max)
    most = T_MAX * d_r / r
    kept = min(max(N_z, -most), most)
    assert compute_yaw_moment(T_l, T_r, CAR) == pytest.approx(
        kept, abs=1e-12
    )  # roundings of 370 N m
    room = T_MAX - abs(kept) * r / d_r
    drive = min(max(m * r * a_x / 2.0, -room), room)
    assert 0.5 * (T_l + T_r) == pytest.approx(drive, abs=1e-13)


@given(moments, accelerations)
def test_or_acceleration_keeps_its_share(N_z: float, a_x: float) -> None:
    T_l, T_r = allocate_torques(N_z, a_x, CAR, 0.0, CAR.T_max)
    drive = min(max(m * r * a_x / 2.0, -T_MAX), T_MAX)
    assert 0.5 * (T_l + T_r) == pytest.approx(drive, abs=1e-13)
    room = (T_MAX - abs(drive)) * d_r / r
    kept = min(max(N_z, -room), room)
    assert compute_yaw_moment(T_l, T_r, CAR) == pytest.approx(kept, abs=1e-12)


@pytest.mark.parametrize(("yaw_first", "share"), [(True, 1.0), (False, 0.0)])
def test_the_env_hands_the_priority_on(yaw_first: bool, share: float) -> None:
    accelerating = LINEAR | {"acceleration": 50.0, "speed": 5.0}
    env = StabilityEnv(scenario=accelerating, yaw_first=yaw_first)
    env.reset(seed=0)
    moment = play(env, [1.0])[0]
    full = COMS.yaw_moment_limit
    assert moment.info["yaw_moment"] == pytest.approx(share * full, abs=1e-12)
    row = moment.record.fast[-1]
    left = -100.0 if yaw_first else 100.0
    assert row[[FAST.torque_left, FAST.torque_right]].tolist() == [left, 100.0]
    assert row[FAST.accel_command] == 50.0


def test_yaw_moment_limit_is_that_of_two_full_motors() -> None:
    assert COMS.yaw_moment_limit == pytest.approx(372.7, abs=0.05)  # printed to 0.1
    T_l, T_r = allocate_torques(COMS.yaw_moment_limit, 0.0, CAR, 1.0, CAR.T_max)
    assert (T_l, T_r) == pytest.approx((-100.0, 100.0), rel=1e-15)
    for vehicle in (COMS, PASSENGER_CAR):
        T_max = vehicle.motor_torque
        assert compute_yaw_moment(-T_max, T_max, make_car(vehicle)) == pytest.approx(
            vehicle.yaw_moment_limit, rel=1e-15
        )


@given(st.floats(1e-4, 10.0), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_lag_is_the_exact_exponential(tau: float, command: float, value: float) -> None:
    lag = make_lag(tau, TICK)
    error = 1e-13  # roundings of numbers up to 200
    for rest, time in ((lag.start, 0.0), (lag.middle, 0.5 * TICK), (lag.end, TICK)):
        exact = command + (value - command) * math.exp(-time / tau)
        assert apply_lag(command, value, rest) == pytest.approx(exact, abs=error)
    assert lag.mean == pytest.approx((1.0 + 4.0 * lag.middle + lag.end) / 6.0, rel=1e-15)
    # Simpson's error on exp(-t/tau) over a tick: (TICK / tau)^4 / 2880
    exact = tau / TICK * -math.expm1(-TICK / tau)
    assert abs(lag.mean - exact) <= (TICK / tau) ** 4 / 2880.0 + 1e-15 * tau / TICK


def test_no_lag_is_no_rest() -> None:
    assert make_lag(0.0, TICK) == Lag(0.0, 0.0, 0.0, 0.0)
    assert apply_lag(3.0, -7.0, 0.0) == 3.0


def applied(vehicle: Any, scenario: dict[str, Any], n: int = 40) -> np.ndarray:
    """Fast rows of n single ticks at full yaw moment from rest."""
    env = StabilityEnv(vehicle=vehicle, scenario=scenario, control_period=1)
    env.reset(seed=0)
    return fast_rows(play(env, [1.0] * n))


def test_motors_follow_the_exponential_tick_by_tick() -> None:
    tau, rows = 0.005, applied("coms", LINEAR | {"lags": True})
    for k, row in enumerate(rows):
        before, after = (math.exp(-t * TICK / tau) for t in (k, k + 1))
        mean = 100.0 * (1.0 - tau / TICK * (before - after))
        # the record holds Simpson's mean: (1 ms / 5 ms)^4 / 2880 of the deviation is its error
        assert abs(row[FAST.torque_right] - mean) < 100.0 * 5.6e-7 * before + 1e-12
        assert row[FAST.torque_left] == -row[FAST.torque_right]


def test_steering_follows_its_own_exponential() -> None:
    turning = FULL | {
        "lags": True,
        "steering": "step",
        "amplitude": 0.1,
        "onset": -1.0,  # the step is over when the episode begins ...
        "hold": 1.0,  # ... and its mirror image begins: a ramp that the actuator lags behind
    }
    rows = applied("coms", turning, 150)
    value, tau = rows[0, FAST.steer_command], 0.03
    for row in rows:
        command = row[FAST.steer_command]
        mean = command + (value - command) * tau / TICK * -math.expm1(-TICK / tau)
        # Simpson's error again, (1 ms / 30 ms)^4 / 2880 of the deviation, and roundings
        assert abs(row[FAST.steer] - mean) < 4.3e-10 * abs(value - command) + 1e-16
        value = command + (value - command) * math.exp(-TICK / tau)
    assert abs(rows[-1, FAST.steer] - rows[-1, FAST.steer_command]) > 0.01


@pytest.mark.parametrize("lags", [{"motor_lag": 0.0}, {"motor_lag": 0.0, "steering_lag": 0.0}])
def test_without_a_lag_the_torque_acts_at_once(lags: dict[str, float]) -> None:
    """Also where only the steering lags: the first tick already has the whole moment."""
    env = StabilityEnv(
        vehicle={"base": "coms", **lags}, scenario=LINEAR | {"lags": True}, control_period=1
    )
    env.reset(seed=0)
    (moment,) = play(env, [1.0])
    assert moment.record.fast[0, FAST.torque_right] == pytest.approx(100.0, rel=1e-15)
    _, H = make_bicycle_model(COMS, 25.0 / 3.6).discretise(TICK)
    exact = H[1, 1] * COMS.yaw_moment_limit
    # Kutta's error: (14 / s x 1 ms)^3 / 24 = 1.14e-7 of it; a late torque misses a sixth
    assert moment.info["gamma"] == pytest.approx(exact, rel=1.2e-7)


def test_lags_false_is_the_vehicle_without_lags() -> None:
    bare = {"base": "coms", "motor_lag": 0.0, "steering_lag": 0.0}
    one = applied("coms", FULL | {"lags": False})
    np.testing.assert_array_equal(one, applied(bare, FULL | {"lags": True}))
    assert one[0, FAST.torque_right] == pytest.approx(100.0, rel=1e-15)
