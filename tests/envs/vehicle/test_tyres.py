"""Tyres: each law's printed curve, its linear start, the friction circle, slip at any speed."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR, Vehicle
from sideslip.envs.engine.config import make_car
from sideslip.envs.vehicle.dynamics import CarParams, Motion, compute_sideslip_angle
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.envs.vehicle.tyres import (
    DUGOFF,
    FIALA,
    LINEAR,
    MAGIC_FORMULA,
    MIN_SPEED,
    TYRE_LAWS,
    PlantVariant,
    Tyre,
    TyreInputs,
    TyreLoad,
    _compute_load_transfer,
    _compute_slips,
    compute_lateral_forces,
    compute_tyre_load,
    compute_tyres,
    fit_fiala,
)

pytestmark = pytest.mark.plain

CARS = [make_car(car)._replace(relaxation=0.0) for car in (COMS, PASSENGER_CAR)]  # it acts at once
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
            curved = 0.17 * u * u  # ((1 + E) / 3 + C^2 / 6) (u / C)^2
            laws = {FIALA: abs(u) / 3.0, DUGOFF: 0.0, LINEAR: t * t / 3.0, MAGIC_FORMULA: curved}
            off = laws[law]
            assert force == pytest.approx(C * t, rel=1.01 * off + 1e-14, abs=1e-300)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("car", CARS)
def test_initial_slope_is_the_cornering_stiffness(car: CarParams, law: int) -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, PlantVariant(0, LINEAR))
    front, rear = (car.C_f, load.limit_f, load.slope_f), (car.C_r, load.limit_r, load.slope_r)
    for C, limit, slope in (front, rear):
        h = 1e-9  # Fiala's F = C t (1 - z + ...) departs from its tangent by z = slope h
        force = lateral_force(h, limit, slope, law)
        assert force / h == pytest.approx(C, rel=2.0 * slope * h)


def magic_formula(t: float, F_z: float, F_z0: float, C: float, mu: float, F_x: float) -> float:
    """The formula as printed, with its set: Pacejka (2006), (4.E17)-(4.E26) and Table A3.1.

    C and mu are those at F_z0; F_x leaves of D what the friction circle has.
    """
    p_Cy1, p_Dy1, p_Dy2, p_Ey1, p_Ey2, p_Ky1, p_Ky2 = (
        1.193, -0.990, 0.145, -1.003, -0.537, -14.95, 2.130,
    )  # fmt: skip
    df_z = (F_z - F_z0) / F_z0
    D, D_0 = (p_Dy1 + p_Dy2 * df_z) * F_z, p_Dy1 * F_z0
    K, K_0 = (p_Ky1 * F_z0 * np.sin(2.0 * np.arctan(f / p_Ky2)) for f in (F_z / F_z0, 1.0))
    D, K = mu * F_z0 * D / D_0, C * K / K_0  # scaled to the car's at the standing load
    D = np.sqrt(max(D**2 - F_x**2, (0.05 * D) ** 2))
    E, B = p_Ey1 + p_Ey2 * df_z, K / (p_Cy1 * D)
    return float(D * np.sin(p_Cy1 * np.arctan(B * t - E * (B * t - np.arctan(B * t)))))


@pytest.mark.parametrize("roll", [0, 1])
@given(
    st.sampled_from(CARS), st.floats(-0.1, 0.1), st.floats(-3.0, 3.0), st.floats(-0.5, 0.5),
    st.floats(-200.0, 200.0), st.sampled_from([0.0, 0.4]),
)  # fmt: skip
def test_the_magic_formula_is_the_printed_one_at_every_load(
    roll: int, car: CarParams, phi: float, v_y: float, steer: float, T: float, h_x: float
) -> None:
    """Of each of four tyres, on two frictions, with loads that roll and drive force shift."""
    car = car._replace(mu_r=0.5, h_x=h_x)
    state = motion(12.0, v_y, 0.3)._replace(phi=phi, phi_dot=-phi)
    load = compute_tyre_load(TyreInputs(steer, T, 50.0), car, PlantVariant(0, MAGIC_FORMULA, roll))
    found = compute_tyres(state, load, car, 0.0, PlantVariant(0, MAGIC_FORMULA, roll))
    a, b, c, d, F_x, N_z = found
    forces = compute_lateral_forces(a, b, c, d, MAGIC_FORMULA, 0)
    weight, drive = car.m * GRAVITY / (2.0 * (car.l_f + car.l_r)), (T + 50.0) / car.r
    shift = drive * h_x / (2.0 * (car.l_f + car.l_r))
    e_f, e_r = _compute_load_transfer(state, car, 0.0) if roll else (0.0, 0.0)
    t_f, t_r = _compute_slips(state, load, car, 0)
    mean, along = 0.5 * (car.mu + car.mu_r), 2.0 * N_z / car.d_r
    for i, (t, arm, moved, mu, C, F_i) in enumerate([
        (t_f, car.l_r, -shift * (1.0 - e_f) - weight * car.l_r * e_f, mean, car.C_f, 0.0),
        (t_f, car.l_r, -shift * (1.0 + e_f) + weight * car.l_r * e_f, mean, car.C_f, 0.0),
        (t_r, car.l_f, shift * (1.0 - e_r) - weight * car.l_f * e_r, car.mu, car.C_r,
         0.5 * (F_x - along)),
        (t_r, car.l_f, shift * (1.0 + e_r) + weight * car.l_f * e_r, car.mu_r, car.C_r,
         0.5 * (F_x + along)),
    ]):  # fmt: skip
        printed = magic_formula(t, weight * arm + moved, weight * arm, C, mu, F_i)
        assert forces[i] == pytest.approx(printed, rel=1e-11, abs=1e-9)


@pytest.mark.parametrize("car", CARS)
def test_the_magic_formula_peaks_at_mu_F_z(car: CarParams) -> None:
    load: TyreLoad = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, PlantVariant(0, LINEAR))
    for limit, slope in ((load.limit_f, load.slope_f), (load.limit_l, load.slope_l)):
        slips = np.linspace(0.0, 3.0, 3001) / slope
        forces = [lateral_force(t, limit, slope, MAGIC_FORMULA) for t in slips.tolist()]
        assert max(forces) == pytest.approx(limit, rel=1e-6)
        assert max(forces) <= limit * (1.0 + 1e-14)
        # behind the peak a sliding tyre keeps sin(C pi / 2)
        sliding = lateral_force(1e12, limit, slope, MAGIC_FORMULA)
        assert sliding == pytest.approx(limit * math.sin(1.193 * math.pi / 2.0), rel=1e-6)
        left, right = (lateral_force(t, limit, slope, MAGIC_FORMULA) for t in (0.1, -0.1))
        assert left == -right


@pytest.mark.parametrize("vehicle", [COMS, PASSENGER_CAR])
def test_fialas_law_fits_the_magic_formula_of_both_axles(vehicle: Vehicle) -> None:
    """The least squares up to the peak among its neighbours, and within 2.5 % of mu F_z."""
    fitted = fit_fiala(vehicle)
    ours, true = (
        compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), make_car(car), PlantVariant(0, LINEAR))
        for car in (fitted, vehicle)
    )
    for F, slope, F_0, slope_0 in (
        (ours.limit_f, ours.slope_f, true.limit_f, true.slope_f),
        (ours.limit_l, ours.slope_l, true.limit_l, true.slope_l),
    ):
        slips = (np.linspace(0.0, 3.01, 302) / (3.0 * slope_0)).tolist()  # C t over F_max
        curve = np.array([lateral_force(t, F_0, slope_0, MAGIC_FORMULA) for t in slips])
        errors = {
            (a, b): np.array([lateral_force(t, b * F, a * slope, FIALA) for t in slips]) - curve
            for a in (0.99, 1.0, 1.01) for b in (0.99, 1.0, 1.01)
        }  # fmt: skip
        assert np.abs(errors[1.0, 1.0]).max() < 0.025 * F_0
        assert min(errors, key=lambda at: float(errors[at] @ errors[at])) == (1.0, 1.0)


def test_linear_tyres_have_no_limit() -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), CARS[0], PlantVariant(1, LINEAR))
    # one rounding each for slope and product
    force = lateral_force(10.0, load.limit_f, load.slope_f, LINEAR, 1)
    assert force == pytest.approx(60000.0, rel=1e-15)
    force = lateral_force(10.0, load.limit_f, load.slope_f, LINEAR)
    assert force == pytest.approx(6000.0 * math.atan(10.0), rel=1e-15)


@pytest.mark.parametrize("car", CARS)
def test_the_four_wheels_carry_the_car_on_friction_mu(car: CarParams) -> None:
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, PlantVariant(0, LINEAR))
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
    still = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, PlantVariant(0, LINEAR))
    load = compute_tyre_load(TyreInputs(0.0, T_l, T_r), car, PlantVariant(0, LINEAR))
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
    load = compute_tyre_load(TyreInputs(0.1, 1e4, -1e4), CARS[0], PlantVariant(1, LINEAR))
    still = compute_tyre_load(TyreInputs(0.1, 0.0, 0.0), CARS[0], PlantVariant(1, LINEAR))
    assert load.limit_l == load.limit_r == still.limit_l
    assert load.F_x == 0.0
    assert load.N_z == pytest.approx(-1e4 / 0.22 * 0.82, rel=1e-15)


def test_slip_angles_are_those_of_the_wheels_velocities() -> None:
    car, steer = CARS[0], 0.2
    state = motion(6.0, 0.8, 0.5)
    load = compute_tyre_load(TyreInputs(steer, 0.0, 0.0), car, PlantVariant(0, LINEAR))
    front = steer - math.atan2(0.8 + car.l_f * 0.5, 6.0)
    rear = -math.atan2(0.8 - car.l_r * 0.5, 6.0)
    expected = math.tan(front), math.tan(rear)
    # a few roundings
    assert _compute_slips(state, load, car, 0) == pytest.approx(expected, rel=1e-14)


@pytest.mark.smoke
@pytest.mark.parametrize("small_angle", [0, 1])
def test_nothing_divides_by_zero_at_any_speed(small_angle: int) -> None:
    inputs, variant = TyreInputs(0.3, 50.0, -50.0), PlantVariant(small_angle, LINEAR)
    load = compute_tyre_load(inputs, CARS[0], variant)
    for v_x in (-5.0, -MIN_SPEED, -1e-300, -0.0, 0.0, 1e-300, 1e-9, MIN_SPEED, 5.0):
        for v_y in (-3.0, 0.0, 1e-300, 3.0):
            state = motion(v_x, v_y, 0.7)
            found = _compute_slips(state, load, CARS[0], small_angle)
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
    # see atan2
    assert compute_sideslip_angle(4.0, 0.4, 0) == pytest.approx(math.atan(0.1), abs=1e-15)
    assert compute_sideslip_angle(-4.0, 0.0, 0) == math.pi
