"""Tracks of cones; tyres that change in mid-run, and a road that grips less on one side."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, StabilityEnv
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.layout import P
from sideslip.envs.numerics.functions import FOREVER
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.numerics.primitives import ARRAYS
from sideslip.envs.scenarios import road
from sideslip.envs.scenarios.road import TrackPath, make_path, make_sections, transform_path
from sideslip.envs.vehicle.tyres import FIALA, PlantVariant, TyreInputs, compute_tyre_load

from ..helpers import FULL, LINEAR, bits, play

pytestmark = pytest.mark.plain

TRACKS = road.PATHS[1:]
widths = st.floats(1.0, 2.6)


def offsets(path: TrackPath, s: np.ndarray) -> np.ndarray:
    offset: np.ndarray = as_python(road.compute_path_offset, ARRAYS)(path, s)
    return offset


@pytest.mark.smoke
@given(widths)
def test_sections_of_iso_3888_1(w: float) -> None:
    first, side, last = make_sections("iso-3888-1", w)
    assert [each.length for each in (first, side, last)] == [15.0, 25.0, 15.0 + 15.0]
    assert (side.start - 15.0, last.start - 15.0 - 30.0 - 25.0) == (30.0, 25.0)
    assert last.start + last.length == 125.0
    assert [first.width, side.width, last.width] == [1.1 * w + 0.25, 1.2 * w + 0.25, 1.3 * w + 0.25]
    right = [each.offset - 0.5 * each.width for each in (first, side, last)]
    assert right == pytest.approx([-0.5 * first.width, 3.5 - 0.5 * first.width, right[0]])


@pytest.mark.smoke
@given(widths)
def test_sections_of_iso_3888_2(w: float) -> None:
    first, side, last = make_sections("iso-3888-2", w)
    assert [each.length for each in (first, side, last)] == [12.0, 11.0, 12.0]
    assert (side.start - 12.0, last.start - 12.0 - 13.5 - 11.0) == (13.5, 12.5)
    assert last.start + last.length == 61.0
    assert [first.width, side.width] == [1.1 * w + 0.25, w + 1.0]
    assert last.width == max(1.3 * w + 0.25, 3.0)
    # a metre between the left cones of the first lane and the right ones of the second
    gap = side.offset - 0.5 * side.width - (first.offset + 0.5 * first.width)
    assert gap == pytest.approx(1.0, rel=1e-12)
    assert last.offset - 0.5 * last.width == pytest.approx(-0.5 * first.width, rel=1e-12)


@pytest.mark.parametrize("track", TRACKS)
@given(
    w=widths, start=st.floats(-50.0, 50.0), scale=st.floats(0.2, 2.0), side=st.sampled_from([-1, 1])
)
def test_the_path_runs_through_the_centres_and_keeps_the_car_between_the_cones(
    track: str, w: float, start: float, scale: float, side: int
) -> None:
    path = transform_path(make_path(track, w), start, scale, float(side))
    for lane in make_sections(track, w, start, scale, float(side)):
        centre = offsets(path, np.array([lane.start + 0.5 * lane.length]))
        assert centre[0] == pytest.approx(lane.offset, abs=1e-12)
        off = offsets(path, lane.start + np.linspace(0.0, lane.length, 101)) - lane.offset
        assert np.abs(off).max() + 0.5 * w < 0.5 * lane.width


@pytest.mark.parametrize("track", TRACKS)
def test_the_paths_slope_is_continuous(track: str) -> None:
    path = make_path(track, 1.8)
    ends = [path.start_1, path.start_1 + path.length_1, path.start_2, path.start_2 + path.length_2]
    s, h = np.append(np.linspace(-5.0, 130.0, 4001), ends), 1e-4
    offset = [offsets(path, s + k * h) for k in (-1.0, 0.0, 1.0)]
    # a cubic of length l over a shift a bends at most by 6 a / l^2; a kink would show as h, not h^2
    bends = [(path.shift_1, path.length_1), (path.shift_2, path.length_2)]
    most = max(6.0 * abs(shift) / length**2 for shift, length in bends)
    assert np.abs(offset[0] - 2.0 * offset[1] + offset[2]).max() < 1.001 * most * h * h + 1e-14
    lanes = make_sections(track, 1.8)
    for before, after in pairwise(lanes):
        first, last = (each.start + 0.5 * each.length for each in (before, after))
        s = np.linspace(first, last, 500)
        assert np.all(np.diff(offsets(path, s)) * (after.offset - before.offset) >= 0.0)


def test_the_road_has_no_lanes_and_no_offset() -> None:
    assert make_sections("road", 1.8) == ()
    assert not offsets(make_path("road", 1.8), np.linspace(-1e3, 1e3, 99)).any()
    with pytest.raises(ValueError, match="unknown track 'iso-3888'; known: road, iso-3888-1, iso-"):
        make_sections("iso-3888", 1.8)


TURN: dict[str, Any] = {"steering": "sine", "amplitude": 0.06, "frequency": 0.5}
CHANGE: dict[str, Any] = {"tyre_change_time": 0.503, "front_change": 0.7, "rear_change": 1.2}
BRAKING = {"speed": 8.0, "speed_change": -4.0, "change_length": 1.5, "duration": 1.5}


def states(env: StabilityEnv, steps: int) -> list[Any]:
    """The Motion's bits after each step."""
    seen = []
    for _ in range(steps):
        play(env, [0.3])
        seen.append(bits(tuple(env.motion)))
    return seen


@pytest.mark.parametrize("lags", [False, True])
@pytest.mark.parametrize("plant", [LINEAR, FULL])
def test_the_plant_is_another_from_the_tick_of_the_change_on(
    plant: dict[str, Any], lags: bool
) -> None:
    scene = plant | TURN | {"lags": lags}
    same = StabilityEnv("fusion", scenario=scene, control_period=1)
    changing = StabilityEnv("fusion", scenario=scene | CHANGE, control_period=1)
    same.reset(seed=0)
    changing.reset(seed=0)
    assert states(same, 503) == states(changing, 503)
    # from here on it moves as a car that always had those tyres, in the same state
    snapshot = changing.get_state()
    snapshot["params"][P.car.C_f] *= 0.7
    snapshot["params"][P.car.C_r] *= 1.2
    snapshot["params"][P.tyre_change.tick] = FOREVER
    later = states(changing, 60)
    assert later[0] != states(same, 1)[0]
    changing.set_state(snapshot)
    assert states(changing, 60) == later


def test_the_change_does_not_depend_on_the_control_period() -> None:
    ends = set()
    for n in (1, 10, 40):
        env = StabilityEnv("fusion", scenario=FULL | TURN | CHANGE, control_period=n)
        env.reset(seed=0)
        ends.add(states(env, 800 // n)[-1])
    assert len(ends) == 1


def test_the_env_tells_its_tyres_now() -> None:
    env = StabilityEnv("fusion", scenario=FULL | CHANGE, control_period=1)
    env.reset(seed=0)
    play(env, [0.0] * 502)
    assert (env.vehicle.front_stiffness, env.vehicle.rear_stiffness) == (6000.0, 6000.0)
    play(env, [0.0])
    assert env.vehicle.front_stiffness == pytest.approx(4200.0)
    assert env.vehicle.rear_stiffness == pytest.approx(7200.0)
    env.reset(seed=1)
    assert env.vehicle.front_stiffness == 6000.0


def test_each_rear_tyre_has_its_sides_grip_and_the_front_ones_the_mean() -> None:
    car = make_car(COMS)._replace(mu=0.9, mu_r=0.3)
    cars, inputs = (car, car._replace(mu_r=0.9), car._replace(mu=0.3)), (0.0, -100.0, -100.0)
    load, high, low = (
        compute_tyre_load(TyreInputs(*inputs), each, PlantVariant(0, FIALA)) for each in cars
    )
    assert (load.rear_l, load.limit_l, load.slope_l) == (high.rear_l, high.limit_l, high.slope_l)
    assert (load.rear_r, load.limit_r, load.slope_r) == (low.rear_r, low.limit_r, low.slope_r)
    assert load.limit_f == pytest.approx(0.5 * (high.limit_f + low.limit_f), rel=1e-14)
    braked_l, braked_r = 100.0 / COMS.wheel_radius, 0.3 * 380.0 * 9.81 * 0.8 / 2.8
    assert load.F_x == pytest.approx(-braked_l - braked_r, rel=1e-12)
    assert load.N_z == pytest.approx(0.41 * (braked_l - braked_r), rel=1e-12)


@pytest.mark.parametrize("roll", [False, True])
def test_braking_on_split_friction_yaws_the_car_to_the_side_that_grips(roll: bool) -> None:
    yawed = []
    for split in ({}, {"friction_right": 0.2}, {"friction_right": 0.9, "friction": 0.2}):
        env = StabilityEnv("fusion", scenario=FULL | {"roll": roll} | BRAKING | split)
        env.reset(seed=0)
        play(env, [0.0] * 150)
        yawed.append(env.motion.psi)
        assert env.motion.v_x < 7.0
    assert abs(yawed[0]) < 1e-9
    assert yawed[1] > 0.01  # to the left, where the road grips
    assert yawed[2] == pytest.approx(-yawed[1], rel=1e-9)


def test_the_same_friction_on_both_sides_is_no_split() -> None:
    seen = []
    for split in ({}, {"friction_right": 0.9}):
        env = StabilityEnv("fusion", scenario=FULL | TURN | split)
        env.reset(seed=0)
        seen.append(states(env, 100))
        assert env.vehicle.friction == 0.9
    assert seen[0] == seen[1]


def test_the_seed_draws_the_side_that_slips_and_that_of_the_bend() -> None:
    scene = {"base": "curved-road", "friction_right": (0.2, 0.3)}
    env = StabilityEnv("fusion", scenario=scene)
    seen = []
    for seed in range(30):
        env.reset(seed=seed)
        params = env.get_state()["params"]
        left, right, curvature = params[P.car.mu], params[P.car.mu_r], params[P.road.curvature]
        assert 0.01 <= abs(curvature) <= 0.03
        low, high = sorted((left, right))
        assert 0.2 <= low <= 0.3
        assert 0.7 <= high <= 1.0
        assert (right == low) == (curvature > 0.0)  # one side for all
        assert env.vehicle.friction == 0.5 * (left + right)
        seen.append(curvature > 0.0)
    assert 5 < np.sum(seen) < 25
