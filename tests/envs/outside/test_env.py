"""The environment around an outside plant: our contract, sensors, failures and refusals."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sideslip.agents import make_agent
from sideslip.agents.rollout import rollout
from sideslip.envs import FAILURES
from sideslip.envs.engine.layout import Z
from sideslip.envs.numerics.packed import read
from sideslip.envs.sensors.inertial import compute_specific_force
from sideslip.envs.vehicle.dynamics import CarParams, DisturbanceForces, Motion, RoadParams, kutta3
from sideslip.envs.vehicle.tyres import FIALA, PlantVariant, TyreInputs, compute_tyre_load
from sideslip.estimators import EstimateObservation

pytest.importorskip("vehiclemodels")
from sideslip.envs.outside.plants import (
    OUTSIDE_PLANTS,
    OutsideInputs,
    OutsidePlant,
    make_outside_vehicle,
)

from ..helpers import bits
from .cars import CALM, MODELS, STEP, V, driven, outside


@pytest.mark.parametrize("model", MODELS)
def test_the_environment_keeps_gymnasiums_contract(model: str) -> None:
    env = outside(model, scenario=STEP | {"duration": 0.3})
    check_env(env, skip_render_check=True)


def test_an_outside_plant_is_drawn_without_tyre_forces() -> None:
    from sideslip.envs.rendering.road import make_car_scene

    env = outside("drift", scenario=STEP | {"duration": 0.3}, render_mode="rgb_array")
    env.reset(seed=0)
    env.step([1.0])
    frame = env.render()
    assert frame is not None and frame.std() > 10.0
    scene = make_car_scene(env.make_render_state())
    assert [wheel[3:] for wheel in scene.wheels] == [(0.0, 0.0, 0.0)] * 4
    assert scene.motion == env.motion


@pytest.mark.parametrize("model", MODELS)
def test_sensors_and_disturbances_draw_what_ours_draw(model: str) -> None:
    scenario = STEP | {"noise": {}, "duration": 0.2}
    scenario |= {"disturbance_force": 300.0, "disturbance_moment": 100.0}
    vehicle = make_outside_vehicle().to_dict()
    ours: Any = gym.make("sideslip/YawFusion-v0", scenario=scenario, vehicle=vehicle).unwrapped
    env = outside(model, scenario=scenario)
    errors, disturbances = [], []
    for each in (ours, env):
        each.reset(seed=5)
        for _ in range(10):
            each.step([0.0])
        errors.append(each.record.fast[-1, 0] - each.motion.gamma)
        drive = read(each.get_state()["state"], Z.drive)
        disturbances.append((drive.F_d, drive.N_d))
        assert each.ticks_done == 10
    assert errors[0] == pytest.approx(errors[1], abs=1e-15)
    assert disturbances[0] == disturbances[1]
    assert 0.0 not in disturbances[0]
    assert ours.layout == env.layout


class OwnPlant(OutsidePlant):
    """Our own plant as an outside one: Fiala tyres, roll, inputs held over a tick."""

    law = "vehicle_dynamics_std"  # loaded, not used
    car: CarParams

    def _make_state(self, core: list[float], motion: Motion) -> Any:
        return np.array(motion)

    def _compute_derivative(self, x: Any, acting: OutsideInputs) -> Any:
        raise NotImplementedError

    @property
    def motion(self) -> Motion:
        return Motion(*self.x.tolist())

    def _compute_specific_force(self, acting: OutsideInputs) -> tuple[float, float]:
        raise NotImplementedError

    def step(self, acting: OutsideInputs, h: float) -> None:
        car = self.car._replace(mu=self.p.tire.p_dy1, mu_r=self.p.tire.p_dy1)
        load = compute_tyre_load(TyreInputs(*acting[:3]), car, PlantVariant(0, FIALA, 1))
        before, push, road = self.motion, DisturbanceForces(*acting[3:]), RoadParams(0.0, 0.0, 1.0)
        after = kutta3(before, (load, load, load), push, car, road, h, PlantVariant(0, FIALA, 1))
        self.x = np.array(after)
        self.specific_force = compute_specific_force(before, after, road, 0, 1)


@pytest.mark.parametrize("base", ["random-steering", "double-lane-change", "gust"])
def test_around_our_own_plant_it_is_our_own_environment(
    base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands, sensors, references, cost and the end of an episode are those of our own ticks."""
    monkeypatch.setitem(OUTSIDE_PLANTS, "drift", OwnPlant)
    scenario = {"base": base, "duration": 3.0, "lags": False, "wind_height": 0.0, "speed": 20.0}
    scenario |= {"front_stiffness": 1.0, "rear_stiffness": 1.0}
    arguments: dict[str, Any] = {"scenario": scenario, "steering": True, "reference": "model"}
    vehicle = make_outside_vehicle().to_dict()
    ours: Any = gym.make("sideslip/AfsYawFusion-v0", vehicle=vehicle, **arguments).unwrapped
    env = outside("drift", **arguments)
    assert bits(ours.reset(seed=5)) == bits(env.reset(seed=5))
    over, rng = False, np.random.default_rng(1)
    while not over:
        action = rng.uniform(-1.0, 1.0, 2)
        obs, reward, *ends, info = ours.step(action)
        found, cost, *ended, facts = env.step(action)
        assert (bits(obs), bits(ours.record), ends) == (bits(found), bits(env.record), ended)
        assert (reward, info) == (pytest.approx(cost, rel=1e-13), pytest.approx(facts, rel=1e-13))
        over = any(ends)
    assert facts["t"] > 1.0


@pytest.mark.parametrize("model", MODELS)
def test_a_snapshot_continues_bit_for_bit(model: str) -> None:
    env = outside(model, scenario=STEP)
    env.reset(seed=1)
    env.step([0.3])
    snapshot = env.get_state()
    first = [env.step([0.5])[0] for _ in range(5)]
    env.reset(seed=2)
    env.set_state(snapshot)
    np.testing.assert_array_equal([env.step([0.5])[0] for _ in range(5)], first)


@pytest.mark.parametrize("model", MODELS)
def test_yaw_moment_acts_and_is_told(model: str) -> None:
    env = outside(model, scenario=CALM | {"lags": False})
    env.reset(seed=0)
    for _ in range(10):
        *_, info = env.step([0.5])
    half = 0.5 * make_outside_vehicle().yaw_moment_limit
    assert info["yaw_moment"] == pytest.approx(half, rel=1e-3)
    assert info["gamma"] > 0.01


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.long
def test_estimators_and_controllers_run_on_it(model: str) -> None:
    scenario = {"base": "lane-change", "speed": 20.0, "duration": 3.0, "front_stiffness": 1.0}
    scenario |= {"rear_stiffness": 1.0, "friction": 1.0, "amplitude": 0.03}
    env = EstimateObservation(outside(model, scenario=scenario), "exact-kf")
    drive = rollout(env, make_agent("two-dof", env), 3)
    assert not drive.failed
    error, slip = drive["obs_beta_hat"] - drive["beta"], np.sqrt(np.mean(drive["beta"] ** 2))
    assert slip > 2e-3  # rad
    assert np.sqrt(np.mean(error**2)) < 0.4 * slip  # the multi-body car's roll is not modelled


@pytest.mark.long
@pytest.mark.parametrize("model", MODELS)
def test_our_driver_keeps_it_on_a_track(model: str) -> None:
    track = CALM | {"steering": "driver", "path": "iso-3888-1", "speed": 12.0, "duration": 12.0}
    env = outside(model, scenario=track | {"half_width": 1.0})
    env.reset(seed=0)
    end, left = 130.0 if model == "single-track" else 75.0, 0.0  # the others: into the side lane
    while end > env.motion.X:
        *_, terminated, over, _ = env.step([0.0])
        left = max(left, env.motion.Y)
        assert not (terminated or over)
    assert left > 3.0


def test_a_spin_ends_the_episode_and_the_rest_is_charged() -> None:
    env = outside("drift", scenario=CALM)
    env.reset(seed=0, options={"state": {"v_y": -0.45 * V, "gamma": 2.0}})
    over, cost = False, 0.0
    while not over:
        _, reward, terminated, truncated, info = env.step([0.0])
        over, cost = terminated or truncated, cost - reward
    assert FAILURES[info["failure"]] == "spin" and 0.5 < abs(info["beta"]) < 0.55
    assert cost > 100.0 * (2.0 - info["t"]) > 0.0


ODD = [(3, np.nan), (3, 1e200), (5, -1e200), (3, 0.0), (6, math.inf)]


@pytest.mark.parametrize(("place", "value"), ODD)
@pytest.mark.parametrize("model", MODELS)
def test_no_state_makes_a_step_raise(model: str, place: int, value: float) -> None:
    """No number, squares that overflow, a car at rest in a turn, no angle: numbers come back."""
    env = outside(model, scenario=STEP)
    env.reset(seed=0)
    env.step([0.0])
    env.plant.x[5], env.plant.x[place] = 1.0, value
    obs, reward, terminated, _, info = env.step([0.0])
    if value != 0.0:
        assert terminated
        assert FAILURES[info["failure"]] == "not-finite"
    assert np.isfinite([*obs, reward, *map(float, info.values())]).all()
    assert np.isfinite(env.record.fast).all()


def test_a_state_whose_squares_are_no_numbers_is_not_finite() -> None:
    """As in our kernel: the references and sensors take them."""
    for model, places in (("drift", (3, 5)), ("multi-body", (3, 5, 10))):
        for place in places:
            plant = driven(model, OutsideInputs(0.0), 0.001)
            assert plant.is_finite
            plant.x[place] = 1e160
            assert not plant.is_finite


def test_a_force_that_cannot_be_told_makes_the_state_no_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The derivative at the end of a step is asked for by the accelerometers alone."""
    env = outside("multi-body", scenario=STEP)
    env.reset(seed=0)
    env.step([0.0])

    def nothing(acting: OutsideInputs) -> tuple[float, float]:
        raise ZeroDivisionError

    monkeypatch.setattr(env.plant, "_compute_specific_force", nothing)
    *_, info = env.step([0.0])
    assert FAILURES[info["failure"]] == "not-finite"
    assert np.isfinite(env.record.fast).all()


def test_a_wheel_at_rest_in_a_spin_makes_the_state_no_number() -> None:
    plant = driven("multi-body", OutsideInputs(0.0), 0.01)
    plant.x[3], plant.x[5] = 1.0, 2.0 / plant.p.T_r  # the inner rear wheel stands still
    plant.step(OutsideInputs(0.0), 1e-3)
    assert not plant.is_finite


OURS: dict[str, Any] = {  # of our own plant and road
    "curvature": 0.01, "bank": 0.05, "grade": 0.05, "small_angle": True, "tyres": "linear",
    "vehicle": {"mass": 1500.0}, "friction_right": 0.3, "tyre_change_time": 1.0,
}  # fmt: skip
SLOW: list[dict[str, Any]] = [
    {"speed": (0.99, 20.0)},
    {"speed": 10.0, "speed_change": -9.5},
    {"speed": 10.0, "acceleration": -1.0, "duration": 9.5},
]
COMES_DOWN = "'custom': its speed comes down to 0.* needs 1.0 m/s"
REFUSED_SCENARIOS: list[tuple[str, dict[str, Any], str]] = [
    *[("drift", {name: value}, f"{name} .* is of our own plant") for name, value in OURS.items()],
    *[("multi-body", scenario, COMES_DOWN) for scenario in SLOW],
    ("single-track", {"wind_height": 0.4}, "wind_height 0.4 rolls the body; the single-track"),
    ("drift", {"wind_height": -0.4}, "wind_height -0.4 rolls the body; the drift"),
    ("multi-body", {"roll": False}, "roll False; the multi-body model always rolls"),
]
REFUSED_OPTIONS: list[tuple[str, dict[str, Any], str]] = [
    ("drift", {"vehicle": "coms"}, "its own vehicle"),
    ("drift", {"state": {"s": 1.0}}, "s follows from X and Y"),
    ("drift", {"state": {"phi": 0.1}}, "drift model has no roll"),
    ("drift", {"wheels": 3}, "unknown reset option wheels"),
    ("single-track", {"friction": 0.5}, "friction: the single-track model's tyres are linear"),
    ("multi-body", {"scenario": SLOW[0]}, "comes down to 0"),
    ("multi-body", {"scenario": SLOW[2] | {"duration": 1.0}, "duration": 9.5}, "comes down to 0"),
    ("multi-body", {"state": {"v_x": 0.9}}, "v_x is 0.9 m/s; the multi-body model needs 1.0"),
    ("multi-body", {"state": {"v_x": -5.0}}, "v_x is -5.0 m/s; the multi-body model needs"),
]


@pytest.mark.parametrize(("model", "scenario", "message"), REFUSED_SCENARIOS, ids=str)
def test_a_scenario_that_a_model_cannot_drive_is_refused(
    model: str, scenario: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        outside(model, scenario=scenario)
    with pytest.raises(ValueError, match=message):
        outside(model, scenario=STEP).reset(options={"scenario": scenario})


@pytest.mark.parametrize(("model", "options", "message"), REFUSED_OPTIONS, ids=str)
def test_an_option_that_has_no_meaning_is_refused(
    model: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        outside(model, scenario=STEP).reset(options=options)


def test_what_the_other_models_can_drive_is_allowed() -> None:
    for scenario in SLOW:
        outside("drift", scenario=scenario)
    for model in MODELS:
        allowed = {"wind_height": 0.4} if model == "multi-body" else {"roll": False}
        outside(model, scenario=CALM | allowed).reset(seed=0)
    outside("drift", scenario=STEP).reset(seed=0, options={"friction": 0.5})


def test_unknown_models_and_vehicles_and_snapshots_of_another_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown model 'brick'; known: single-track, drift"):
        outside("brick")
    with pytest.raises(TypeError, match="its own vehicle"):
        outside("drift", vehicle="coms")
    with pytest.raises(ValueError, match="'drift', not 'single-track'"):
        outside("single-track", scenario=STEP).set_state(outside("drift").get_state())


def test_a_bad_action_is_refused_or_fails_as_in_every_environment() -> None:
    env = outside("drift", scenario=STEP)
    env.reset(seed=0)
    before = env.plant.x.copy()
    with pytest.raises(ValueError, match="not finite; nothing was stepped"):
        env.step([np.nan])
    np.testing.assert_array_equal(env.plant.x, before)
    env = outside("drift", scenario=STEP, on_bad_action="fail")
    env.reset(seed=0)
    assert FAILURES[env.step([np.nan])[4]["failure"]] == "bad-action"
