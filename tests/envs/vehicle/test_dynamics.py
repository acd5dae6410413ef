"""The plant: Newton's laws, symmetry, geometry, and the integrator's order."""

import math
from typing import Any

import numpy as np
import pytest
import scipy.integrate
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR
from sideslip.envs.engine.config import make_car
from sideslip.envs.vehicle.dynamics import (
    CarParams,
    DisturbanceForces,
    Motion,
    RoadParams,
    derivative,
    kutta3,
    rk4,
)
from sideslip.envs.vehicle.tyres import (
    FIALA,
    LINEAR,
    MAGIC_FORMULA,
    TYRE_LAWS,
    PlantVariant,
    Tyre,
    TyreInputs,
    compute_lateral_forces,
    compute_tyre_load,
)

pytestmark = pytest.mark.plain

CAR = make_car(COMS)._replace(relaxation=0.0)  # slip acts at once; a test has it relax
STRAIGHT, CIRCLE = RoadParams(0.0, 0.0, 1.0), RoadParams(0.02, -1e6, 1.0)
CALM = DisturbanceForces(0.0, 0.0)
PLANTS = [(small_angle, law) for small_angle in (0, 1) for law in range(len(TYRE_LAWS))]
speeds = st.floats(-3.0, 3.0)


def motion(**values: float) -> Motion:
    return Motion(*[0.0] * 9)._replace(**values)


def slope(state: Motion, steer: float = 0.0, T: Any = (0.0, 0.0), **how: Any) -> Any:
    """The derivative of a state; `how` changes push, car, road, small_angle or law."""
    push, car, road = how.get("push", CALM), how.get("car", CAR), how.get("road", STRAIGHT)
    small_angle, law = how.get("small_angle", 0), how.get("law", FIALA)
    load = compute_tyre_load(TyreInputs(steer, *T), car, PlantVariant(small_angle, LINEAR))
    return derivative(state, load, push, car, road, PlantVariant(small_angle, law))


def drive(
    state: Motion, seconds: float, h: float, steer: float = 0.0, car: CarParams = CAR, **how: Any
) -> Motion:
    load = compute_tyre_load(TyreInputs(steer, 0.0, 0.0), car, PlantVariant(0, LINEAR))
    road, rule = how.get("road", STRAIGHT), how.get("rule", kutta3)
    variant = PlantVariant(0, how.get("law", FIALA), how.get("roll", 0))
    for _ in range(round(seconds / h)):
        state = rule(state, (load, load, load), CALM, car, road, h, variant)
    return state


def forces(state: Motion, steer: float, T: Any, small: int, law: int) -> list[float]:
    """Lateral forces of the front axle and the rear wheels, and the rear wheels' drive forces."""
    m, l_f, l_r = CAR.m, CAR.l_f, CAR.l_r
    if small:  # tie-vision (1)
        a_f = steer - (state.v_y + l_f * state.gamma) / state.v_x
    else:
        a_f = steer - math.atan((state.v_y + l_f * state.gamma) / state.v_x)
    a_r = (l_r * state.gamma - state.v_y) / state.v_x
    a_r = a_r if small else math.atan(a_r)
    capacity = [CAR.mu * m * 9.81 * arm / (2.0 * (l_f + l_r)) for arm in (l_r, l_f, l_f)]
    along = [0.0, T[0] / CAR.r, T[1] / CAR.r]
    found = []
    for C, angle, limit, F_x in zip(
        (CAR.C_f, CAR.C_r, CAR.C_r), (a_f, a_r, a_r), capacity, along, strict=True
    ):
        left = limit if small else math.sqrt(limit**2 - F_x**2)
        if law == LINEAR:
            found.append(C * angle)
            continue
        t = angle if small else math.tan(angle)
        if law == FIALA:
            z = min(max(C * t / (3.0 * left), -1.0), 1.0)
            found.append(left * (3.0 * z - 3.0 * z * abs(z) + z**3))
        else:
            tyre = Tyre(t, left, C / (3.0 * left))
            found.append(compute_lateral_forces(tyre, tyre, tyre, tyre, law, small)[0])
    return [2.0 * found[0], *found[1:], *along[1:]]


@given(st.floats(4.0, 20.0), speeds, speeds, st.floats(-0.5, 0.5), st.floats(-100.0, 100.0), speeds)
def test_equations_written_out_slowly(
    v_x: float, v_y: float, gamma: float, steer: float, torque: float, psi: float
) -> None:
    """The drive forces of two tyres differ, so that each one's friction circle is seen."""
    T = (torque, 60.0)
    state = motion(v_x=v_x, v_y=v_y, gamma=gamma, psi=psi, theta=0.3, y=2.0)
    for small, law in PLANTS:
        how = {"small_angle": small, "law": law, "road": CIRCLE}
        rate = slope(state, steer, T, push=DisturbanceForces(30.0, -7.0), **how)
        F_yf, F_l, F_r, F_xl, F_xr = forces(state, steer, T, small, law)
        s, c = (0.0, 1.0) if small else (math.sin(steer), math.cos(steer))
        turning = 0.0 if small else v_y * gamma
        N_z = CAR.d_r / 2.0 * (F_xr - F_xl)
        error = 1e-10  # some roundings of forces up to 1e4 N
        assert CAR.m * (rate.v_x - turning) == pytest.approx(F_xl + F_xr - F_yf * s, abs=error)
        across = F_yf * c + F_l + F_r + 30.0
        assert CAR.m * (rate.v_y + v_x * gamma) == pytest.approx(across, abs=error)
        moment = CAR.l_f * F_yf * c - CAR.l_r * (F_l + F_r) + N_z - 7.0
        assert CAR.I * rate.gamma == pytest.approx(moment, abs=error)
        assert rate.psi == gamma
        if small:  # tie-vision (5), and the road's direction
            assert v_x * psi + v_y == rate.Y
            assert rate.y == v_x * (psi - 0.3) + v_y
            assert (rate.X, rate.s, rate.theta) == (v_x, v_x, v_x * 0.02)


@pytest.mark.smoke
@pytest.mark.parametrize(("small_angle", "law"), PLANTS)
def test_straight_on_is_exactly_straight(small_angle: int, law: int) -> None:
    rate = slope(motion(v_x=10.0), T=(30.0, 30.0), small_angle=small_angle, law=law)
    assert rate.v_x == pytest.approx(2.0 * 30.0 / CAR.r / CAR.m, rel=1e-15)  # Newton, one rounding
    assert rate._replace(v_x=0.0) == motion(X=10.0, s=10.0)


@pytest.mark.parametrize(("small_angle", "law"), PLANTS)
def test_standing_still_stays_so(small_angle: int, law: int) -> None:
    assert slope(motion(), steer=0.5, small_angle=small_angle, law=law) == motion()


@pytest.mark.parametrize(("small_angle", "law"), PLANTS)
def test_pushes_and_moments_act_as_newton_says(small_angle: int, law: int) -> None:
    how = {"small_angle": small_angle, "law": law}
    rate = slope(motion(v_x=10.0), push=DisturbanceForces(190.0, 40.0), T=(-11.0, 11.0), **how)
    assert rate.v_y == pytest.approx(190.0 / CAR.m, rel=1e-15)
    # the motors' moment: two forces of 11 N m / r at half a track from the middle
    assert rate.gamma == pytest.approx((40.0 + 11.0 / CAR.r * CAR.d_r) / CAR.I, rel=1e-15)
    assert rate.v_x == 0.0


@given(speeds, speeds, st.floats(-0.5, 0.5), st.floats(-20.0, 20.0), st.sampled_from([0, 1]))
def test_rolling_tyres_never_add_energy(
    v_y: float, gamma: float, steer: float, v_x: float, law: int
) -> None:
    rate = slope(motion(v_x=v_x, v_y=v_y, gamma=gamma), steer, law=law)
    power = CAR.m * (v_x * rate.v_x + v_y * rate.v_y) + CAR.I * gamma * rate.gamma
    size = CAR.m * (abs(v_x * rate.v_x) + abs(v_y * rate.v_y)) + CAR.I * abs(gamma * rate.gamma)
    # the terms cancel where the wheels roll freely: some roundings of them, and of the forces
    assert power <= 1e-14 * size + 1e-9


def test_without_forces_the_ground_sees_uniform_motion() -> None:
    free = CAR._replace(C_f=0.0, C_r=0.0)
    start = motion(v_x=8.0, v_y=1.0, gamma=1.5, psi=0.3)
    end = drive(start, 1.0, 1e-3, car=free, law=LINEAR)
    for state in (start, end):
        s, c = math.sin(state.psi), math.cos(state.psi)
        ground = (c * state.v_x - s * state.v_y, s * state.v_x + c * state.v_y)
        expected = (c0 := math.cos(0.3)) * 8.0 - (s0 := math.sin(0.3)), s0 * 8.0 + c0
        # Kutta's error on a rotation: (gamma h)^4 / 24 a step, 1000 steps, 8 m/s: 1.7e-9
        assert ground == pytest.approx(expected, abs=2e-9)
    assert (end.gamma, end.psi) == (1.5, pytest.approx(1.8, abs=1e-12))
    # straight on the ground, from the origin, for one second
    assert pytest.approx(expected, abs=2e-9) == (end.X, end.Y)


@given(speeds, speeds, st.floats(-0.5, 0.5), speeds, st.sampled_from(PLANTS))
def test_mirrored_car_moves_as_the_mirror_image(
    v_y: float, gamma: float, steer: float, psi: float, plant: tuple[int, int]
) -> None:
    how = {"small_angle": plant[0], "law": plant[1]}
    left = motion(v_x=7.0, v_y=v_y, gamma=gamma, psi=psi, y=2.0)
    right = motion(v_x=7.0, v_y=-v_y, gamma=-gamma, psi=-psi, y=-2.0)
    one = slope(left, steer, (20.0, -5.0), push=DisturbanceForces(30.0, 4.0), **how)
    other = slope(right, -steer, (-5.0, 20.0), push=DisturbanceForces(-30.0, -4.0), **how)
    assert other == one._replace(
        v_y=-one.v_y, gamma=-one.gamma, psi=-one.psi, Y=-one.Y, y=-one.y, theta=-one.theta,
        slip_f=-one.slip_f, slip_r=-one.slip_r,
    )  # fmt: skip


@given(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0), speeds, st.floats(-10.0, 10.0))
def test_place_follows_heading_and_road(v_x: float, v_y: float, theta: float, psi: float) -> None:
    rate = slope(motion(v_x=v_x, v_y=v_y, psi=psi, theta=theta, y=3.0), road=CIRCLE)
    turn = psi - theta
    along = v_x * math.cos(turn) - v_y * math.sin(turn)
    # products of numbers up to 10 with sines of angles up to 13, each within its stated error
    error = 1e-13
    assert pytest.approx(v_x * math.cos(psi) - v_y * math.sin(psi), abs=error) == rate.X
    assert pytest.approx(v_x * math.sin(psi) + v_y * math.cos(psi), abs=error) == rate.Y
    assert pytest.approx(v_x * math.sin(turn) + v_y * math.cos(turn), abs=error) == rate.y
    assert pytest.approx(along / (1.0 - 0.02 * 3.0), abs=error) == rate.s
    assert rate.theta == 0.02 * rate.s


def test_road_coordinates_and_ground_agree_after_a_long_bend() -> None:
    start = motion(v_x=10.0, v_y=0.1, gamma=0.2)  # 50 m from the centre at (0, 50)
    end = drive(start, 20.0, 1e-3, steer=0.025, road=CIRCLE)
    assert end.theta > 1.0
    assert end.y > 5.0
    place = np.array([end.X, end.Y])
    radius = 1.0 / 0.02 - end.y
    expected = [radius * math.sin(end.theta), 50.0 - radius * math.cos(end.theta)]
    # the error that `_integrate_motion` names, 1e-7 m a second, for 20 s
    assert np.max(np.abs(place - expected)) < 2e-6
    assert end.theta == pytest.approx(0.02 * end.s, abs=1e-11)  # as many, up to 5 rad


@pytest.mark.parametrize("car", [CAR, make_car(PASSENGER_CAR)])
@pytest.mark.parametrize("roll", [0, 1])
@pytest.mark.parametrize("law", [LINEAR, FIALA])
@pytest.mark.parametrize(("rule", "order"), [(kutta3, 3), (rk4, 4)])
def test_the_rules_have_their_orders(
    rule: Any, order: int, law: int, roll: int, car: CarParams
) -> None:
    """Slip angles keep their signs here: at zero Fiala's curve has a jump in its second slope."""
    start = motion(v_x=12.0, v_y=-0.2, gamma=0.3)
    steps = [0.008, 0.004, 0.002]
    how: Any = {"law": law, "rule": rule, "roll": roll}
    exact = np.array(drive(start, 0.8, 0.00025, 0.06, car, **how))
    errors = [np.abs(drive(start, 0.8, h, 0.06, car, **how) - exact).max() for h in steps]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # the next term of the error is h times smaller: the estimate tends to the order as h
    assert abs(orders[1] - order) < 0.8 * abs(orders[0] - order) < 0.2


@pytest.mark.parametrize("speed", [0.0, 0.3, -2.0, 5.0])
@pytest.mark.parametrize("mu", [1e-9, 0.9])
def test_any_speed_and_hardly_any_friction_stay_finite(speed: float, mu: float) -> None:
    car = CAR._replace(mu=mu, mu_r=mu)
    load = compute_tyre_load(TyreInputs(0.4, -100.0, 100.0), car, PlantVariant(0, LINEAR))
    state = motion(v_x=speed)
    for _ in range(3000):
        state = kutta3(state, (load, load, load), CALM, car, CIRCLE, 1e-3, PlantVariant(0, FIALA))
    assert np.all(np.isfinite(state))
    if mu == 1e-9:  # ice: the car goes on as it went
        assert math.hypot(state.v_x, state.v_y) == pytest.approx(abs(speed), abs=1e-6)


def relaxed_rates(t: float, x: Any, car: CarParams, steer: Any, roll: int) -> list[float]:
    """The right-hand side of a car on four relaxing tyres, by Pacejka (2006), written out slowly.

    x: v_x, v_y, gamma, phi, phi_dot and the slips of both axles; alike torques of 10 N m.
    """
    v_x, v_y, gamma, phi, phi_dot, slip_f, slip_r = x
    delta, F_x, g = steer(t), 10.0 / car.r, 9.81
    direct = (car.m * car.h - car.S) * v_x * gamma
    moment = (car.K_x * phi + car.C_x * phi_dot + direct) * roll
    axles = []
    for slip, arm, track, C, drive in (
        (slip_f, car.l_r, car.d_f, car.C_f, 0.0), (slip_r, car.l_f, car.d_r, car.C_r, F_x),
    ):  # fmt: skip
        F_z0 = car.m * g * arm / (2.0 * (car.l_f + car.l_r))
        total = 0.0
        for side in (-1.0, 1.0):  # the left wheel gives load to the right one
            F_z = F_z0 * (1.0 + side * moment / (0.5 * car.m * g * track))
            df_z = F_z / F_z0 - 1.0
            D = math.sqrt((car.mu * F_z * (1.0 - 0.145 / 0.990 * df_z)) ** 2 - drive**2)
            K = C * math.sin(2.0 * math.atan(F_z / (2.13 * F_z0)))
            B = K / math.sin(2.0 * math.atan(1.0 / 2.13)) / (1.193 * D)
            E = -1.003 - 0.537 * df_z
            angle = math.atan(B * slip - E * (B * slip - math.atan(B * slip)))
            total += D * math.sin(1.193 * angle)
        axles.append(total)
    s, c = math.sin(delta), math.cos(delta)
    front = v_y + car.l_f * gamma
    F_y = axles[0] * c + axles[1]
    I_phi = car.I_x - car.S**2 / car.m
    dphi_dot = car.S * (F_y / car.m + g * phi) - car.C_x * phi_dot - car.K_x * phi
    dphi_dot *= roll / I_phi
    return [
        (2.0 * F_x - axles[0] * s) / car.m + v_y * gamma,
        (F_y + car.S * dphi_dot) / car.m - v_x * gamma,
        (car.l_f * axles[0] * c - car.l_r * axles[1]) / car.I,
        roll * phi_dot,
        dphi_dot,
        ((v_x * s - front * c) - (v_x * c + front * s) * slip_f) / car.relaxation,
        (car.l_r * gamma - v_y - v_x * slip_r) / car.relaxation,
    ]


@pytest.mark.parametrize("roll", [0, 1])
@pytest.mark.parametrize(("vehicle", "V"), [(COMS, 9.0), (PASSENGER_CAR, 20.0)])
def test_relaxing_tyres_by_an_independent_integration(vehicle: Any, V: float, roll: int) -> None:
    """Three seconds of a sine steer near the limit by DOP853; mirrored bit for bit."""
    car, variant = make_car(vehicle.replace(relaxation=0.3)), PlantVariant(0, MAGIC_FORMULA, roll)

    def drive_sine(amplitude: float) -> Motion:
        state = motion(v_x=V)
        for k in range(3000):
            angles = (amplitude * math.sin(3.0e-3 * (k + part)) for part in (0.0, 0.5, 1.0))
            a, b, c = (compute_tyre_load(TyreInputs(x, 10.0, 10.0), car, variant) for x in angles)
            state = kutta3(state, (a, b, c), CALM, car, STRAIGHT, 1e-3, variant)
        return state

    end = drive_sine(0.08)
    names = ["v_x", "v_y", "gamma", "phi", "phi_dot", "slip_f", "slip_r"]
    exact = scipy.integrate.solve_ivp(
        relaxed_rates, (0.0, 3.0), [V, *[0.0] * 6], "DOP853", rtol=1e-11, atol=1e-11,
        args=(car, lambda t: 0.08 * math.sin(3.0 * t), roll),
    )  # fmt: skip
    found = np.array([getattr(end, name) for name in names])
    assert np.abs(found - exact.y[:, -1]).max() < 1e-5, np.abs(found - exact.y[:, -1])  # SI units
    assert np.abs(exact.y[5:]).max() > 0.06  # rad of slip: far from linear
    odd = ("v_y", "gamma", "psi", "Y", "y", "phi", "phi_dot", "slip_f", "slip_r")
    mirror = {name: -getattr(end, name) for name in odd}
    assert drive_sine(-0.08) == end._replace(**mirror)


@pytest.mark.parametrize("small_angle", [0, 1])
def test_a_step_in_slip_reaches_63_percent_after_the_relaxation_length(small_angle: int) -> None:
    """Of a car that is too heavy to turn; without a length the force is there at once."""
    V, delta, forces = 10.0, 0.01, []
    for relaxation in (0.4, 0.0):
        car = CAR._replace(m=1e12, I=1e12, relaxation=relaxation)
        inputs, linear = TyreInputs(delta, 0.0, 0.0), PlantVariant(small_angle, LINEAR)
        load = compute_tyre_load(inputs, car, linear)
        variant, state = PlantVariant(small_angle, MAGIC_FORMULA), motion(v_x=V)
        for _ in range(40):  # 0.4 m
            state = kutta3(state, (load, load, load), CALM, car, STRAIGHT, 1e-3, variant)
        forces.append(derivative(state, load, CALM, car, STRAIGHT, variant).gamma)
        tangent = delta if small_angle else math.tan(delta)
        along = 1.0 if small_angle else math.cos(delta)
        assert state.slip_r == pytest.approx(0.0, abs=1e-9)
        share = 1.0 - math.exp(-along) if relaxation else 0.0
        assert state.slip_f == pytest.approx(share * tangent, rel=1e-6)
    assert forces[0] / forces[1] == pytest.approx(1.0 - math.exp(-1.0), rel=1e-4)


def test_relaxing_tyres_are_stable_at_a_standstill_and_backwards() -> None:
    car = make_car(COMS.replace(relaxation=0.05))
    load = compute_tyre_load(TyreInputs(0.5, 20.0, -20.0), car, PlantVariant(0, FIALA, 1))
    variant = PlantVariant(0, MAGIC_FORMULA)
    for V in (0.0, 0.01, -3.0, 30.0):
        state = motion(v_x=V, v_y=0.3)._replace(slip_f=0.5, slip_r=-0.5)
        for _ in range(3000):
            state = kutta3(state, (load, load, load), CALM, car, CIRCLE, 1e-3, variant)
        assert np.all(np.isfinite(state))
        assert max(abs(state.slip_f), abs(state.slip_r)) < 20.0
