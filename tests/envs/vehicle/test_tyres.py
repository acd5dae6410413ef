"""Tyres: Fiala's curve, its linear start, the friction circle, and slip at any speed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.engine.packing import car_of
from sideslip.envs.vehicle.dynamics import Car, Motion, sideslip_angle
from sideslip.envs.vehicle.tyres import FIALA, LINEAR, SLOW, Inputs, lateral_force, load_of, slips
from sideslip.envs.vehicle.vehicle import GRAVITY

pytestmark = pytest.mark.plain

CARS = [car_of(COMS), car_of(PASSENGER_CAR)]
tangents = st.floats(-50.0, 50.0)


def motion(v_x: float = 0.0, v_y: float = 0.0, gamma: float = 0.0) -> Motion:
    return Motion(v_x, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def fiala(tangent: float, C: float, limit: float) -> float:
    """Fiala's law as books print it, with its branch (Pacejka, Tire and Vehicle Dynamics, 3)."""
    sliding = 3.0 * limit / C
    if abs(tangent) >= sliding:
        return math.copysign(limit, tangent)
    a = abs(tangent)
    force = C * a - C**2 * a**2 / (3.0 * limit) + C**3 * a**3 / (27.0 * limit**2)
    return math.copysign(force, tangent)


@given(tangents, st.floats(100.0, 1e5), st.floats(10.0, 1e4))
def test_fiala_is_the_printed_law(tangent: float, C: float, limit: float) -> None:
    force = lateral_force(tangent, limit, C / (3.0 * limit), FIALA)
    # the printed polynomial cancels near the limit: a few roundings of its largest term, 3 limit
    assert force == pytest.approx(fiala(tangent, C, limit), abs=1e-14 * limit)
    assert abs(force) <= limit


@pytest.mark.smoke
@pytest.mark.parametrize("car", CARS)
def test_fiala_reaches_mu_F_z_exactly_and_no_more(car: Car) -> None:
    load = load_of(Inputs(0.0, 0.0, 0.0), car, 0)
    for limit, slope in ((load.limit_f, load.slope_f), (load.limit_l, load.slope_l)):
        edge = 1.0 / slope
        assert lateral_force(1e9, limit, slope, FIALA) == limit
        assert lateral_force(-1e9, limit, slope, FIALA) == -limit
        assert lateral_force(0.9 * edge, limit, slope, FIALA) < limit


@pytest.mark.parametrize("law", [LINEAR, FIALA])
@pytest.mark.parametrize("car", CARS)
def test_initial_slope_is_the_cornering_stiffness(car: Car, law: int) -> None:
    load = load_of(Inputs(0.0, 0.0, 0.0), car, 0)
    for C, limit, slope in (
        (car.C_f, load.limit_f, load.slope_f),
        (car.C_r, load.limit_r, load.slope_r),
    ):
        h = 1e-9  # F = C t (1 - z + ...): the curve departs from its tangent by z = slope h
        assert lateral_force(h, limit, slope, law) / h == pytest.approx(C, rel=2.0 * slope * h)


def test_linear_tyres_have_no_limit() -> None:
    load = load_of(Inputs(0.0, 0.0, 0.0), CARS[0], 1)
    force = lateral_force(10.0, load.limit_f, load.slope_f, LINEAR)
    assert force == pytest.approx(60000.0, rel=1e-15)  # one rounding each for slope and product


@pytest.mark.parametrize("car", CARS)
def test_the_four_wheels_carry_the_car_on_friction_mu(car: Car) -> None:
    load = load_of(Inputs(0.0, 0.0, 0.0), car, 0)
    total = 2.0 * load.limit_f + load.limit_l + load.limit_r
    assert total == pytest.approx(car.mu * car.m * GRAVITY, rel=1e-15)
    # moments about the centre of gravity balance
    rear = load.limit_l + load.limit_r
    assert 2.0 * load.limit_f * car.l_f == pytest.approx(rear * car.l_r, rel=1e-15)


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), tangents)
def test_rear_tyres_stay_within_the_friction_circle(T_l: float, T_r: float, slip: float) -> None:
    car = CARS[0]
    still = load_of(Inputs(0.0, 0.0, 0.0), car, 0)
    load = load_of(Inputs(0.0, T_l, T_r), car, 0)
    difference = 2.0 * load.N_z / car.d_r
    for along, limit, slope in (
        (0.5 * (load.F_x - difference), load.limit_l, load.slope_l),
        (0.5 * (load.F_x + difference), load.limit_r, load.slope_r),
    ):
        across = lateral_force(slip, limit, slope, FIALA)
        # 5 % of the lateral force is kept under full drive: the circle is passed by 0.125 %
        assert math.hypot(along, across) <= still.limit_l * math.sqrt(1.0025) * (1.0 + 1e-14)
        assert limit >= 0.05 * still.limit_l * (1.0 - 1e-14)


def test_the_small_angle_plant_knows_no_circle() -> None:
    load = load_of(Inputs(0.1, 1e4, -1e4), CARS[0], 1)
    still = load_of(Inputs(0.1, 0.0, 0.0), CARS[0], 1)
    assert load.limit_l == load.limit_r == still.limit_l
    assert load.F_x == 0.0
    assert load.N_z == pytest.approx(-1e4 / 0.22 * 0.82, rel=1e-15)


@pytest.mark.parametrize("law", [LINEAR, FIALA])
def test_slip_angles_are_those_of_the_wheels_velocities(law: int) -> None:
    car, steer = CARS[0], 0.2
    state = motion(6.0, 0.8, 0.5)
    load = load_of(Inputs(steer, 0.0, 0.0), car, 0)
    front = steer - math.atan2(0.8 + car.l_f * 0.5, 6.0)
    rear = -math.atan2(0.8 - car.l_r * 0.5, 6.0)
    expected = (front, rear) if law == LINEAR else (math.tan(front), math.tan(rear))
    assert slips(state, load, car, 0, law) == pytest.approx(expected, rel=1e-14)  # a few roundings


@pytest.mark.smoke
@pytest.mark.parametrize("small_angle", [0, 1])
def test_nothing_divides_by_zero_at_any_speed(small_angle: int) -> None:
    load = load_of(Inputs(0.3, 50.0, -50.0), CARS[0], small_angle)
    for v_x in (-5.0, -SLOW, -1e-300, -0.0, 0.0, 1e-300, 1e-9, SLOW, 5.0):
        for v_y in (-3.0, 0.0, 1e-300, 3.0):
            for law in (LINEAR, FIALA):
                state = motion(v_x, v_y, 0.7)
                assert np.all(np.isfinite(slips(state, load, CARS[0], small_angle, law)))
            assert math.isfinite(sideslip_angle(v_x, v_y, small_angle))


def test_sideslip_is_zero_below_half_a_metre_per_second() -> None:
    for small_angle in (0, 1):
        assert sideslip_angle(0.49, 0.0, small_angle) == 0.0
        assert sideslip_angle(0.3, 0.3, small_angle) == 0.0
    assert sideslip_angle(4.0, 0.4, 1) == 0.1
    assert sideslip_angle(4.0, 0.4, 0) == pytest.approx(math.atan(0.1), abs=1e-15)  # see atan2
    assert sideslip_angle(-4.0, 0.0, 0) == math.pi
