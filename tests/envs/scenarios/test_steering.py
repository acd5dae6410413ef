"""Manoeuvres over time: shapes of the steering, zero net heading, wind, and the held speed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, FAILURES, StabilityEnv, critical_speed
from sideslip.envs.engine.config import make_car
from sideslip.envs.numerics.functions import FOREVER, TICK
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.scenarios.driver import (
    STEERING_KINDS,
    STEERING_WIDTH,
    SpeedProfile,
    Wind,
    compute_acceleration_command,
    compute_steering,
    compute_wind,
    write_steering,
)
from sideslip.envs.scenarios.world import DRAWS_WIDTH, Draws, _is_stable

from ..helpers import FULL, fast_rows, packets, play

pytestmark = pytest.mark.plain

DRAWN = Draws(*[0.0] * DRAWS_WIDTH)._replace(speed=25.0 / 3.6, onset=0.5, hold=1.5, side=1.0)
DRAWN = DRAWN._replace(amplitude=0.1, amplitude_2=0.03, front_stiffness=1.0, rear_stiffness=1.0)
DRAWN = DRAWN._replace(frequency=0.4, frequency_2=0.5, frequency_3=0.2, frequency_4=0.8)
DRAWN = DRAWN._replace(critical_speed=1.05)


def steering(kind: str, seconds: float = 10.0, **changes: float) -> np.ndarray:
    """The steering angle at every tick."""
    programme = np.zeros(STEERING_WIDTH)
    write_steering(STEERING_KINDS.index(kind), DRAWN._replace(**changes), programme)
    ticks = range(round(seconds / TICK))
    return np.array([compute_steering(float(tick), programme) for tick in ticks])


def sine(start: float, hertz: float, t: np.ndarray) -> np.ndarray:
    return np.where(t >= start, np.sin(2.0 * np.pi * hertz * (t - start)), 0.0)


def swept(t: np.ndarray) -> np.ndarray:
    """The phase of a sweep from 0.4 to 0.5 Hz within 1.5 s: 2 pi times the integral of its Hz."""
    end = 0.4 * 1.5 + 0.1 / 1.5 * 1.5**2 / 2.0
    return 2.0 * np.pi * np.where(t < 1.5, 0.4 * t + 0.1 / 1.5 * t**2 / 2.0, end + 0.5 * (t - 1.5))


def test_each_kind_is_what_its_name_says() -> None:
    t = np.arange(10_000) * TICK
    x = np.clip((t - [[0.5], [2.0], [3.5]]) / 0.2, 0.0, 1.0)
    steps = 3.0 * x**2 - 2.0 * x**3
    one = sine(0.5, 0.4, t)
    expected = {
        "straight": 0.0 * t,
        "sine": 0.1 * one,
        # hold: 1.5 s from one to the next
        "double-lane-change": np.where(t < 0.5 + 2.5, 0.1 * one, 0.0)
        - np.where(t < 2.0 + 2.5, 0.1 * sine(2.0, 0.4, t), 0.0),
        "lane-change": np.where(t < 0.5 + 2.5, 0.1 * one, 0.0),
        # half a wave of half the size, then the sine with the opposite sign
        "slalom": np.where(t < 0.5 + 1.25, 0.05 * one, -0.1 * sine(1.75, 0.4, t)),
        "step": 0.1 * (steps[0] - 2.0 * steps[1] + steps[2]),
        "random": 0.1 * one
        - 0.1 * 0.5 / 0.4 * sine(0.5, 0.5, t)
        + 0.03 * sine(0.5, 0.2, t)
        - 0.03 * 0.8 / 0.2 * sine(0.5, 0.8, t),
        # FMVSS 126: three quarters of a wave, the second peak held, the last quarter
        "sine-with-dwell": np.select(
            [t < 0.5 + 1.875, t < 2.375 + 1.5, t < 3.875 + 0.625],
            [0.1 * one, -0.1 + 0.0 * t, 0.1 * sine(2.0, 0.4, t)],
        ),
        "ramp": 0.1 * np.clip((t - 0.5) / 1.5, 0.0, 1.0),
        "sweep": np.where(t > 0.5, 0.1 * np.sin(swept(t - 0.5)), 0.0),
        "held-step": 0.1 * steps[0],
        "driver": 0.0 * t,
        "trace": 0.0 * t,  # behind the programme
        "wander": 0.0 * t,  # from angle to angle
    }
    assert set(expected) == set(STEERING_KINDS)
    for kind, angle in expected.items():
        # the sine's stated error, and the phase's rounding, on angles up to 0.3 rad
        np.testing.assert_allclose(steering(kind), angle, rtol=0.0, atol=1e-14)


def test_the_dwell_of_fmvss_126_is_half_a_second_at_the_second_peak() -> None:
    angle = steering("sine-with-dwell", 4.0, frequency=0.7, hold=0.5)
    held = np.flatnonzero(angle == -0.1)
    assert (held[0], len(held)) == (500 + round(750.0 / 0.7), 500)
    assert np.all(np.diff(held) == 1)
    before, after = angle[: held[0]], angle[held[-1] + 1 :]
    # a tick is cut to whole milliseconds: at most half a tick from the peak, where the sine is flat
    near = 0.1 * (1.0 - math.cos(2.0 * math.pi * 0.7 * 1.5 * TICK))
    assert abs(before[-1] + 0.1) < near
    assert abs(after[0] + 0.1) < near
    moved = np.flatnonzero(angle)
    assert moved[-1] - moved[0] + 1 == pytest.approx(1000.0 / 0.7 + 500.0, abs=2.0)


@pytest.mark.parametrize("kind", STEERING_KINDS)
def test_side_mirrors_the_steering(kind: str) -> None:
    np.testing.assert_array_equal(steering(kind, 5.0, side=0.49), -steering(kind, 5.0, side=0.5))


@pytest.mark.parametrize("kind", ["slalom", "random"])
def test_slalom_and_random_swing_about_the_old_heading(kind: str) -> None:
    """The heading follows the integral of the steering: over whole periods its mean is zero."""
    heading = np.cumsum(steering(kind, 30.5 if kind == "random" else 15.5)) * TICK
    whole = heading[500:] if kind == "random" else heading[1750:14_250]  # 10 s = all periods; 5
    # the left-hand sum errs by half a tick of the largest angle
    assert abs(whole.mean()) < 0.5 * TICK * 0.3
    assert np.abs(whole).max() > 0.02


@pytest.mark.parametrize("kind", ["lane-change", "step"])
def test_lane_change_and_step_end_on_the_old_heading(kind: str) -> None:
    angle = steering(kind)
    assert np.abs(angle[-1]) < 1e-15
    # both are odd about their middle: the sum of the samples cancels to roundings of 500 rad
    assert abs(angle.sum()) < 1e-10
    assert angle.max() == pytest.approx(-angle.min(), rel=1e-12)


@given(st.floats(0.1, 3.0), st.floats(0.3, 3.0))
def test_draws_are_stable_up_to_the_critical_speed_less_5_percent(
    front: float, rear: float
) -> None:
    drawn, car = DRAWN._replace(front_stiffness=front, rear_stiffness=rear), make_car(COMS)
    limit = critical_speed(COMS.scale_stiffness(front, rear)) / 1.05
    if limit == math.inf:
        assert _is_stable(drawn._replace(speed=1e3), car)
    else:
        # the speed enters squared: the boundary is known to some roundings
        assert _is_stable(drawn._replace(speed=limit * (1.0 - 1e-12)), car)
        assert not _is_stable(drawn._replace(speed=limit * (1.0 + 1e-12)), car)


@given(st.floats(0.7, 1.5), st.floats(0.7, 1.5), st.floats(0.5, 1.5), st.floats(0.5, 1.5))
def test_a_car_whose_tyres_change_is_stable_before_and_after(
    front: float, rear: float, later_front: float, later_rear: float
) -> None:
    drawn = DRAWN._replace(speed=9.0, front_stiffness=front, rear_stiffness=rear)
    later = drawn._replace(front_stiffness=front * later_front, rear_stiffness=rear * later_rear)
    changes = drawn._replace(tyre_change_time=4.0, front_change=later_front, rear_change=later_rear)
    car = make_car(COMS)
    assert _is_stable(changes, car) == (_is_stable(drawn, car) and _is_stable(later, car))
    assert _is_stable(changes._replace(tyre_change_time=0.0), car) == _is_stable(drawn, car)


def test_wind_blows_from_its_start_up_to_its_end_at_its_arm_and_height() -> None:
    wind = Wind(200.0, 0.2, 4000.0, 8000.0, 0.5)
    for tick, force in ((3999.0, 0.0), (4000.0, 200.0), (7999.0, 200.0), (8000.0, 0.0)):
        # to the left and above the roll axis: it rolls the body to the left, which is negative
        moment = pytest.approx(0.2 * force, rel=1e-15)
        assert compute_wind(tick, wind) == (force, moment, -0.5 * force)


def pace(**changes: float) -> SpeedProfile:
    return SpeedProfile(7.0, 1.0, 0.0, 0.0, FOREVER, 2.0, 0.5)._replace(**changes)


def test_pi_holds_the_integral_while_the_motors_are_at_their_limit() -> None:
    assert compute_acceleration_command(0.0, 7.0, 0.0, pace(), 2.0) == (0.0, 0.0)
    a_x, integral = compute_acceleration_command(0.0, 6.9, 0.1, pace(), 2.0)
    assert (a_x, integral) == (pytest.approx(0.3, rel=1e-14), pytest.approx(0.10005, rel=1e-14))
    assert compute_acceleration_command(0.0, 0.0, 0.1, pace(), 2.0) == (2.0, 0.1)
    assert compute_acceleration_command(0.0, 20.0, 0.1, pace(), 2.0) == (-2.0, 0.1)
    given_a_x = pace(hold=0.0, acceleration=0.7, start=10.0, end=20.0)
    for tick, expected in ((9.0, 0.0), (10.0, 0.7), (19.0, 0.7), (20.0, 0.0)):
        assert compute_acceleration_command(tick, 3.0, 0.0, given_a_x, 2.0)[0] == expected


@pytest.mark.compiled
def test_speed_is_held_against_the_drag_of_a_turn() -> None:
    turning = FULL | {"steering": "step", "amplitude": 0.05, "hold": 100.0, "duration": 40.0}
    env = StabilityEnv(scenario=turning)
    env.reset(seed=0)
    rows = fast_rows(play(env, [0.0] * 4000))
    v = 0.5 * (rows[:, FAST.wheel_left] + rows[:, FAST.wheel_right])
    assert v.min() < 25.0 / 3.6 - 0.01
    # the PI's slow pole, 0.29 / s, leaves exp(-11) of some 0.05 m/s
    assert v[-1] == pytest.approx(25.0 / 3.6, abs=1e-5)


@pytest.mark.compiled
@pytest.mark.parametrize("lags", [False, True])
def test_a_car_starts_from_standstill(lags: bool) -> None:
    start = FULL | {"speed": 0.0, "acceleration": 1.0, "lags": lags}
    env = StabilityEnv("gps", scenario=start)
    obs, info = env.reset(seed=0)
    assert np.all(np.isfinite(obs))
    moments = play(env, [0.0] * 1000)
    v = moments[-1].record.fast[-1, FAST.wheel_left]
    late = 0.005 if lags else 0.0  # m/s, the motors' lag
    # Simpson's error, (1/5)^4 / 2880 of what the lag costs; roundings are below 1e-11
    assert v == pytest.approx(10.0 - late, abs=3e-9)
    slow = packets(moments[:99])
    assert len(slow) > 3
    assert not slow[:, PACKET.quality].any()  # below 1 m/s
    assert info["beta"] == moments[-1].info["beta"] == 0.0


def test_a_car_driven_backwards_is_no_spun_one_and_stays_finite() -> None:
    env = StabilityEnv(scenario=FULL | {"speed": 1.0, "acceleration": -2.0, "duration": 3.0})
    env.reset(seed=0)
    moments = play(env, [0.1] * 300)
    assert not moments[-1].terminated
    assert FAILURES[moments[-1].info["failure"]] == "none"
    assert abs(moments[-1].info["beta"]) > 3.0


def test_a_speed_that_changes_is_followed_with_its_acceleration_fed_forward() -> None:
    ramp = pace(acceleration=0.5, start=1000.0, end=3000.0)
    for tick, speed, a_x in ((0.0, 7.0, 0.0), (2000.0, 7.5, 0.5), (9000.0, 8.0, 0.0)):
        assert compute_acceleration_command(tick, speed, 0.0, ramp, 2.0) == (a_x, 0.0)
    sway = pace(surge=0.5, surge_rate=2.0)
    for tick in (0.0, 400.0, 1500.0):
        t = tick * TICK
        speed = 7.0 + 0.5 / 2.0 * (1.0 - math.cos(2.0 * t))
        a_x, integral = compute_acceleration_command(tick, speed, 0.0, sway, 2.0)
        assert a_x == pytest.approx(0.5 * math.sin(2.0 * t), abs=1e-14)
        assert integral == pytest.approx(0.0, abs=1e-17)
