"""Roll: equations (1)-(7) of double-layer-gps written out, energy, and load from side to side."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.layout import P
from sideslip.envs.numerics.packed import read
from sideslip.envs.record import FAST
from sideslip.envs.vehicle.dynamics import (
    CarParams,
    DisturbanceForces,
    Motion,
    RoadParams,
    compute_gravity,
    derivative,
    kutta3,
)
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.envs.vehicle.tyres import (
    DUGOFF,
    FIALA,
    LINEAR,
    TYRE_LAWS,
    PlantVariant,
    TyreInputs,
    _compute_load_transfer,
    compute_tyre_forces,
    compute_tyre_load,
)

from ..helpers import LINEAR as PAPER
from ..helpers import fast_rows, play, unwrapped

pytestmark = pytest.mark.plain

CARS = [make_car(car)._replace(relaxation=0.0) for car in (COMS, PASSENGER_CAR)]
CAR = CARS[0]
FLAT = RoadParams(0.0, 0.0, 1.0)
BANKED = RoadParams(0.0, -1e6, 1.0, 9.81 * math.sin(0.2), 9.81 * math.sin(-0.1))
CALM = DisturbanceForces(0.0, 0.0)
small = st.floats(-0.3, 0.3)
PLANTS = [(small_angle, law) for small_angle in (0, 1) for law in range(len(TYRE_LAWS))]


def slope(
    state: Motion, push: DisturbanceForces = CALM, car: CarParams = CAR, road: RoadParams = FLAT,
    **how: Any,
) -> Any:  # fmt: skip
    small_angle, law = how.get("small_angle", 0), how.get("law", LINEAR)
    inputs = TyreInputs(how.get("steer", 0.0), *how.get("T", (0.0, 0.0)))
    load = compute_tyre_load(inputs, car, PlantVariant(small_angle, LINEAR))
    return derivative(state, load, push, car, road, PlantVariant(small_angle, law, 1))


@given(st.floats(3.0, 20.0), small, small, small, st.floats(-2.0, 2.0), small)
def test_double_layer_1_to_7_written_out(
    v_x: float, v_y: float, gamma: float, phi: float, phi_dot: float, steer: float
) -> None:
    """On the papers' plant; a_y is what an accelerometer measures."""
    state = Motion(v_x, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi, phi_dot)
    F_yd, N_zd, N_xd, T = 50.0, -20.0, 30.0, (20.0, 60.0)
    rate = slope(state, DisturbanceForces(F_yd, N_zd, N_xd), steer=steer, T=T, small_angle=1)
    beta, M, g = v_y / v_x, CAR.m, 9.81
    F_yf = -2.0 * CAR.C_f * (beta + CAR.l_f / v_x * gamma - steer)  # (6)
    F_yr = -2.0 * CAR.C_r * (beta - CAR.l_r / v_x * gamma)  # (7)
    N_z = CAR.d_r / 2.0 * (60.0 - 20.0) / CAR.r
    error = 1e-9  # roundings of forces up to 1e5 N
    coupled = M * (rate.v_y + v_x * gamma) - 300.0 * 0.35 * rate.phi_dot
    assert coupled == pytest.approx(F_yf + F_yr + F_yd, abs=error)  # (1), v_x beta' = v_y'
    moment = F_yf * CAR.l_f - F_yr * CAR.l_r + N_z + N_zd
    assert pytest.approx(moment, abs=error) == CAR.I * rate.gamma  # (2)
    a_y = rate.v_y + gamma * v_x + g * phi  # (5)
    body = 60.0 * rate.phi_dot + 324.0 * phi_dot + 8000.0 * phi
    assert body == pytest.approx(300.0 * 0.35 * a_y + N_xd, abs=error)  # (3)
    assert rate.v_x == pytest.approx(80.0 / CAR.r / M + gamma * v_y, abs=1e-12)  # (4)
    assert rate.phi == phi_dot


@given(small, small, st.floats(-2.0, 2.0), st.sampled_from(CARS), st.sampled_from(PLANTS))
def test_both_laws_hold_on_every_plant_and_on_a_bank(
    v_y: float, phi: float, phi_dot: float, car: CarParams, plant: tuple[int, int]
) -> None:
    state = Motion(9.0, v_y, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi, phi_dot)
    how: dict[str, Any] = {"car": car, "road": BANKED, "small_angle": plant[0], "law": plant[1]}
    rate = slope(state, DisturbanceForces(70.0, 0.0, 25.0), **how)
    felt = compute_gravity(state, BANKED, plant[0])
    a_y = rate.v_y + 0.2 * 9.0 + felt[1] + 9.81 * phi
    body = car.I_x * rate.phi_dot + car.C_x * phi_dot + car.K_x * phi
    # roundings of moments up to 1e5 N m
    assert body == pytest.approx(car.S * a_y + 25.0, abs=1e-9)
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, PlantVariant(plant[0], LINEAR))
    F_yf, F_yr, _, _ = compute_tyre_forces(state, load, car, felt[1], PlantVariant(*plant, 1))
    a = rate.v_y + 0.2 * 9.0 + felt[1]
    assert car.m * a - car.S * rate.phi_dot == pytest.approx(F_yf + F_yr + 70.0, abs=1e-8)


def test_a_bank_is_felt_and_pulls_down_and_a_grade_pulls_back() -> None:
    """No forces but gravity: the car falls across and along, and accelerometers feel nothing."""
    car = CAR._replace(C_f=0.0, C_r=0.0, S=0.0)
    for psi in (0.0, 0.5, -2.0, math.pi):
        state = Motion(0.0, 0.0, 0.0, psi, 0.0, 0.0, 0.0, 0.0, 0.0)
        rate = slope(state, car=car, road=BANKED)
        s, c = math.sin(psi), math.cos(psi)
        ground = c * rate.v_x - s * rate.v_y, s * rate.v_x + c * rate.v_y
        # bank 0.2: the left side is up, the car slides right; grade -0.1: downhill, forward
        assert ground == pytest.approx((9.81 * math.sin(0.1), -9.81 * math.sin(0.2)), abs=1e-12)
        felt = compute_gravity(state, BANKED, 0)
        assert (rate.v_x + felt[0], rate.v_y + felt[1]) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_bank_and_grade_come_in_along_the_road() -> None:
    road = RoadParams(0.0, 10.0, 20.0, 2.0, 1.0)
    for s, share in ((0.0, 0.0), (10.0, 0.0), (15.0, 0.25), (30.0, 1.0), (90.0, 1.0)):
        state = Motion(*[0.0] * 9)._replace(s=s)
        assert compute_gravity(state, road, 1) == (share, 2.0 * share)


def test_a_mirrored_bend_leans_to_the_other_side() -> None:
    scene = {"base": "straight", "mirror": True, "curvature": 0.01, "bank": 0.1, "grade": 0.05}
    env, across = StabilityEnv(scenario=scene), GRAVITY * math.sin(0.1)
    leans = set()
    for seed in range(8):
        env.reset(seed=seed)
        road = read(env.get_state()["params"], P.road)
        assert road.lateral == math.copysign(across, road.curvature)
        assert road.longitudinal == GRAVITY * math.sin(0.05)
        leans.add(road.curvature)
    assert leans == {-0.01, 0.01}


def test_an_undamped_body_on_tyres_without_force_keeps_its_energy() -> None:
    car = CAR._replace(C_f=0.0, C_r=0.0, C_x=0.0)
    load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), car, PlantVariant(0, LINEAR))
    state = Motion(7.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.5)

    def energy(x: Motion) -> float:
        moving = 0.5 * car.m * x.v_y**2 - car.S * x.v_y * x.phi_dot + 0.5 * car.I_x * x.phi_dot**2
        return float(moving + 0.5 * (car.K_x - car.S * 9.81) * x.phi**2)

    before, momentum = energy(state), car.m * state.v_y - car.S * state.phi_dot
    for _ in range(2000):
        state = kutta3(state, (load, load, load), CALM, car, FLAT, 1e-3, PlantVariant(0, LINEAR, 1))
    # Kutta's own error: (w h)^4 / 12 of the energy a step, w = 15 / s
    assert energy(state) == pytest.approx(before, rel=2000 * 4.3e-9)
    assert car.m * state.v_y - car.S * state.phi_dot == pytest.approx(momentum, rel=1e-12)


def test_a_left_turn_rolls_the_body_to_the_right_to_its_static_angle() -> None:
    turning = PAPER | {"roll": True, "steering": "step", "amplitude": 0.02, "hold": 100.0}
    env = StabilityEnv(scenario=turning | {"half_width": 1e3})
    env.reset(seed=0)
    row = fast_rows(play(env, [0.0] * 600))[-1]
    phi, a_y = env.motion.phi, row[FAST.accel_y]
    assert phi > 0.0
    # the driver's hand on the speed still moves
    assert 8000.0 * phi == pytest.approx(300.0 * 0.35 * a_y, rel=1e-5)
    lateral = env.motion.v_x * env.motion.gamma
    assert a_y == pytest.approx(lateral + 9.81 * phi, rel=1e-5)


@given(small, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.sampled_from(CARS))
def test_loads_move_by_the_moment_and_keep_their_sum(
    phi: float, phi_dot: float, gamma: float, car: CarParams
) -> None:
    phi *= 0.1
    state = Motion(8.0, 0.0, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi, 0.1 * phi_dot)
    front, rear = _compute_load_transfer(state, car, 0.5)
    weight = car.m * 9.81
    on_front, on_rear = (weight * arm / (car.l_f + car.l_r) for arm in (car.l_r, car.l_f))
    moment = (front * on_front * car.d_f + rear * on_rear * car.d_r) / 2.0
    suspension = car.K_x * phi + car.C_x * 0.1 * phi_dot
    expected = suspension + (car.m * car.h - car.S) * (8.0 * gamma + 0.5)
    if max(abs(front), abs(rear)) < 0.9:
        assert moment == pytest.approx(expected, rel=1e-12, abs=1e-9)
    assert max(abs(front), abs(rear)) <= 0.9


def test_load_transfer_costs_tyres_with_a_limit_grip_and_nothing_else() -> None:
    upright = Motion(8.0, -0.8, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    leaning = upright._replace(phi=0.15)
    for small_angle, law in PLANTS:
        load = compute_tyre_load(TyreInputs(0.0, 0.0, 0.0), CAR, PlantVariant(small_angle, LINEAR))
        flat = compute_tyre_forces(upright, load, CAR, 0.0, PlantVariant(small_angle, law))
        held = compute_tyre_forces(upright, load, CAR, 0.0, PlantVariant(small_angle, law, 1))
        lost = compute_tyre_forces(leaning, load, CAR, 0.0, PlantVariant(small_angle, law, 1))
        np.testing.assert_allclose(held, flat, rtol=1e-14, atol=0.0)
        if law != LINEAR and not small_angle:
            assert 0.0 < lost[0] < 0.99 * flat[0]
            assert 0.0 < lost[1] < 0.99 * flat[1]
            image = leaning._replace(phi=-0.15)
            mirror = compute_tyre_forces(image, load, CAR, 0.0, PlantVariant(0, law, 1))
            np.testing.assert_allclose(mirror, lost, rtol=1e-14)
        else:
            assert lost == flat


@pytest.mark.parametrize("law", [FIALA, DUGOFF])
@given(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-0.2, 0.2), small)
def test_rear_tyres_stay_within_the_friction_circle_of_their_own_load(
    law: int, T_l: float, T_r: float, phi: float, v_y: float
) -> None:
    state = Motion(8.0, 10.0 * v_y, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, phi)
    load = compute_tyre_load(TyreInputs(0.0, T_l, T_r), CAR, PlantVariant(0, LINEAR))
    _, F_yr, F_x, N_z = compute_tyre_forces(state, load, CAR, 0.0, PlantVariant(0, law, 1))
    share = _compute_load_transfer(state, CAR, 0.0)[1]
    left, right = load.rear_l * (1.0 - share), load.rear_r * (1.0 + share)
    F_l, F_r = 0.5 * F_x - N_z / CAR.d_r, 0.5 * F_x + N_z / CAR.d_r
    assert abs(F_l) <= left * (1.0 + 1e-12)
    assert abs(F_r) <= right * (1.0 + 1e-12)
    # 5 % of the lateral force is kept under full drive
    most = sum(
        max(math.sqrt(max(limit**2 - F**2, 0.0)), 0.05 * limit)
        for limit, F in ((left, F_l), (right, F_r))
    )
    assert abs(F_yr) <= most + 1e-6 * load.rear_l


def test_wind_at_a_height_pushes_the_body_over() -> None:
    gust = PAPER | {"roll": True, "wind_force": 200.0, "wind_length": 9.0, "wind_height": 0.5}
    env = StabilityEnv(scenario=gust, control_period=1)
    env.reset(seed=0)
    play(env, [0.0])
    # (1) and (3) for a car at rest: M a - S p' = F, I_x p' = S a - 0.5 F
    M, S, I_x = 380.0, 105.0, 60.0
    expected = (S * 200.0 / M - 100.0) / (I_x - S**2 / M)
    # after 1 ms the damping takes C_x / (I_x - S^2 / M) h = 1 % of it, the tyres as much
    assert env.motion.phi_dot == pytest.approx(1e-3 * expected, rel=0.02)
    assert expected < 0.0  # the wind blows to the left at the top


def test_without_roll_nothing_of_it_stirs() -> None:
    env = unwrapped("sideslip/YawVision-v0", scenario={"base": "slalom", "roll": False})
    env.reset(seed=0)
    play(env, [0.5] * 100)
    assert (env.motion.phi, env.motion.phi_dot) == (0.0, 0.0)
    env = unwrapped("sideslip/YawVision-v0", scenario="slalom")
    env.reset(seed=0, options={"state": {"phi": 0.1, "phi_dot": -0.2}})
    assert (env.motion.phi, env.motion.phi_dot) == (0.1, -0.2)
    assert env.record.fast[0, FAST.roll_rate] == pytest.approx(-0.2, abs=0.03)  # six sigma


def test_what_cannot_roll_is_refused() -> None:
    env = StabilityEnv(scenario=PAPER)
    with pytest.raises(ValueError, match=r"phi is 0\.1, but scenario 'straight' has no roll"):
        env.reset(options={"state": {"phi": 0.1}})
    heavy = {"base": "coms", "roll_stiffness": 500.0}
    with pytest.raises(ValueError, match="does not hold the body upright"):
        StabilityEnv(vehicle=heavy)
    StabilityEnv(vehicle=heavy, scenario=PAPER)
