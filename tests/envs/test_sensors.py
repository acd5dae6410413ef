"""What the sensors measure: the state at the captured tick, plus noise of the stated size."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sideslip.envs import COMS, StabilityEnv
from sideslip.envs.dynamics import Motion, Road
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors import Noise, camera_sample, gps_sample

from .helpers import FULL, LINEAR, SILENT, fast_rows, packets, play

CALM = (0.0, 0.0, 0.0, 0.0)
QUIET = Noise()._replace(**SILENT)
SWERVING: dict[str, Any] = {
    "steering": "sine",
    "amplitude": 0.1,
    "frequency": 0.5,
    "duration": 100.0,
}


def drive(sensors: str = "vision", ticks: int = 2000, seed: int = 0, **changes: Any) -> Any:
    """(infos by tick, fast rows, packets) of an uncontrolled drive, the reset included."""
    arguments: dict[str, Any] = {"scenario": FULL | SWERVING, "control_period": 1}
    env = StabilityEnv(sensors, **(arguments | changes))
    _, info = env.reset(seed=seed)
    start = env.record
    moments = play(env, [0.0] * ticks)
    infos = [info, *[moment.info for moment in moments]]
    fast = np.concatenate([start.fast, fast_rows(moments)])
    return infos, fast, np.concatenate([start.packets, packets(moments)])


@pytest.mark.plain
@pytest.mark.smoke
def test_fast_rows_hold_the_state_at_their_tick() -> None:
    infos, fast, _ = drive(ticks=500)
    for info, row in zip(infos, fast, strict=True):
        assert row[FAST.gyro] == info["gamma"]
    wheels = fast[:, [FAST.wheel_left, FAST.wheel_right]]
    gamma = fast[:, FAST.gyro]
    apart = (wheels[:, 1] - wheels[:, 0]) / COMS.front_track  # v_x -+ gamma d_f / 2
    np.testing.assert_allclose(apart, gamma, rtol=0.0, atol=1e-14)  # roundings of 7 m/s


@pytest.mark.plain
def test_camera_and_gps_hold_the_state_at_their_capture() -> None:
    full, linear = FULL | SWERVING, LINEAR | SWERVING
    for scenario in (full, linear):
        infos, _, found = drive(ticks=500, scenario=scenario)
        assert len(found) > 10
        for packet in found:
            info = infos[int(packet[PACKET.captured])]
            assert packet[PACKET.value] == pytest.approx(info["psi"], abs=1e-15)  # wrapping
            assert packet[PACKET.value + 2 :].tolist() == [0.0, 0.0]
        infos, fast, found = drive("gps", ticks=500, scenario=scenario)
        for packet in found:
            tick = int(packet[PACKET.captured])
            course, speed = packet[PACKET.value : PACKET.value + 2]
            beta = infos[tick]["beta"]
            assert course == pytest.approx(infos[tick]["psi"] + beta, abs=1e-15)
            v_x = fast[tick, [FAST.wheel_left, FAST.wheel_right]].mean()
            stretch = 1.0 / math.cos(beta) if scenario is full else math.sqrt(1.0 + beta**2)
            assert speed == pytest.approx(v_x * stretch, rel=1e-14)  # some roundings


@pytest.mark.plain
def test_camera_sample_is_tie_vision_4_with_curvature() -> None:
    motion = Motion(7.0, 0.2, 0.1, 0.5, 30.0, 4.0, 31.0, 1.5, 0.44)
    for kappa, bend in ((0.0, 0.0), (0.02, 0.02)):
        psi, y_l = camera_sample(motion, Road(kappa, 0.0, 1.0), 5.135, QUIET, CALM)
        assert psi == pytest.approx(0.06, abs=1e-15)
        # y_l = y_cg + l_pre psi - kappa l_pre^2 / 2
        assert y_l == pytest.approx(1.5 + 5.135 * 0.06 - bend * 5.135**2 / 2.0, abs=1e-14)


@pytest.mark.plain
def test_y_l_is_where_the_road_is_seen_at_the_preview_distance() -> None:
    """On a circle the formula errs by the fourth order of the angles, geometry written out."""
    kappa, psi, y, l_pre = 0.01, 0.02, 0.5, 5.135
    motion = Motion(7.0, 0.0, 0.0, psi, 0.0, y, 0.0, y, 0.0)
    _, y_l = camera_sample(motion, Road(kappa, -1e3, 1.0), l_pre, QUIET, CALM)
    ahead = np.array([l_pre * math.cos(psi), y + l_pre * math.sin(psi)])
    left_of_road = 1.0 / kappa - math.hypot(ahead[0], ahead[1] - 1.0 / kappa)
    # kappa l^2/2 against the arc of (1 - kappa y): kappa^2 l^2 y / 2 = 7e-4, and l psi^3 / 6
    assert abs(y_l - left_of_road) < 2e-3


@pytest.mark.plain
def test_gps_course_is_wrapped_and_too_slow_a_car_says_so() -> None:
    motion = Motion(3.0, 0.3, 0.0, 3.1, 5.0, 6.0, 0.0, 0.0, 0.0)
    course, speed, X, Y, quality = gps_sample(motion, 0.1, QUIET, CALM)
    assert course == pytest.approx(3.2 - 2.0 * math.pi, abs=1e-15)
    assert (speed, X, Y, quality) == (math.hypot(3.0, 0.3), 5.0, 6.0, 1.0)
    for v, good in ((0.99, 0.0), (1.0, 1.0), (-2.0, 1.0), (0.0, 0.0)):
        still = motion._replace(v_x=v, v_y=0.0)
        assert gps_sample(still, 0.0, Noise(), CALM)[4] == good
    noisy = gps_sample(motion._replace(v_x=0.0, v_y=0.0), 0.0, Noise(), (1.0, 0.0, 0.0, 0.0))
    assert all(math.isfinite(value) for value in noisy)  # 1 / V stops at half a metre per second


def test_accelerometers_feel_the_forces_not_the_turning_axes() -> None:
    turning = LINEAR | {"steering": "step", "amplitude": 0.02, "hold": 100.0, "duration": 20.0}
    _, fast, _ = drive(ticks=15_000, scenario=turning)
    row, v_x = fast[-1], 25.0 / 3.6
    # after 15 s v_y rests (exp(-6 x 15)): the tyres' force is the centripetal one
    assert row[FAST.accel_y] == pytest.approx(v_x * row[FAST.gyro], abs=1e-10)
    assert row[FAST.accel_x] == 0.0
    pushed = FULL | {"acceleration": 0.5, "lags": False}
    _, fast, _ = drive(ticks=100, scenario=pushed)
    # F / m; v' is a difference of 7 m/s over 1 ms: two roundings of 4e-16 over 1 ms
    np.testing.assert_allclose(fast[1:, FAST.accel_x], 0.5, rtol=0.0, atol=1e-12)
    gust = LINEAR | {"wind_force": 190.0, "wind_start": 0.0, "wind_length": 1.0}
    _, fast, _ = drive(ticks=1, scenario=gust)
    # in the first tick the tyres hardly answer: (C_f + C_r) v_y h / (m V) = 5e-3 of it
    assert fast[1, FAST.accel_y] == pytest.approx(190.0 / 380.0, rel=6e-3)


SIZES = [
    ("gyro", FAST.gyro, 0.005),
    ("accel_y", FAST.accel_y, 0.1),
    ("accel_x", FAST.accel_x, 0.1),
    ("wheel_left", FAST.wheel_left, 0.02),
    ("wheel_right", FAST.wheel_right, 0.02),
]


def test_fast_noise_is_white_normal_and_of_the_stated_size() -> None:
    """The same seed without noise gives the same drive, so the difference is the noise."""
    noisy = drive(ticks=10_000, scenario=LINEAR | SWERVING | {"noise": {}}, seed=5)[1]
    silent = drive(ticks=10_000, scenario=LINEAR | SWERVING, seed=5)[1]
    noise = (noisy - silent)[:, : len(SIZES)] / [size for _, _, size in SIZES]
    for column in noise.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3  # a fixed seed: passed once and for all
        again = np.corrcoef(column[:-1], column[1:])[0, 1]
        assert abs(again) < 4.0 / np.sqrt(len(column))  # four standard errors
    mixed = np.corrcoef(noise.T) - np.eye(len(SIZES))
    assert np.abs(mixed).max() < 4.0 / np.sqrt(len(noise))
    assert (noisy - silent)[:, len(SIZES) :].any() == np.False_  # inputs are recorded as they are


@pytest.mark.parametrize(
    ("sensors", "sizes"),
    [
        ("vision", [3.5e-3, 0.02]),
        # 0.14 deg at 60 km/h, growing as 1 / V: 0.336 deg at 25 km/h
        ("gps", [math.radians(0.336), 0.05, 0.5, 0.5]),
    ],
)
def test_slow_noise_is_normal_and_of_the_stated_size(sensors: str, sizes: list[float]) -> None:
    each = {"camera" if sensors == "vision" else "gps": {"period": 0.01, "delays": [0.0]}}
    how: dict[str, Any] = {"ticks": 10_000, "seed": 6, **each}
    straight = LINEAR | {"duration": 100.0}
    noisy = drive(sensors, scenario=straight | {"noise": {}}, **how)[2]
    silent = drive(sensors, scenario=straight, **how)[2]
    value = slice(PACKET.value, PACKET.value + len(sizes))
    noise = (noisy - silent)[:, value] / sizes
    for column in noise.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3


def test_bias_is_added_to_every_sample() -> None:
    biased = LINEAR | SWERVING | {"noise": SILENT | {"gyro_bias": 0.01, "accel_y_bias": -0.3}}
    one, other = (drive(ticks=50, scenario=s)[1] for s in (biased, LINEAR | SWERVING))
    # one rounding each
    np.testing.assert_allclose(one[:, FAST.gyro], other[:, FAST.gyro] + 0.01, rtol=1e-15)
    np.testing.assert_allclose(
        one[:, FAST.accel_y], other[:, FAST.accel_y] - 0.3, rtol=0.0, atol=1e-15
    )
