"""Torque distribution, power limit, lags, and the load that drive moves between the axles."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.tick import compute_motor_torques
from sideslip.envs.numerics.functions import FOREVER, TICK
from sideslip.envs.record import FAST
from sideslip.envs.scenarios.driver import SpeedProfile
from sideslip.envs.vehicle.actuators import (
    Lag,
    allocate_torques,
    apply_lag,
    compute_torque_limit,
    compute_yaw_moment,
    make_lag,
)
from sideslip.envs.vehicle.dynamics import CarParams, Motion
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.envs.vehicle.tyres import (
    FIALA,
    PlantVariant,
    TyreInputs,
    TyreLoad,
    compute_tyre_forces,
    compute_tyre_load,
)

from ..helpers import FULL, LINEAR, bits, fast_rows, play

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
    # roundings of 370 N m
    assert compute_yaw_moment(T_l, T_r, CAR) == pytest.approx(kept, abs=1e-12)
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
        T_max, limit = vehicle.motor_torque, vehicle.yaw_moment_limit
        full = compute_yaw_moment(-T_max, T_max, make_car(vehicle))
        assert full == pytest.approx(limit, rel=1e-15)


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
    # the step is over when the episode begins, and its mirror image begins: a ramp
    turning = {"lags": True, "steering": "step", "amplitude": 0.1, "onset": -1.0, "hold": 1.0}
    rows = applied("coms", FULL | turning, 150)
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
    car = {"base": "coms", **lags}
    env = StabilityEnv(vehicle=car, scenario=LINEAR | {"lags": True}, control_period=1)
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


WEAK = COMS.replace(motor_power=2000.0)
POWER_CAR, FREE = make_car(WEAK), make_car(COMS)
HOLD = SpeedProfile(speed=7.0, hold=1.0, acceleration=0.0, start=0.0, end=FOREVER, k_p=2.0, k_i=0.5)
speeds, either = st.floats(-40.0, 40.0), st.sampled_from([0.0, 1.0])


@given(speeds, st.floats(-1e3, 1e3), st.floats(-20.0, 20.0), either, either)
def test_no_wheel_takes_or_gives_more_than_its_power(
    v: float, N_z: float, asked: float, hold: float, yaw_first: float
) -> None:
    """P = T omega, omega = v / r, whatever moment and acceleration are asked for."""
    pace = HOLD._replace(speed=v + asked, hold=hold, acceleration=asked * (1.0 - hold))
    T_l, T_r, _, _ = compute_motor_torques(N_z, 0.0, v, 0.0, pace, POWER_CAR, yaw_first)
    for torque in (T_l, T_r):
        assert abs(torque * v / WEAK.wheel_radius) <= 2000.0 * (1.0 + 1e-14)  # roundings
        assert abs(torque) <= WEAK.motor_torque * (1.0 + 1e-14)
    if abs(v) > 0.5:
        most = 2000.0 * WEAK.rear_track / abs(v)
        assert abs(compute_yaw_moment(T_l, T_r, POWER_CAR)) <= most * (1.0 + 1e-14)


@given(speeds)
def test_up_to_P_over_T_max_the_torque_is_what_limits(v: float) -> None:
    corner = 2000.0 / 100.0 * 0.22  # m/s
    expected = 100.0 if abs(v) <= corner else 2000.0 * 0.22 / abs(v)
    assert compute_torque_limit(v, POWER_CAR) == pytest.approx(expected, rel=1e-15)
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


FLAT = (COMS, PASSENGER_CAR)
HIGH = [car.replace(transfer_height=car.gravity_height) for car in FLAT]
torques = st.floats(-3e3, 3e3)
hundreds = st.integers(-30, 30).map(lambda each: 100.0 * each)
cars = st.sampled_from(HIGH)


def plain_shift(car: CarParams, T_l: float, T_r: float) -> float:
    """F_x h / l in N, where F_x is what friction lets a standing car's rear wheels pass on."""
    per_wheel = 0.5 * car.m * GRAVITY * car.l_f / (car.l_f + car.l_r)
    limits = (car.mu * per_wheel, car.mu_r * per_wheel)
    pairs = zip((T_l, T_r), limits, strict=True)
    F_x = sum(min(max(torque / car.r, -limit), limit) for torque, limit in pairs)
    return float(F_x * car.h_x / (car.l_f + car.l_r))


@given(cars, torques, torques, st.floats(0.1, 1.2), st.floats(0.1, 1.2))
def test_the_axles_exchange_F_x_h_over_l(
    vehicle: Any, T_l: float, T_r: float, mu: float, mu_r: float
) -> None:
    car = make_car(vehicle)._replace(mu=mu, mu_r=mu_r)
    still, load = (
        compute_tyre_load(TyreInputs(0.0, *T), car, PlantVariant(0, FIALA, 1))
        for T in ((0.0, 0.0), (T_l, T_r))
    )
    moved = plain_shift(car, T_l, T_r)
    mean = 0.5 * (mu + mu_r)
    for ours, theirs in (
        (2.0 * (load.limit_f - still.limit_f) / mean, -moved),
        (2.0 * (load.rear_l - still.rear_l) / mu, moved),
        (2.0 * (load.rear_r - still.rear_r) / mu_r, moved),
    ):
        assert ours == pytest.approx(theirs, abs=1e-10)  # roundings of some 1e4 N
    # what the ground bears is the car's weight
    loads = 2.0 * load.limit_f / mean + load.rear_l / mu + load.rear_r / mu_r
    assert loads == pytest.approx(car.m * GRAVITY, rel=1e-14)
    assert min(load.limit_f, load.rear_l, load.rear_r) > 0.0


def rear_force(car: CarParams, T: float, roll: int) -> float:
    """N of the rear axle's lateral force at a large slip, both motors at T."""
    load: TyreLoad = compute_tyre_load(TyreInputs(0.0, T, T), car, PlantVariant(0, FIALA, roll))
    sliding = Motion(15.0, -6.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return float(compute_tyre_forces(sliding, load, car, 0.0, PlantVariant(0, FIALA, roll))[1])


@pytest.mark.parametrize("roll", [0, 1])
@pytest.mark.parametrize("vehicle", HIGH, ids=lambda car: str(car.name))
def test_hard_braking_unloads_the_rear_and_driving_loads_it(vehicle: Any, roll: int) -> None:
    flat = make_car(vehicle.replace(transfer_height=0.0))
    T = 0.4 * vehicle.motor_torque
    assert rear_force(flat, -T, roll) == rear_force(flat, T, roll)  # the friction circle alone
    assert rear_force(make_car(vehicle), -T, roll) < 0.97 * rear_force(flat, -T, roll)
    assert rear_force(make_car(vehicle), T, roll) > 1.01 * rear_force(flat, T, roll)


@given(hundreds, hundreds, st.sampled_from([0, 1]), st.sampled_from([0, 1]))
def test_without_a_height_and_at_small_angles_nothing_moves(
    T_l: float, T_r: float, small_angle: int, shifting: int
) -> None:
    inputs = TyreInputs(0.03, T_l, T_r)
    for flat, high in zip(FLAT, HIGH, strict=True):
        none = compute_tyre_load(inputs, make_car(flat), PlantVariant(small_angle, FIALA, shifting))
        some = compute_tyre_load(inputs, make_car(high), PlantVariant(small_angle, FIALA, shifting))
        rests = small_angle or plain_shift(make_car(high), T_l, T_r) == 0.0
        assert (bits(none) == bits(some)) == bool(rests)


def test_a_car_that_brakes_in_a_turn_turns_in() -> None:
    """The loaded front and the unloaded rear turn it more than the friction circle alone does."""
    turning = {"steering": "step", "amplitude": 0.09, "onset": 0.0, "hold": 9.0, "friction": 0.5}
    braking = {"speed_change": -4.0, "change_start": 1.0, "change_length": 1.5, "speed": 8.0}
    rates = []
    for height in (0.0, COMS.gravity_height):
        scenario = FULL | turning | braking | {"vehicle": {"transfer_height": height}}
        env = StabilityEnv(scenario=scenario, control_period=10)
        env.reset(seed=0)
        rates.append(max(moment.info["gamma"] for moment in play(env, [0.0] * 250)[100:]))
    assert rates[1] > 1.02 * rates[0]
