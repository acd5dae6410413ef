"""The environments of highway-env's worlds: the same bits, our own road's numbers, ends, refusals.

Each fault of its lane keeping that is worked around has a test. A newer version that repairs one
fails it: then the work-around can go.
"""

import copy
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.envs import FAILURES
from sideslip.envs.highway.env import (
    KEEPING,
    MAX_VEHICLES,
    STATES,
    HighwayEnv,
    KeepingEnv,
    NativeObservation,
    _KeepingPlant,
    make_keeping_vehicle,
)
from sideslip.envs.highway.traffic import ANGLE, ENTRY, RADIUS
from sideslip.envs.outside.plants import OutsideInputs
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.task import COLLISION, DEPARTURE
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.estimators import EstimateObservation
from sideslip.estimators.vector import EstimateObservation as VectorEstimateObservation

from ..helpers import SILENT, bits

from highway_env.envs.lane_keeping_env import LaneKeepingEnv  # isort: skip
from highway_env.vehicle.dynamics import BicycleVehicle  # isort: skip

ID = "sideslip/Highway-v0"
ALONE: dict[str, Any] = {"hazard": None, "traffic": 0}
SLALOM: dict[str, Any] = {
    "base": "limit-slalom", "road": "straight", "tier": "", "duration": 2.0,
    "curve_start": -1000.0, "curve_ramp": 1.0,
}  # fmt: skip


def made(**changes: Any) -> HighwayEnv:
    env = gym.make(ID, **changes).unwrapped
    assert isinstance(env, HighwayEnv)
    return env


def drive(env: Any, seed: int, steps: int, options: Any = None) -> list[Any]:
    """All that came, with what the wires carried."""
    found = [(*env.reset(seed=seed, options=options), env.unwrapped.record)]
    for k in range(steps):
        action = np.full(env.action_space.shape, 0.5 * np.sin(0.1 * k), np.float32)
        *step, _, _, info = env.step(action)
        found.append((*step, info, env.unwrapped.record))
        if info["failure"] or info["is_success"]:
            break
    return found


def test_the_environments_keep_gymnasiums_contract() -> None:
    for env in (made(scenario={"base": "wet-evasion", "duration": 1.0}), KeepingEnv()):
        check_env(env, skip_render_check=True)


def test_alone_on_a_straight_road_it_is_the_fusion_env_bit_for_bit() -> None:
    """The projection on highway-env's lane gives back the plant's own bits."""
    options: dict[str, Any] = {"vehicle": "passenger-car", "reference": "lagged"}
    ours = gym.make("sideslip/YawFusion-v0", scenario=SLALOM, **options)
    theirs = made(scenario=SLALOM, **ALONE)
    assert bits(drive(ours, 3, 200)) == bits(drive(theirs, 3, 200))


@pytest.mark.parametrize("road", ["straight", "curved", "merging"])
def test_the_same_seed_has_the_same_bits(road: str) -> None:
    scenario = {"base": "wet-evasion", "duration": 2.0}
    first, again = (made(road=road, scenario=scenario, traffic=5) for _ in range(2))
    assert bits(drive(first, 7, 200)) == bits(drive(again, 7, 200))
    others = [[v.position.tolist() for v in env._traffic.road.vehicles] for env in (first, again)]  # type: ignore[union-attr]
    assert others[0] == others[1] and len(others[0]) == 7
    assert bits(drive(first, 8, 200)) != bits(drive(again, 7, 200))


def test_a_snapshot_and_a_copy_go_on_bit_for_bit() -> None:
    env = made(scenario={"base": "wet-evasion", "duration": 2.0}, road="merging")
    env.reset(seed=4)
    for _ in range(90):
        env.step([0.3])
    twin, snapshot = copy.deepcopy(env), env.get_state()
    last = [env.step([0.3]) for _ in range(60)]
    assert bits(last) == bits([twin.step([0.3]) for _ in range(60)])
    env.set_state(snapshot)
    assert bits(last) == bits([env.step([0.3]) for _ in range(60)])
    with pytest.raises(ValueError, match="'merging', not 'straight'"):
        made().set_state(snapshot)


def test_what_others_do_does_not_depend_on_the_control_period() -> None:
    """The road is stepped at its own ticks, with our car where it was then."""
    found = []
    for period in (10, 25, 100):
        env = made(control_period=period, scenario={"base": "wet-evasion", "duration": 2.0})
        env.reset(seed=2)
        for _ in range(2000 // period):
            env.step([0.0])
        assert env._traffic is not None
        found.append([v.position.tolist() for v in env._traffic.road.vehicles[1:]])
    assert found[0] == found[1] == found[2]


def test_the_camera_sees_a_bend_as_our_own_road_has_it() -> None:
    """highway-env's circular lane beside our road of that curvature, the same programme steering.

    Our road's direction is integrated: it errs by what the bend turns in the tick in which it
    begins. highway-env's begins with the next control period.
    """
    common = {"base": "sine", "mirror": False, "duration": 8.0, "noise": SILENT, "speed": 16.0}
    common |= {"amplitude": 0.01, "frequency": 0.2, "onset": 0.5, "disturbance_force": 0.0}
    common |= {"disturbance_moment": 0.0}
    bend = {"curvature": 1.0 / RADIUS, "curve_start": ENTRY, "curve_ramp": 1e-6}
    options: dict[str, Any] = {"vehicle": "passenger-car", "reference": "lagged"}
    ours: Any = gym.make("sideslip/YawFusion-v0", scenario=common | bend, **options).unwrapped
    theirs = made(road="curved", scenario=common, **ALONE)
    seen = []
    for env in (ours, theirs):
        steps = drive(env, 1, 800)
        assert 1.2 * ENTRY < env.motion.s < RADIUS * ANGLE
        seen.append(np.concatenate([record.select_packets("camera") for *_, record in steps]))
        assert steps[-1][-1].fast[-1, FAST.curvature] == pytest.approx(1.0 / RADIUS)
    assert seen[0].shape == seen[1].shape
    late = np.abs(seen[0][:, PACKET.captured] - 1000.0 * ENTRY / 16.0) > 15.0
    psi, y_l = np.abs(seen[1] - seen[0])[late, PACKET.value : PACKET.value + 2].T
    assert len(psi) > 200
    assert psi.max() < 16e-3 / RADIUS and y_l.max() < 16e-3 / RADIUS * theirs.motion.s
    other = np.delete(seen[1] - seen[0], [PACKET.value, PACKET.value + 1], axis=1)
    assert not other.any()


def test_a_planted_collision_ends_the_episode_at_the_full_charge() -> None:
    """Nobody swerves in time where the driver's reaction takes longer than is left."""
    hazard = {"headway": 0.5, "onset": 0.1, "braking": 1.0, "reaction": 3.0}
    env = made(hazard=hazard, traffic=0)
    found = drive(env, 0, 600)
    info = found[-1][-2]
    assert FAILURES[info["failure"]] == "collision" and info["failure"] == COLLISION
    front, other = env._traffic.road.vehicles  # type: ignore[union-attr]
    gap = other.position[0] - front.position[0] - 0.5 * (front.LENGTH + other.LENGTH)
    assert -2.0 < gap < 0.1
    assert info["cost"] == pytest.approx(100.0 * (6.0 - info["t"]), rel=0.05)


def test_leaving_all_lanes_is_a_departure() -> None:
    scenario = {"base": "step-steer", "mirror": False, "onset": 0.1, "hold": 3.0}
    env = made(scenario=scenario | {"speed": 20.0, "amplitude": 0.02}, **ALONE)
    info = drive(env, 0, 800)[-1][-2]
    assert info["failure"] == DEPARTURE
    ours = env._traffic.ego  # type: ignore[union-attr]
    edge = 2.0 if env._traffic.course.side < 0 else 6.0  # type: ignore[union-attr]
    assert edge < env.motion.y < edge + 2.0 * ours.WIDTH


def test_failing_never_pays_and_control_decides() -> None:
    """Of the cars that fail without control some are saved, and cost less."""
    env: Any = EstimateObservation(made(), "exact-kf", outputs=("beta", "gamma", "F_d", "N_d"))
    agent = make_agent("lqr", env)
    free, held = ([rollout(env, who, seed) for seed in (14, 16, 23)] for who in (None, agent))
    lost = [(a, b) for a, b in zip(free, held, strict=True) if a.failed]
    saved = [(a, b) for a, b in lost if not b.failed]
    assert saved and all(b.cost < 0.2 * a.cost for a, b in saved)


def test_rows_of_a_vector_env_are_single_envs() -> None:
    options: dict[str, Any] = {"scenario": {"base": "wet-evasion", "duration": 0.5}}
    rows: Any = gym.make_vec(ID, 3, vectorization_mode="sync", **options)
    rows = VectorEstimateObservation(rows, "multirate-kf")
    agent = make_agent("two-dof", rows)
    obs, _ = rows.reset(seed=5)
    for _ in range(30):
        obs, *_ = rows.step(agent.predict(obs)[0])
    for i in range(3):
        one = EstimateObservation(made(**options), "multirate-kf")
        alone, _ = one.reset(seed=5 + i)
        for _ in range(30):
            alone, *_ = one.step(agent.predict(alone)[0])
        assert bits(alone) == bits(obs[i])


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"road": "gravel"}, "gravel"),
    ({"traffic": -1}, f"0 to {MAX_VEHICLES}"),
    ({"traffic": 2.5}, "number of vehicles"),
    ({"hazard": {"gap": 1.0}}, "gap"),
    ({"hazard": {"headway": -1.0}}, "headway"),
    ({"scenario": "random-steering"}, "'driver'"),
    ({"scenario": "curved-road-driver"}, "curvature"),
    ({"scenario": {"base": "wet-evasion", "small_angle": True}}, "small_angle"),
    ({"scenario": {"base": "wet-evasion", "path": "iso-3888-2"}}, "path"),
    ({"lead_in": 5.0}, "the vehicle ahead does not wait"),
    ({"road": "curved", "control_period": 100}, "control_period is 100 ticks; .* 20 ticks at"),
]


@pytest.mark.parametrize(("changes", "words"), REFUSED)
def test_what_is_out_of_place_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, TypeError), match=words):
        made(**changes)


def test_steering_is_added_where_it_is_asked_for() -> None:
    assert made(steering=True).action_space.shape == (2,)


def test_without_highway_env_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("highway_env", "highway_env.road.lane"):
        monkeypatch.setitem(sys.modules, name, None)
    for name in ("env", "traffic"):
        monkeypatch.delitem(sys.modules, f"sideslip.envs.highway.{name}")
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sideslip\[highway\]'"):
        gym.make(ID)


def test_a_start_off_the_roads_own_is_refused() -> None:
    env = made()
    with pytest.raises(ValueError, match="X is where the road begins"):
        env.reset(options={"state": {"X": 5.0}})
    env.reset(options={"state": {"y": 0.5, "v_y": 0.2}}, seed=0)
    assert env.motion.y == env.motion.Y == 0.5


@pytest.mark.parametrize("road", ["straight", "curved", "merging"])
def test_highway_envs_viewer_draws_the_road(road: str) -> None:
    env = made(road=road, render_mode="rgb_array")
    env.reset(seed=0)
    env.step([0.5])
    env.annotate("exact-kf", 0.02, 0.01)
    frame = env.render()
    assert frame is not None and frame.shape == (540, 960, 3)
    panel = frame[40:256]
    assert (panel == (100, 100, 100)).all(2).mean() > 0.5  # highway-env's ground
    assert (panel == (255, 255, 255)).all(2).sum() > 200  # its markings
    assert (panel[:, 200:400] != 100).any()  # and our car


def turning(speed: float, step: float, seconds: float = 4.0) -> float:
    """The yaw rate of their car, of 0.1 rad/s at first, after some seconds without steering."""
    car = BicycleVehicle(None, [0.0, 0.0], speed=speed)
    car.yaw_rate = 0.1
    for _ in range(round(seconds / step)):
        car.step(step)
    return abs(float(car.yaw_rate))


def test_fault_it_refuses_the_argument_render_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)  # with "dummy" its frames are black
    with pytest.raises(TypeError, match="render_mode"):
        gym.make("lane-keeping-v0", render_mode="rgb_array")
    plant = _KeepingPlant("rgb_array")
    plant.start(0)
    assert plant.env.render().std() > 5.0


def test_fault_its_step_returns_the_observation_from_before_the_step() -> None:
    env = LaneKeepingEnv({"state_noise": 0.0})
    env.reset(seed=0)
    before = env.vehicle.state[[1, 2, 4, 5]].copy()
    seen, *_ = env.step(np.array([0.5]))
    assert np.array_equal(seen["state"], before)
    assert not np.array_equal(seen["state"], env.vehicle.state[[1, 2, 4, 5]])


def test_fault_its_step_of_a_tenth_of_a_second_is_unstable_below_5_5_m_s() -> None:
    """Its yaw rate decays with 155 m/s2 / V, and Runge-Kutta's limit is 2.785 a step."""
    assert turning(5.4, 0.1) > 0.1 > turning(5.7, 0.1)
    assert turning(5.4, 1e-3) < 1e-6  # as we step it


def test_fault_its_linear_model_steers_half_as_strongly() -> None:
    car = BicycleVehicle(None, [0.0, 0.0], speed=8.3)
    car.action["steering"] = 1e-6
    rates = (car.derivative, car.derivative_linear)
    full, linear = (float(np.ravel(np.asarray(rate, object)[5])[0]) for rate in rates)
    assert linear / full == pytest.approx(0.5, rel=1e-6)


def test_our_vehicle_has_the_dynamics_of_theirs() -> None:
    """The Jacobian of their derivative is our linear bicycle's A and B."""
    car, h, speed = BicycleVehicle(None, [0.0, 0.0], speed=8.3), 1e-6, 8.3

    def rates(slide: float, turn: float, steer: float) -> Any:
        car.lateral_speed, car.yaw_rate, car.action["steering"] = slide, turn, steer
        return car.derivative[[4, 5], 0] * [1.0 / speed, 1.0]

    columns = [rates(h * speed, 0.0, 0.0), rates(0.0, h, 0.0), rates(0.0, 0.0, h)]
    model = make_bicycle_model(make_keeping_vehicle(), speed)
    assert np.stack(columns[:2], 1) / h == pytest.approx(model.A, rel=1e-5, abs=1e-6)
    assert columns[2] / h == pytest.approx(model.B[:, 0], rel=1e-5)


def test_a_tick_moves_their_car_and_its_place_on_the_lane() -> None:
    """Carried along for a control period, the place is that which a projection finds."""
    plant = _KeepingPlant()
    plant.start(0)
    for _ in range(3000):
        plant.step(OutsideInputs(0.01), 1e-3)
    carried = (plant.y, plant.theta)
    plant.project()
    assert carried == pytest.approx((plant.y, plant.theta), abs=1e-4)


def test_the_same_seed_keeps_the_lane_with_the_same_bits() -> None:
    found = []
    for _ in range(2):
        env = NativeObservation(KeepingEnv(), returned=False)
        first = env.reset(seed=3)
        found.append([first, *(env.step([0.0, 0.1]) for _ in range(20))])
    assert bits(found[0]) == bits(found[1])


def test_accelerometer_and_gyro_are_those_of_the_motion() -> None:
    """Without noise the specific force is v' + v gamma, by differences of the true motion."""
    plant, speeds, felt = _KeepingPlant(), [], []
    plant.start(0)
    for _ in range(400):
        plant.step(OutsideInputs(0.05), 1e-3)
        motion = plant.motion
        speeds.append((motion.v_y, motion.gamma * motion.v_x))
        felt.append(plant.specific_force[1])
    slide, turn = np.array(speeds).T
    expected = (slide[2:] - slide[:-2]) / 2e-3 + turn[1:-1]
    assert np.array(felt)[1:-1] == pytest.approx(expected, abs=2e-3)


@pytest.mark.long
def test_our_filter_keeps_the_lane_where_their_observation_does_not() -> None:
    offset = {}
    for name in ("multirate-residual-kf", "returned"):
        base: Any = KeepingEnv()
        env: Any = NativeObservation(base, returned=True)
        if name != "returned":
            env = EstimateObservation(base, name, outputs=STATES, std=False)
        drive = rollout(env, make_agent("lane-keeping", env, moment=False), seed=0)
        assert drive["t"][-1] == KEEPING.duration
        offset[name] = abs(base.motion.y)
    assert offset["multirate-residual-kf"] < 0.2 < offset["returned"]


def test_snapshots_and_options_are_refused() -> None:
    env = KeepingEnv()
    with pytest.raises(TypeError, match="no snapshots"):
        env.get_state()
    with pytest.raises(ValueError, match="starts as it is, got friction"):
        env.reset(options={"friction": 0.5})
