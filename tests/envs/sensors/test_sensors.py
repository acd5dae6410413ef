"""What the sensors measure: the state at the captured tick, plus noise of the stated size."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sideslip.envs import COMS, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.sensors.inertial import IDEAL_SENSORS, Noise
from sideslip.envs.sensors.slow import (
    HDOP_LAWS,
    OUTAGE_JUMP,
    FieldOfView,
    MeasurementContext,
    SatelliteGeometry,
    _count_satellites,
    _sample_camera,
    _sample_gps,
    compute_lane_quality,
)
from sideslip.envs.vehicle.dynamics import Motion, RoadParams

from ..helpers import FULL, LINEAR, SILENT, fast_rows, packets, play

CALM = (0.0, 0.0, 0.0, 0.0)
QUIET = Noise()._replace(**SILENT)
SWERVING: dict[str, Any] = {"steering": "sine", "amplitude": 0.1, "frequency": 0.5}
SWERVING |= {"duration": 100.0}


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
            assert packet[PACKET.value + 2 :].tolist() == [0.0] * 4
        infos, fast, found = drive("gps", ticks=500, scenario=scenario)
        for packet in found:
            tick = int(packet[PACKET.captured])
            course, speed = packet[PACKET.value : PACKET.value + 2]
            beta = infos[tick]["beta"]
            assert course == pytest.approx(infos[tick]["psi"] + beta, abs=1e-15)
            v_x = fast[tick, [FAST.wheel_left, FAST.wheel_right]].mean()
            stretch = 1.0 / math.cos(beta) if scenario is full else math.sqrt(1.0 + beta**2)
            assert speed == pytest.approx(v_x * stretch, rel=1e-14)  # some roundings


def sample_camera(motion: Motion, road: RoadParams) -> Any:
    """psi and y_l without noise; the COMS's preview is 5.135 m."""
    parts = SatelliteGeometry(*[0.0] * 5), FieldOfView(1.0, 1.0), IDEAL_SENSORS
    context = MeasurementContext(motion, road, make_car(COMS), QUIET, *parts, 0, 0, 0, 0)
    return _sample_camera(context, CALM)[0][:2]


@pytest.mark.plain
def test_camera_sample_is_tie_vision_4_with_curvature() -> None:
    motion = Motion(7.0, 0.2, 0.1, 0.5, 30.0, 4.0, 31.0, 1.5, 0.44)
    for kappa in (0.0, 0.02):
        psi, y_l = sample_camera(motion, RoadParams(kappa, 0.0, 1.0))
        assert psi == pytest.approx(0.06, abs=1e-15)
        # y_l = y_cg + l_pre psi - kappa l_pre^2 / 2
        assert y_l == pytest.approx(1.5 + 5.135 * 0.06 - kappa * 5.135**2 / 2.0, abs=1e-14)


@pytest.mark.plain
def test_where_the_road_leads_changes_nothing_that_is_seen_of_it() -> None:
    """A road and a car that are both turned: heading and offset are relative to the road."""
    for turned in (0.0, 0.7, -2.0):
        motion = Motion(0.0, 0.0, 0.0, turned + 0.1, 0.0, 0.0, 0.0, 0.4, turned)
        assert compute_lane_quality(motion, FieldOfView(0.15, 1.0)) == 1.0
        expected = pytest.approx((0.1, 0.4 + 5.135 * 0.1), rel=1e-7)
        assert sample_camera(motion, RoadParams(0.0, 0.0, 1.0)) == expected


@pytest.mark.plain
def test_y_l_is_where_the_road_is_seen_at_the_preview_distance() -> None:
    """On a circle the formula errs by the fourth order of the angles, geometry written out."""
    kappa, psi, y, l_pre = 0.01, 0.02, 0.5, 5.135
    motion = Motion(7.0, 0.0, 0.0, psi, 0.0, y, 0.0, y, 0.0)
    _, y_l = sample_camera(motion, RoadParams(kappa, -1e3, 1.0))
    ahead = np.array([l_pre * math.cos(psi), y + l_pre * math.sin(psi)])
    left_of_road = 1.0 / kappa - math.hypot(ahead[0], ahead[1] - 1.0 / kappa)
    # kappa l^2/2 against the arc of (1 - kappa y): kappa^2 l^2 y / 2 = 7e-4, and l psi^3 / 6
    assert abs(y_l - left_of_road) < 2e-3


def gps(motion: Motion, noise: Noise = QUIET, n: Any = CALM, **how: Any) -> Any:
    """A GPS sample; `how` changes ahead, left, hdop, weight or small_angle."""
    car = make_car(COMS)._replace(forward=how.get("ahead", 0.0), left=how.get("left", 0.0))
    sky = SatelliteGeometry(0.0, 0.0, 0.0, 0.0, how.get("weight", 0.5))
    parts = RoadParams(0.0, 0.0, 1.0), car, noise, sky, FieldOfView(1.0, 1.0), IDEAL_SENSORS
    context = MeasurementContext(motion, *parts, how.get("small_angle", 0), 0, 0, 0)
    values, quality = _sample_gps(context, how.get("hdop", 1.0), n)
    return (*values, quality)


@pytest.mark.plain
def test_gps_course_is_wrapped_and_too_slow_a_car_says_so() -> None:
    motion = Motion(3.0, 0.3, 0.0, 3.1, 5.0, 6.0, 0.0, 0.0, 0.0)
    course, speed, X, Y, hdop, satellites, quality = gps(motion, small_angle=1)
    assert course == pytest.approx(3.2 - 2.0 * math.pi, abs=1e-15)
    assert (speed, X, Y, quality) == (math.hypot(3.0, 0.3), 5.0, 6.0, 1.0)
    assert (hdop, satellites) == (1.0, 12.0)
    for v, good in ((0.99, 0.0), (1.0, 1.0), (-2.0, 1.0), (0.0, 0.0)):
        assert gps(motion._replace(v_x=v, v_y=0.0), Noise())[-1] == good
    noisy = gps(motion._replace(v_x=0.0, v_y=0.0), Noise(), (1.0, 0.0, 0.0, 0.0))
    assert all(math.isfinite(value) for value in noisy)  # 1 / V stops at half a metre per second


@pytest.mark.plain
@pytest.mark.parametrize(("ahead", "left"), [(0.5, 0.0), (0.0, -0.3), (-0.4, 0.2)])
def test_an_antenna_off_the_centre_moves_as_a_point_of_the_body_does(
    ahead: float, left: float
) -> None:
    """Its place a moment later, by the body's own motion, gives its velocity."""
    h, state = 1e-5, Motion(6.0, 0.4, 0.7, 0.9, 20.0, -7.0, 0.0, 0.0, 0.0)
    s, c = math.sin(state.psi), math.cos(state.psi)
    V_X, V_Y = c * state.v_x - s * state.v_y, s * state.v_x + c * state.v_y
    places = []
    for t in (-h, h):
        place = {"X": state.X + V_X * t, "Y": state.Y + V_Y * t}
        moved = state._replace(psi=state.psi + state.gamma * t, **place)
        places.append(np.array(gps(moved, ahead=ahead, left=left)[2:4]))
    velocity = (places[1] - places[0]) / (2.0 * h)
    course, speed = gps(state, ahead=ahead, left=left)[:2]
    # differences of 20 m over 2e-5 s: 1e-10 of rounding; gamma^3 h^2 of the difference itself
    assert speed == pytest.approx(math.hypot(*velocity), abs=1e-8)
    assert course == pytest.approx(math.atan2(velocity[1], velocity[0]), abs=1e-8)
    assert places[0] != pytest.approx([state.X, state.Y], abs=0.1)


@pytest.mark.plain
@pytest.mark.parametrize(("law", "weight"), HDOP_LAWS.items())
def test_gps_noise_follows_hdop_as_its_law_says(law: str, weight: float) -> None:
    motion = Motion(8.0, 0.0, 0.0, 0.3, 5.0, 6.0, 0.0, 0.0, 0.0)
    still = np.array(gps(motion)[:4])
    at_1, at_3 = (
        np.array(gps(motion, Noise(), (1.0,) * 4, hdop=hdop, weight=weight)[:4]) - still
        for hdop in (1.0, 3.0)
    )
    sizes = [Noise().course / 8.0, Noise().gps_speed, 0.5, 0.5]
    assert at_1 == pytest.approx(sizes, rel=1e-12)  # roundings of numbers up to 8
    times = {"constant": 1.0, "half": 2.0, "table": 3.0}[law]
    np.testing.assert_allclose(at_3, times * at_1, rtol=1e-12)


@pytest.mark.plain
def test_satellites_fall_with_hdop_below_four() -> None:
    seen = [_count_satellites(hdop) for hdop in (0.5, 1.0, 1.4, 2.0, 5.0, 5.01, 11.0, 1e9)]
    assert seen == [22.0, 12.0, 9.0, 7.0, 4.0, 3.0, 2.0, 2.0]
    assert _count_satellites(1e-300) == 30.0


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


SIZES = (0.005, 0.1, 0.1, 0.005, 0.02, 0.02)  # of the first columns of a fast row


def test_fast_noise_is_white_normal_and_of_the_stated_size() -> None:
    """The same seed without noise gives the same drive, so the difference is the noise."""
    noisy = drive(ticks=10_000, scenario=LINEAR | SWERVING | {"noise": {}}, seed=5)[1]
    silent = drive(ticks=10_000, scenario=LINEAR | SWERVING, seed=5)[1]
    noise = (noisy - silent)[:, : len(SIZES)] / SIZES
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
    accel = other[:, FAST.accel_y] - 0.3
    np.testing.assert_allclose(one[:, FAST.accel_y], accel, rtol=0.0, atol=1e-15)


HDOP, SATELLITES = PACKET.value + 4, PACKET.value + 5


def test_log_hdop_is_stationary_with_the_stated_median_spread_and_memory() -> None:
    """200 drives: a packet at the start and one 4 s later each."""
    changes = {"duration": 4.3, "hdop": 1.4, "hdop_spread": 0.5, "hdop_time": 8.0}
    env = StabilityEnv("gps", scenario=LINEAR | changes, control_period=1000)
    first, last = [], []
    for seed in range(200):
        env.reset(seed=seed)
        first.append(math.log(env.record.packets[0, HDOP]))
        last.append(math.log(packets(play(env, [0.0] * 4))[-1, HDOP]))
    for logs in (first, last):
        # four standard errors of a mean and of a standard deviation of 200
        assert abs(np.mean(logs) - math.log(1.4)) < 4.0 * 0.5 / math.sqrt(200)
        assert abs(np.std(logs) - 0.5) < 4.0 * 0.5 / math.sqrt(400)
    kept = np.corrcoef(first, last)[0, 1]
    assert abs(kept - math.exp(-4.0 / 8.0)) < 4.0 / math.sqrt(200)
    spread = LINEAR | {"hdop": 1.4, "hdop_spread": 0.0}
    found = drive("gps", ticks=900, scenario=spread)[2]
    np.testing.assert_allclose(found[:, HDOP], 1.4, rtol=1e-13)  # exp's and log's own error


def test_hdop_jumps_where_an_outage_ends() -> None:
    sky = LINEAR | {"hdop": 1.4, "hdop_spread": 0.5, "hdop_time": 1e9, "duration": 3.0}
    seen = {}
    for outage in (None, (0.5, 1.1)):
        found = drive("gps", ticks=2500, scenario=sky | {"gps_outage": outage}, seed=2)[2]
        seen[outage] = {packet[PACKET.captured]: packet for packet in found}
    calm, cut = seen.values()
    assert set(cut) == set(calm) - {600.0, 800.0, 1000.0}
    for tick, packet in cut.items():
        jump = math.log(packet[HDOP] / calm[tick][HDOP])
        assert jump == pytest.approx(OUTAGE_JUMP * 0.5 if tick >= 1100 else 0.0, abs=1e-6)
        assert packet[SATELLITES] == _count_satellites(packet[HDOP])
        assert packet[PACKET.quality] == 1.0  # the filter refuses few satellites, not the sensor
    assert min(packet[SATELLITES] for packet in cut.values()) < 4.0
