"""Roads that follow the path of the nominal car under the programme's steering."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sideslip.envs import COMS, StabilityEnv
from sideslip.envs.engine.layout import P, Z
from sideslip.envs.record import FAST, PACKET, concatenate
from sideslip.envs.scenarios.driver import compute_steering
from sideslip.envs.vehicle.linear import make_bicycle_model

SLALOM: dict[str, Any] = {"base": "slalom", "amplitude": 0.05, "duration": 4.0}
WINDING = SLALOM | {"road": "nominal-path"}


def drive(scenario: Any, action: float = 0.0, steps: int = 400, **more: Any) -> Any:
    """(record, states at the ends of steps, params)."""
    env = StabilityEnv("fusion", scenario, control_period=10, **more)
    env.reset(seed=3)
    records, states = [env.record], [env.get_state()["state"].copy()]
    for _ in range(steps):
        env.step(np.array([action], np.float32))
        records.append(env.record)
        states.append(env.get_state()["state"].copy())
    return concatenate(records), np.array(states), env.get_state()["params"]


def test_its_direction_is_that_of_the_nominal_cars_path() -> None:
    """psi + beta of the linear bicycle, integrated by another's integrator."""
    _, states, p = drive(WINDING)
    programme, V = p[P.steering_profile[0] :], float(p[P.speed_profile.speed])
    model = make_bicycle_model(COMS, V)

    def slope(t: float, x: Any) -> Any:
        return [*(model.A @ x[:2] + model.B[:, 0] * compute_steering(1000.0 * t, programme)), x[1]]

    times = np.arange(len(states)) * 0.01
    found = solve_ivp(slope, (0.0, times[-1]), np.zeros(3), t_eval=times, rtol=1e-9, atol=1e-12)
    theta = states[:, Z.motion.theta]
    assert np.abs(theta).max() > 0.1
    assert np.abs(theta - (found.y[2] + found.y[0])).max() < 3e-3 * np.abs(theta).max()  # Euler


def test_it_is_the_seeds_and_not_the_controls() -> None:
    calm, loud = drive(WINDING), drive(WINDING, action=0.3)
    for part in (Z.nominal_motion.beta, Z.nominal_motion.gamma):
        np.testing.assert_array_equal(calm[1][:, part], loud[1][:, part])
    theta = Z.motion.theta
    np.testing.assert_allclose(calm[1][:, theta], loud[1][:, theta], atol=1e-14)
    assert np.abs(calm[1][:, Z.motion.psi] - loud[1][:, Z.motion.psi]).max() > 0.1


def test_the_column_is_the_turn_of_a_metre_and_zero_on_a_straight_road() -> None:
    record, states, _ = drive(WINDING)
    turned = np.cumsum(record.fast[:, FAST.curvature] * np.r_[0.0, _speed(record)[:-1]]) * 1e-3
    theta = states[:, Z.motion.theta]
    assert np.abs(turned[::10] - theta).max() < 0.02 * np.abs(theta).max()  # noisy wheels
    assert not drive(SLALOM)[0].fast[:, FAST.curvature].any()
    curved, _, _ = drive({"base": "straight", "curvature": 0.02, "curve_start": -1e3}, steps=20)
    np.testing.assert_allclose(np.abs(curved.fast[:, FAST.curvature]), 0.02)  # mirrored


def _speed(record: Any) -> Any:
    return 0.5 * (record.fast[:, FAST.wheel_left] + record.fast[:, FAST.wheel_right])


def test_the_plant_itself_does_not_notice() -> None:
    """What the road does is seen by the camera alone, and the fast row's last column."""
    (one, a, _), (other, b, _) = drive(SLALOM), drive(WINDING)
    np.testing.assert_allclose(one.fast[:, :11], other.fast[:, :11], atol=1e-9)
    for name in ("v_x", "v_y", "gamma", "psi", "X", "Y"):
        at = getattr(Z.motion, name)
        np.testing.assert_allclose(a[:, at], b[:, at], atol=1e-9, err_msg=name)


def test_the_camera_reports_y_l_without_the_bend() -> None:
    quiet = {"noise": {"camera_psi": 0.0, "camera_y": 0.0}}
    record, states, _ = drive(WINDING | quiet, camera={"period": 0.01, "delays": (0.0,)})
    psi, y_l = record.select_packets("camera")[:, PACKET.value : PACKET.value + 2].T
    relative = states[:, Z.motion.psi] - states[:, Z.motion.theta]
    np.testing.assert_allclose(psi, relative, atol=1e-14)
    np.testing.assert_allclose(y_l, states[:, Z.motion.y] + 5.135 * relative, atol=1e-14)


@pytest.mark.parametrize("n", [1, 33])
def test_a_snapshot_and_other_control_periods_go_on_with_its_bits(n: int) -> None:
    env = StabilityEnv("fusion", WINDING, control_period=n)
    env.reset(seed=3)
    for _ in range(330 // n):
        env.step(np.zeros(1, np.float32))
    state, snapshot = env.get_state()["state"], env.get_state()
    np.testing.assert_array_equal(state, drive(WINDING, steps=33)[1][-1])
    ends = []
    for _ in range(2):
        env.set_state(snapshot)
        env.step(np.zeros(1, np.float32))
        ends.append(env.get_state()["state"].copy())
    np.testing.assert_array_equal(*ends)


def test_braking_cars_are_followed_at_the_speed_that_their_drivers_want() -> None:
    brake = WINDING | {"speed_change": -4.0, "change_start": 0.5, "change_length": 2.0}
    _, states, _ = drive(brake)
    even = drive(WINDING)[1]
    slow, fast = (np.abs(x[300:, Z.nominal_motion.gamma]).max() for x in (states, even))
    assert slow < 0.8 * fast
    assert math.isfinite(float(np.abs(states[:, Z.motion.theta]).max()))
