"""Tyres: each law's printed curve, its linear start, the friction circle, slip at any speed."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.engine.config import make_car
from sideslip.envs.vehicle.dynamics import CarParams, Motion, compute_sideslip_angle
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.envs.vehicle.tyres import (
    DUGOFF,
    FIALA,
    LINEAR,
    MIN_SPEED,
    TYRE_LAWS,
    Tyre,
    TyreInputs,
    compute_lateral_forces,
    compute_slips,
    compute_tyre_load,
)

pytestmark = pytest.mark.plain

CARS = [make_car(COMS), make_car(PASSENGER_CAR)]
LAWS = range(len(TYRE_LAWS))
LIMITED = [FIALA, DUGOFF]
tangents = st.floats(-50.0, 50.0)


def motion(v_x: float = 0.0, v_y: float = 0.0, gamma: float = 0.0) -> Motion:
    return Motion(v_x, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def lateral_force(
    tangent: float, limit: float, slope: float, law: int, small_angle: int = 0
) -> float:
    """Of one tyre, beside others that it must not be taken for."""
    tyre, other = Tyre(tangent, limit, slope), Tyre(-0.3 * tangent, 2.0 * limit, 0.7 * slope)
    found = []
    for place in range(4):
        arguments: list[Any] = [other, other, other, other, law, small_angle]
        arguments[place] = tyre
        found.append(compute_lateral_forces(*arguments)[place])
    assert found == found[:1] * 4
    return float(found[0])


def fiala(tangent: float, C: float, limit: float) -> float:
    """Fiala's law as books print it, with its branch (Pacejka, Tire and Vehicle Dynamics, 3)."""
    sliding = 3.0 * limit / C
    if abs(tangent) >= sliding:
        return math.copysign(limit, tangent)
    a = abs(tangent)
    force = C * a - C**2 * a**2 / (3.0 * limit) + C**3 * a**3 / (27.0 * limit**2)
    return math.copysign(force, tangent)


def dugoff(tangent: float, C: float, limit: float) -> float:
    """Dugoff's law as printed, with its branch, without longitudinal slip (SAE 700377, 1970)."""
    share = math.inf if tangent == 0.0 else limit / (2.0 * C * abs(tangent))  # lambda
    return C * tangent * (share * (2.0 - share) if share < 1.0 else 1.0)


@given(tangents, st.floats(100.0, 1e5), st.floats(10.0, 1e4))
def test_both_limited_laws_are_the_printed_ones(tangent: float, C: float, limit: float) -> None:
    # Dugoff: a few roundings; Fiala's printed polynomial cancels near the limit: a few roundings
    # of its largest term, 3 limit
    curves = (dugoff(tangent, C, limit), 1e-14, 0.0), (fiala(tangent, C, limit), 0.0, 1e-14 * limit)
    for law, (printed, rel, error) in zip((DUGOFF, FIALA), curves, strict=True):
        force = lateral_force(tangent, limit, C / (3.0 * limit), law)
        assert force == pytest.approx(printed, rel=rel, abs=error)
        assert abs(force) <= limit


@pytest.mark.parametrize("law", LIMITED)
@given(tangents, tangents, st.floats(100.0, 1e5), st.floats(10.0, 1e4))
def test_more_slip_is_more_force_up_to_the_limit(
    law: int, t_1: float, t_2: float, C: float, limit: float
) -> None:
    """Odd and rising, down to the roundings of the limit; at any slip and at none a number."""
    slope, rounding = C / (3.0 * limit), 4e-16 * limit
    low, high = (lateral_force(t, limit, slope, law) for t in sorted((t_1, t_2)))
    assert high - low >= -rounding
    assert lateral_force(-t_1, limit, slope, law) == -lateral_force(t_1, limit, slope, law)
    assert lateral_force(0.0, limit, slope, law) == 0.0
    for t in (1e9, math.inf):
        assert lateral_force(t, limit, slope, law) == pytest.approx(limit, rel=1e-6)


@given(st.floats(-1e-3, 1e-3), st.floats(100.0, 1e5), st.floats(10.0, 1e4))
def test_all_laws_are_the_linear_one_at_small_slip(u: float, C: float, limit: float) -> None:
    """To the first order in the share u = C t / F_max of the limit; Dugoff's to rounding."""
    t = u * limit / C
    for law in LAWS:
        for small_angle in (0, 1):
            force = lateral_force(t, limit, C / (3.0 * limit), law, small_angle)
            off = {FIALA: abs(u) / 3.0, DUGOFF: 0.0, LINEAR: t * t / 3.0}[law]
            assert force == pytest.approx(C * t, rel=1.01 * off + 1e-14, abs=1e-300)


@pytest.mark.smoke
@pytest.mark.parametrize("car", CARS)
def test_fiala_reaches_mu_F_z_exactly_and_no_more(car: CarParams) -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, 0)
    for limit, slope in ((load.limit_f, load.slope_f), (load.limit_l, load.slope_l)):
        edge = 1.0 / slope
        assert lateral_force(1e9, limit, slope, FIALA) == limit
        assert lateral_force(-1e9, limit, slope, FIALA) == -limit
        assert lateral_force(0.9 * edge, limit, slope, FIALA) < limit


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("car", CARS)
def test_initial_slope_is_the_cornering_stiffness(car: CarParams, law: int) -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, 0)
    for C, limit, slope in (
        (car.C_f, load.limit_f, load.slope_f),
        (car.C_r, load.limit_r, load.slope_r),
    ):
        h = 1e-9  # Fiala's F = C t (1 - z + ...) departs from its tangent by z = slope h
        force = lateral_force(h, limit, slope, law)
        assert force / h == pytest.approx(C, rel=2.0 * slope * h)


def test_linear_tyres_have_no_limit() -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), CARS[0], 1)
    # one rounding each for slope and product
    force = lateral_force(10.0, load.limit_f, load.slope_f, LINEAR, 1)
    assert force == pytest.approx(60000.0, rel=1e-15)
    force = lateral_force(10.0, load.limit_f, load.slope_f, LINEAR)
    assert force == pytest.approx(6000.0 * math.atan(10.0), rel=1e-15)


@pytest.mark.parametrize("car", CARS)
def test_the_four_wheels_carry_the_car_on_friction_mu(car: CarParams) -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, 0)
    total = 2.0 * load.limit_f + load.limit_l + load.limit_r
    assert total == pytest.approx(car.mu * car.m * GRAVITY, rel=1e-15)
    # moments about the centre of gravity balance
    rear = load.limit_l + load.limit_r
    assert 2.0 * load.limit_f * car.l_f == pytest.approx(rear * car.l_r, rel=1e-15)


@pytest.mark.parametrize("law", LIMITED)
@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), tangents)
def test_rear_tyres_stay_within_the_friction_circle(
    law: int, T_l: float, T_r: float, slip: float
) -> None:
    car = CARS[0]
    still = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, 0)
    load = compute_tyre_load(TyreInputs(0.0, T_l, T_r), car, 0)
    difference = 2.0 * load.N_z / car.d_r
    for along, limit, slope in (
        (0.5 * (load.F_x - difference), load.limit_l, load.slope_l),
        (0.5 * (load.F_x + difference), load.limit_r, load.slope_r),
    ):
        across = lateral_force(slip, limit, slope, law)
        # 5 % of the lateral force is kept under full drive: the circle is passed by 0.125 %
        assert math.hypot(along, across) <= still.limit_l * math.sqrt(1.0025) * (1.0 + 1e-14)
        assert limit >= 0.05 * still.limit_l * (1.0 - 1e-14)


def test_the_small_angle_plant_knows_no_circle() -> None:
    load = compute_tyre_load(TyreInputs(0.1, 1e4, -1e4), CARS[0], 1)
    still = compute_tyre_load(TyreInputs(0.1, 0.0, 0.0), CARS[0], 1)
    assert load.limit_l == load.limit_r == still.limit_l
    assert load.F_x == 0.0
    assert load.N_z == pytest.approx(-1e4 / 0.22 * 0.82, rel=1e-15)


def test_slip_angles_are_those_of_the_wheels_velocities() -> None:
    car, steer = CARS[0], 0.2
    state = motion(6.0, 0.8, 0.5)
    load = compute_tyre_load(TyreInputs(steer, 0.0, 0.0), car, 0)
    front = steer - math.atan2(0.8 + car.l_f * 0.5, 6.0)
    rear = -math.atan2(0.8 - car.l_r * 0.5, 6.0)
    expected = math.tan(front), math.tan(rear)
    assert compute_slips(state, load, car, 0) == pytest.approx(
        expected, rel=1e-14
    )  # a few roundings


@pytest.mark.smoke
@pytest.mark.parametrize("small_angle", [0, 1])
def test_nothing_divides_by_zero_at_any_speed(small_angle: int) -> None:
    load = compute_tyre_load(TyreInputs(0.3, 50.0, -50.0), CARS[0], small_angle)
    for v_x in (-5.0, -MIN_SPEED, -1e-300, -0.0, 0.0, 1e-300, 1e-9, MIN_SPEED, 5.0):
        for v_y in (-3.0, 0.0, 1e-300, 3.0):
            state = motion(v_x, v_y, 0.7)
            found = compute_slips(state, load, CARS[0], small_angle)
            assert np.all(np.isfinite(found))
            for law in LAWS:
                force = lateral_force(found[0], load.limit_f, load.slope_f, law, small_angle)
                assert math.isfinite(force)
            assert math.isfinite(compute_sideslip_angle(v_x, v_y, small_angle))


def test_sideslip_is_zero_below_half_a_metre_per_second() -> None:
    for small_angle in (0, 1):
        assert compute_sideslip_angle(0.49, 0.0, small_angle) == 0.0
        assert compute_sideslip_angle(0.3, 0.3, small_angle) == 0.0
    assert compute_sideslip_angle(4.0, 0.4, 1) == 0.1
    assert compute_sideslip_angle(4.0, 0.4, 0) == pytest.approx(
        math.atan(0.1), abs=1e-15
    )  # see atan2
    assert compute_sideslip_angle(-4.0, 0.0, 0) == math.pi
