"""The driver: his law, his arms, and what he keeps to."""

import itertools
import math
from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, FAILURES, StabilityEnv
from sideslip.envs.engine.layout import P
from sideslip.envs.numerics.packed import read
from sideslip.envs.scenarios import road
from sideslip.envs.scenarios.driver import DriverParams, compute_driver_angle, compute_target_angle
from sideslip.envs.scenarios.road import compute_path_offset, make_path, transform_path
from sideslip.envs.task import make_reference_params
from sideslip.envs.vehicle.dynamics import Motion, RoadParams

from ..helpers import FULL, LINEAR, Moment, play

T = 1.0
QUICK = DriverParams(T, 1.0, 0.0, 1.0)
TARGET = make_reference_params(COMS)
STRAIGHT = make_path("road", 1.0)
TRACK = transform_path(make_path("iso-3888-2", 1.095), 3.0, 0.5, 1.0)
FLAT, CLOTHOID = RoadParams(0.0, 0.0, 1.0), RoadParams(0.02, 0.0, 40.0)
KEEPING = {"steering": "driver", "half_width": 1.75}


def motion(**changes: float) -> Motion:
    return Motion(7.0, *[0.0] * 8)._replace(**changes)


def driven(scenario: dict[str, Any], seed: int = 0) -> tuple[StabilityEnv, list[Moment], Any]:
    """(env, moments, (s, y) after each 10 ms) of an uncontrolled episode."""
    env = StabilityEnv("fusion", scenario=scenario)
    env.reset(seed=seed)
    moments: list[Moment] = []
    places = []
    while not (moments and (moments[-1].terminated or moments[-1].truncated)):
        moments += play(env, [0.0])
        places.append((env.motion.s, env.motion.y))
    return env, moments, np.array(places)


@pytest.mark.plain
def test_the_wanted_angle_is_that_of_the_circle_through_the_preview_point() -> None:
    """Written slowly: the lateral acceleration 2 e / T^2, and the angle that the nominal car's
    steady state, dakf-stability (23)-(24), has for it."""
    rng = np.random.default_rng(1)
    l, G = COMS.wheelbase, TARGET.G  # noqa: E741
    for y, psi, v_y in rng.normal(size=(50, 3)) * (0.3, 0.05, 0.3):
        s = rng.uniform(0.0, 40.0 - 7.0 * T)  # within the clothoid
        here = motion(s=s, y=y, psi=psi, v_y=v_y)
        y_dot = 7.0 * math.sin(psi) + v_y * math.cos(psi)
        x = (np.arange(10_000) + 0.5) * 7.0 * T / 10_000
        # the curvature, twice integrated
        bend = np.mean(0.02 * (s + x) / 40.0 * (7.0 * T - x)) * 7.0 * T
        error = compute_path_offset(TRACK, s + 7.0 * T) + bend - (y + T * y_dot)
        expected = 2.0 * error / T**2 * l * (1.0 + G * 49.0) / 49.0
        angle = compute_target_angle(here, TRACK, CLOTHOID, TARGET, QUICK, 10.0)
        assert angle == pytest.approx(expected, abs=1e-10)  # the midpoint rule's error


@pytest.mark.plain
def test_arms_follow_with_their_lag_and_within_their_rate() -> None:
    here, rest = motion(y=-0.1), math.exp(-1e-3 / 0.15)
    wanted = compute_target_angle(here, STRAIGHT, FLAT, TARGET, QUICK, 1.0)
    arms = QUICK._replace(rest=rest)
    angle = compute_driver_angle(0.01, here, STRAIGHT, FLAT, TARGET, arms, 1.0)
    assert angle == pytest.approx(wanted + (0.01 - wanted) * rest, rel=1e-12)
    slow = arms._replace(slew=1e-5)
    assert compute_driver_angle(0.0, here, STRAIGHT, FLAT, TARGET, slow, 1.0) == 1e-5
    assert compute_driver_angle(0.9, here, STRAIGHT, FLAT, TARGET, slow, 1.0) == 0.9 - 1e-5
    assert compute_target_angle(motion(y=-50.0), STRAIGHT, FLAT, TARGET, QUICK, 0.6) == 0.6
    assert compute_target_angle(motion(y=50.0), STRAIGHT, FLAT, TARGET, QUICK, 0.6) == -0.6


@pytest.mark.plain
def test_a_mirrored_world_is_steered_the_other_way() -> None:
    here = motion(s=8.0, y=0.2, psi=0.03, v_y=-0.1)
    mirrored = here._replace(y=-0.2, psi=-0.03, v_y=0.1)
    other = transform_path(make_path("iso-3888-2", 1.095), 3.0, 0.5, -1.0)
    a = compute_driver_angle(0.02, here, TRACK, CLOTHOID, TARGET, QUICK, 0.6)
    left = CLOTHOID._replace(curvature=-0.02)
    b = compute_driver_angle(-0.02, mirrored, other, left, TARGET, QUICK, 0.6)
    assert a == pytest.approx(-b, rel=1e-12)


def test_on_the_papers_plant_a_bend_is_driven_without_error() -> None:
    """The steady state of the nominal linear car is the one that the driver steers for."""
    bend = {"curvature": 0.02, "curve_start": 5.0, "curve_ramp": 5.0, "duration": 30.0}
    env, _, places = driven(LINEAR | KEEPING | bend)
    assert np.abs(places[:, 1]).max() < 0.2
    # the driver looks along sines, which that plant does not have: T v beta^3, beta some 5 mrad
    assert abs(places[-1, 1]) < 7.0 * 0.0055**3
    assert env.motion.gamma == pytest.approx(0.02 * 25.0 / 3.6, rel=1e-9)


def test_on_the_whole_plant_the_error_in_a_bend_is_small_and_steady() -> None:
    bend = {"curvature": 0.02, "curve_start": -50.0, "duration": 20.0}
    _, _, places = driven(FULL | KEEPING | bend)
    assert np.ptp(places[-200:, 1]) < 1e-4
    assert abs(places[-1, 1]) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_the_driver_keeps_his_lane_on_a_dry_road(seed: int) -> None:
    drawn = {"base": "curved-road-driver", "curvature": (-0.01, 0.01), "speed": (4.0, 6.0)}
    _, moments, places = driven(drawn, seed)
    assert moments[-1].truncated
    assert np.abs(places[:, 1]).max() < 0.5


def test_the_driver_comes_back_to_the_line_with_little_overshoot() -> None:
    """Half a metre off: the loop of the law, 1.41 / T rad/s with damping 0.71, and the lags'."""
    env = StabilityEnv("fusion", scenario=LINEAR | KEEPING | {"driver_lag": 0.05})
    env.reset(seed=0, options={"state": {"y": 0.5}})
    y = []
    for _ in range(800):
        play(env, [0.0])
        y.append(env.motion.y)
    assert -0.1 < min(y) < 0.0  # exp(-pi) of it without lags
    assert abs(y[-1]) < 1e-3


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_car_stays_between_the_cones_of_its_track(side: float) -> None:
    """The nominal COMS: its corners over the axles, by place and heading, while in each lane."""
    scene = FULL | KEEPING | {"path": "iso-3888-2", "path_speed": 8.0, "onset": 0.5}
    env = StabilityEnv("fusion", scenario=scene | {"duration": 8.0})
    env.reset(seed=0)
    snapshot = env.get_state()
    for i in (0, 3):
        snapshot["params"][P.path[i]] *= side
    env.set_state(snapshot)
    v = 25.0 / 3.6
    lanes = road.make_sections("iso-3888-2", COMS.width, 0.5 * v, v / 8.0, side)
    seen = 0
    for _ in range(800):
        play(env, [0.0])
        s, y, psi = env.motion.s, env.motion.y, env.motion.psi
        half = 0.5 * COMS.width
        for ahead, left in itertools.product((COMS.front_arm, -COMS.rear_arm), (-half, half)):
            along = s + ahead * math.cos(psi) - left * math.sin(psi)
            across = y + ahead * math.sin(psi) + left * math.cos(psi)
            for lane in lanes:
                if lane.start <= along <= lane.start + lane.length:
                    seen += 1
                    assert abs(across - lane.offset) < 0.5 * lane.width
    assert seen > 1200


@pytest.mark.plain
def test_the_track_lies_where_onset_speed_and_side_put_it() -> None:
    env = StabilityEnv("fusion", scenario="double-lane-change")
    sides = set()
    for seed in range(8):
        env.reset(seed=seed)
        packed = read(env.get_state()["params"], P.path)
        own, v = make_path("iso-3888-2", COMS.width), env.motion.v_x
        scale = packed.length_1 / own.length_1
        assert v / 9.0 <= scale <= v / 7.0
        onset = (packed.start_1 - scale * own.start_1) / v
        assert 0.5 <= onset <= 1.0
        side = math.copysign(1.0, packed.shift_1)
        assert packed == pytest.approx(transform_path(own, onset * v, scale, side), rel=1e-12)
        sides.add(side)
        env.reset(seed=seed, options={"state": {"s": 7.0, "v_x": v + 0.5}})
        started = read(env.get_state()["params"], P.path)
        begin = 7.0 + onset * (v + 0.5)
        assert started == pytest.approx(transform_path(own, begin, scale, side), rel=1e-12)
    assert sides == {-1.0, 1.0}
    env.reset(seed=0, options={"scenario": {"base": "double-lane-change", "path_speed": None}})
    assert env.get_state()["params"][P.path.length_1] == own.length_1  # the standard's


@pytest.mark.plain
def test_who_leaves_the_path_ends_the_episode_there() -> None:
    """A driver who hardly steers stays on the road's centre line, which the track leaves."""
    scene = {"base": "double-lane-change", "mirror": False, "driver_gain": 1e-9}
    env, moments, places = driven(scene)
    assert FAILURES[moments[-1].info["failure"]] == "off-road"
    packed = read(env.get_state()["params"], P.path)
    off = places[:, 1] - [compute_path_offset(packed, s) for s in places[:, 0]]
    assert abs(off[-1]) > 2.0
    assert np.all(np.abs(off[:-1]) <= 2.0)
    assert abs(places[-1, 1]) < 1.0


@pytest.mark.plain
def test_the_driver_starts_with_the_angle_he_wants() -> None:
    bend = {"curvature": 0.02, "curve_start": -50.0}
    env = StabilityEnv("fusion", scenario=LINEAR | KEEPING | bend)
    _, info = env.reset(seed=0)
    v = 25.0 / 3.6
    expected = 0.02 * COMS.wheelbase * (1.0 + TARGET.G * v * v)
    assert info["steer"] == pytest.approx(expected, rel=1e-9)
