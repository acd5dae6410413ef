"""tie-vision (24): a yaw moment that keeps the sideslip angle at zero, exactly, at rest."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, StabilityEnv, Vehicle
from sideslip.envs.engine.config import make_car
from sideslip.envs.vehicle.dynamics import DisturbanceForces, Motion, RoadParams, derivative, kutta3
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.envs.vehicle.tyres import LINEAR, TyreInputs, compute_tyre_load

from .. import helpers

pytestmark = pytest.mark.plain

KMH = 1.0 / 3.6
SPEEDS = [v * KMH for v in (10.0, 15.0, 20.0, 20.73, 25.0, 30.0, 35.0, 40.0, 45.0)]
DELTA = 0.001
ROAD, CALM = RoadParams(0.0, 0.0, 1.0), DisturbanceForces(0.0, 0.0)


def gain(vehicle: Vehicle, V_x: float) -> float:
    """The right-hand side of tie-vision (24) as printed, in N m/rad."""
    m, l_f, l_r = vehicle.mass, vehicle.front_arm, vehicle.rear_arm
    C_f, C_r, l = vehicle.front_stiffness, vehicle.rear_stiffness, l_f + l_r  # noqa: E741
    above = 4.0 * l_r * l * C_f * C_r - 2.0 * l_f * C_f * m * V_x**2
    return above / (m * V_x**2 + 2.0 * (l_f * C_f - l_r * C_r))


@pytest.mark.parametrize("V_x", SPEEDS)
def test_it_is_minus_the_ratio_of_the_static_gains(V_x: float) -> None:
    """The middle of (24) lacks this minus: PAPERS section 2."""
    model = make_bicycle_model(COMS, V_x)
    (from_delta, from_moment), _ = np.linalg.solve(model.A, -model.B)
    scale = max(abs(gain(COMS, V_x)), 1e3)  # near 20.73 km/h the numerator is a difference
    assert -from_delta / from_moment == pytest.approx(gain(COMS, V_x), abs=1e-12 * scale)


def test_numbers_of_the_paper_car() -> None:
    assert round(gain(COMS, 25.0 * KMH)) == -2652
    assert gain(COMS, 20.72 * KMH) > 0.0 > gain(COMS, 20.74 * KMH)


@pytest.mark.smoke
@pytest.mark.parametrize("V_x", SPEEDS)
def test_the_plant_rests_at_zero_slip(V_x: float) -> None:
    model, N_z = make_bicycle_model(COMS, V_x), gain(COMS, V_x) * DELTA
    gamma = -(model.B[1] @ [DELTA, N_z]) / model.A[1, 1]
    T = 0.5 * N_z * COMS.wheel_radius / (0.5 * COMS.rear_track)
    load = compute_tyre_load(TyreInputs(DELTA, -T, T), make_car(COMS), 1)
    state = Motion(V_x, 0.0, gamma, *[0.0] * 6)
    rate = derivative(state, load, CALM, make_car(COMS), ROAD, 1, LINEAR)
    # sums of forces of some 10 N and moments of some 10 N m that cancel, over m and I
    assert abs(rate.v_y) < 1e-15
    assert abs(rate.gamma) < 1e-15


@pytest.mark.parametrize("V_x", SPEEDS)
def test_and_goes_there_from_straight_driving(V_x: float) -> None:
    N_z = gain(COMS, V_x) * DELTA
    T = 0.5 * N_z * COMS.wheel_radius / (0.5 * COMS.rear_track)
    load = compute_tyre_load(TyreInputs(DELTA, -T, T), make_car(COMS), 1)
    state, most = Motion(V_x, *[0.0] * 8), 0.0
    for _ in range(10_000):
        state = kutta3(state, (load, load, load), CALM, make_car(COMS), ROAD, 0.001, 1, LINEAR)
        most = max(most, abs(state.v_y / V_x))
    assert most > 1e-6
    # PAPERS section 3; at 45 km/h the slowest pole, 1.65 / s, leaves 7e-8 of some 1e-4 after 10 s
    assert abs(state.v_y / V_x) < 1e-9


@pytest.mark.compiled
@pytest.mark.parametrize("V_x", [SPEEDS[0], SPEEDS[4], SPEEDS[-1]])
def test_and_so_does_the_environment(V_x: float) -> None:
    held: dict[str, Any] = helpers.LINEAR | {
        "speed": V_x,
        "steering": "step",
        "amplitude": DELTA,
        "hold": 100.0,
    }
    env = StabilityEnv(scenario=held)
    env.reset(seed=0)
    action = gain(COMS, V_x) * DELTA / COMS.yaw_moment_limit
    moments = helpers.play(env, [action] * 1000)
    assert moments[-1].truncated
    assert moments[-1].info["steer"] == DELTA
    # an action of 32 bits is 6e-8 off, of a moment that alone would turn the slip by some 1e-4
    assert abs(moments[-1].info["beta"]) < 1e-9
