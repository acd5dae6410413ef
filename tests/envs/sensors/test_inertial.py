"""The accelerometers and the roll gyro: what a body that rolls and a road on a slope do to them."""

import math

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.record import FAST

from ..helpers import FULL, LINEAR, fast_rows, play

pytestmark = pytest.mark.plain


def test_the_roll_gyro_and_the_accelerometer_sense_the_body() -> None:
    turning = FULL | {"roll": True, "steering": "sine", "amplitude": 0.05}
    env = StabilityEnv(scenario=turning, control_period=1)
    env.reset(seed=0)
    before, most = env.motion, 0.0
    for _ in range(1500):
        (moment,) = play(env, [0.0])
        row, now = moment.record.fast[0], env.motion
        assert row[FAST.roll_rate] == now.phi_dot
        lateral = (now.v_y - before.v_y) / 1e-3 + 0.5 * (
            now.gamma * now.v_x + before.gamma * before.v_x
        )
        gravity = 9.81 * 0.5 * (now.phi + before.phi)
        assert row[FAST.accel_y] == pytest.approx(lateral + gravity, abs=1e-12)
        before, most = now, max(most, abs(gravity))
    assert most > 0.2


@pytest.mark.parametrize("small_angle", [True, False])
def test_accelerometers_on_a_slope_feel_gravity(small_angle: bool) -> None:
    """The driver holds speed and line against it: what is felt is the road's reaction."""
    slope = {"bank": 0.1, "grade": 0.05, "curve_start": -1e3, "lags": False, "friction": 5.0}
    plant = {"small_angle": small_angle, "tyres": "linear", "acceleration": 0.0}
    env = StabilityEnv(scenario=LINEAR | plant | slope | {"duration": 1.0}, strict=False)
    env.reset(seed=0)
    start = env.record.fast[0]
    assert start[FAST.accel_x] == pytest.approx(9.81 * math.sin(0.05), rel=1e-14)
    assert start[FAST.accel_y] == pytest.approx(9.81 * math.sin(0.1), rel=1e-14)
    rows = fast_rows(play(env, [0.0] * 2))
    # nobody drives: along the road the car falls freely; the tyres begin to hold it across
    np.testing.assert_allclose(rows[:, FAST.accel_x], 0.0, atol=2e-3)
    assert 0.0 < rows[-1, FAST.accel_y] < 9.81 * math.sin(0.1)
    assert env.motion.v_x < 25.0 / 3.6 - 0.019 * 9.81 * math.sin(0.05)
    assert env.motion.v_y < 0.0
