"""The rungs: what each of them is given, in single and vector alike, and that knowing pays."""

import itertools
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.baselines import ORACLES, make_noise_options, make_oracle
from sideslip.agents.controllers.base import Controller
from sideslip.agents.controllers.lqr import Lqr
from sideslip.agents.design.sampled_model import make_design_model
from sideslip.agents.rollout import evaluate_episodes
from sideslip.envs import COMS
from sideslip.envs.record import PACKET
from sideslip.envs.scenarios.manoeuvres import SCENARIOS, TIERS
from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.scenarios.world import WORLDS, World
from sideslip.estimators.vector.estimate import EstimateObservation
from tests.agents.helpers import compute_gains
from tests.agents.test_car_truth import SLALOM
from tests.envs.helpers import bits

FUSION, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"
VISION = "sideslip/YawVision-v0"
LINEAR = {"base": "random-steering", "tyres": "linear"}


OFTEN = [*((rung, FUSION) for rung in ORACLES), ("oracle-state-lqr", AFS), ("nominal", VISION)]
RARELY = [each for each in itertools.product(ORACLES, (AFS, VISION)) if each not in OFTEN]


WORLDLY = [(rung, AFS, True) for rung in ("oracle-parameters-lqr", "oracle-state-nmpc")]


@pytest.mark.parametrize(
    ("rung", "env_id", "in_world"),
    [
        *((*each, False) for each in OFTEN),
        *WORLDLY,
        *(pytest.param(*each, False, marks=pytest.mark.long) for each in RARELY),
    ],
)
def test_rows_of_a_vector_env_have_single_ones_bits(rung: str, env_id: str, in_world: bool) -> None:
    options = {"controller": {} if rung == "nominal" else {"knots": 2}}
    told: Any = SLALOM | {"world": "v1"} if in_world else {"options": options}
    envs, agent = make_oracle(rung, env_id, num_envs=2, **told)
    env, alone = make_oracle(rung, env_id, **told)
    assert isinstance(agent, Controller) and agent.grip
    obs, state = envs.reset(seed=7)[0], None
    one, own = env.reset(seed=8)[0], None
    for _ in range(12):
        assert bits(obs[1]) == bits(one)
        action, state = agent.predict(obs, state)
        single, own = alone.predict(one, own)
        assert bits(action[1]) == bits(single)
        obs, one = envs.step(action)[0], env.step(single)[0]
    obs[0, :] = np.nan
    action, _ = agent.predict(obs, state)
    assert np.isnan(action[0]).all() and np.isfinite(action[1]).all()


def test_nominal_knows_the_noise_of_the_sensors_that_are_there() -> None:
    env, _ = make_oracle("nominal", "sideslip/YawGps-v1")  # whose world has a camera that is askew
    env.reset(seed=0)
    noisy = {"base": "random-steering", "noise": {"course": 1.0}, "speed": 8.0}
    env, _ = make_oracle("nominal", "sideslip/YawGps-v0", scenario=noisy)
    assert env.estimator.config.noise["course"] == pytest.approx(1.0 / 8.0)


def test_gains_between_the_knots_are_those_of_the_true_car() -> None:
    """Interpolated over speed and both stiffnesses, against a design for the car at hand."""
    _, agent = make_oracle("oracle-parameters-lqr", FUSION)
    assert isinstance(agent, Lqr)
    rng = np.random.default_rng(0)
    for _ in range(20):
        speed, front, rear = rng.uniform((5.0, 0.6, 0.6), (10.0, 1.4, 1.4))
        car = COMS.scale_stiffness(front, rear)
        K = compute_gains(agent, speed, car.front_stiffness, car.rear_stiffness)
        wanted = make_design_model(car, speed, agent.design_spec).solve()[0]
        assert np.abs(K[:, :4] - wanted[:, :4]).max() < 0.02 * np.abs(wanted[:, :4]).max()


def test_nominal_reads_the_nominal_car_alone() -> None:
    """Whatever the true tyres are, its filter and its gains are the nominal car's."""
    env, agent = make_oracle("nominal", FUSION)
    env.reset(seed=0)
    believed = env.get_wrapper_attr("estimator").filters[0].car
    assert list(believed[4:6]) == [COMS.front_stiffness, COMS.rear_stiffness]
    assert not any(name.startswith("true_") for name in agent.needs)


def test_options_go_to_the_filter_and_the_controller() -> None:
    options: Any = {"filter": {"force_sd": 7.0, "slow": ["gps"]}, "controller": {"grip": 0.3}}
    env, agent = make_oracle("nominal", FUSION, options=options)
    recorded = env.spec.additional_wrappers[-1].kwargs["options"]
    assert recorded["force_sd"] == 7.0 and recorded["slow"] == ["gps"] and agent.grip == 0.3
    with pytest.raises(TypeError, match="'filter' and 'controller'"):
        make_oracle("nominal", FUSION, options={"gains": {}})
    with pytest.raises(ValueError, match="oracle"):
        make_oracle("clairvoyant", FUSION)


def test_levels_are_the_scenarios() -> None:
    changes: Any = {"disturbance_force": 7.0, "noise": {"gyro": 0.1}, "hdop_law": "table"}
    scenario = SCENARIOS["straight"].replace(**changes)
    levels = make_noise_options(scenario)
    assert levels["force_sd"] == 7.0 and levels["gyro_noise"] == 0.1
    assert levels["hdop_table"] == [(1.0, 1.0), (101.0, 101.0)]


def test_levels_of_a_world_are_those_of_its_ranges() -> None:
    """Uniform within +-a: a / sqrt(3); what has no range has no state; what is known no force."""
    scenario, v1 = SCENARIOS["car-slalom"], WORLDS["v1"]
    levels, plain = make_noise_options(scenario, v1), make_noise_options(scenario)
    assert levels["camera_yaw_sd"] == pytest.approx(v1.camera_yaw[1] / 3**0.5)  # type: ignore[index]
    assert levels["steer_offset_sd"] == pytest.approx(v1.steer_offset[1] / 3**0.5)  # type: ignore[index]
    assert levels["bank_sd"] == pytest.approx(math.hypot(0.02, 0.02) / 3**0.5)
    with_tyres = make_noise_options(scenario, v1, True)
    assert levels.keys() - with_tyres.keys() == {"force_share", "moment_share"}
    still = make_noise_options(scenario, World(moment_rate=0.1), True)
    assert {key: value for key, value in still.items() if value and key in plain} == plain
    zeros = {key for key, value in still.items() if not value}
    assert zeros == {"camera_yaw_sd", "steer_offset_sd", "q_psi"}


@pytest.mark.parametrize(("name", "most"), [("coms-slalom", 6.0), ("car-slalom", 4.0)])
def test_in_a_world_nominal_knows_how_wrong_its_slip_may_be(name: str, most: float) -> None:
    """Nobody drives: the squared error over its variance, in the median of the cars."""
    car = "coms" if name.startswith("coms") else "passenger-car"
    env: Any = gym.make_vec(FUSION, CARS, scenario=name, vehicle=car, nominal=car, world="v1")
    base, found = SCENARIOS[name], []
    for world in (WORLDS["v1"], WORLDS["ideal"]):
        options = make_noise_options(base, world) | {"slow": ["camera", "gps"]}
        wrapped = EstimateObservation(env, "exact-kf", ("beta",), replace=True, options=options)
        obs, squares, over = wrapped.reset(seed=2**29)[0], [], np.zeros(CARS, bool)
        while not over.all():
            obs, _, terminated, truncated, infos = wrapped.step(np.zeros((CARS, 1), np.float32))
            over |= terminated | truncated
            square = ((obs[:, 0] - infos["beta"]) / obs[:, 1]) ** 2
            squares.append(np.where(over, np.nan, square))
        found.append(np.median(np.nanmean(squares[100:-1], axis=0)))
    assert found[0] < most < 50.0 < found[1]


def test_biases_are_taken_away_for_the_oracle_alone() -> None:
    biased = {"base": "straight", "noise": {"gyro_bias": 0.2, "gyro": 1e-9}, "speed": 7.0}
    biased |= {"gyro_bias": 0.1, "accel_y_bias": (0.1, 0.2)}
    for rung, wanted in (("nominal", 0.3), ("oracle-parameters-lqr", 0.0)):
        env, _ = make_oracle(rung, FUSION, scenario=biased)
        obs, _ = env.reset(seed=0)
        assert obs[0] == pytest.approx(wanted, abs=1e-3)
        assert env.unwrapped.scenario.noise["gyro"] == 1e-9


def test_one_table_serves_all_who_ask_for_it() -> None:
    """The design takes a second."""
    rungs = [make_oracle("oracle-parameters-lqr", FUSION, scenario=x)[1] for x in ("sine", "gust")]
    assert all(isinstance(each, Lqr) for each in rungs)
    assert rungs[0].table is rungs[1].table  # type: ignore[attr-defined]


@pytest.mark.long
def test_knowing_pays_on_the_linear_car() -> None:
    """Where the LQG is the optimum each rung costs less than the one below: three errors."""
    plain = LINEAR | {"small_angle": True, "roll": False}
    pairs = [make_oracle(rung, FUSION, 64, scenario=plain) for rung in ORACLES[:3]]
    found = [np.log(evaluate_episodes(*pair, range(64))[0]) for pair in pairs]
    for lower, upper in itertools.pairwise(found):
        gap = lower - upper
        assert gap.mean() > 3.0 * gap.std(ddof=1) / len(gap) ** 0.5


CARS = 16
VIEWED = ("coms-slalom", "coms-brake-in-turn", "car-step", "limit-sine-with-dwell")
SCORED = [
    each.name if each.name in VIEWED else pytest.param(each.name, marks=pytest.mark.long)
    for each in TIERS
    if each.tier
]


def share_seen(scenario: Scenario) -> float:
    """Of the camera's frames, under the rung that knows the nominal car."""
    car = "coms" if scenario.tier == "1" else "passenger-car"
    env: Any
    facts: Any = {"scenario": scenario.to_dict(), "vehicle": car, "nominal": car}
    env, agent = make_oracle("nominal", FUSION, CARS, reference="limited", **facts)
    base, state, start = env.unwrapped, None, np.ones(CARS, bool)
    obs, _ = env.reset(seed=100)
    seen = []
    for _ in range(round(scenario.duration / 0.01) - 1):
        actions, state = agent.predict(obs, state, start)
        obs, _, terminated, truncated, _ = env.step(actions)
        start = terminated | truncated
        for i in range(CARS):
            packets = base.packets[i, : base.delivered[i]]
            seen.append(packets[packets[:, PACKET.sensor] == 0, PACKET.quality])
    return float(np.concatenate(seen).mean())


@pytest.mark.parametrize("name", SCORED)
def test_the_lane_is_seen_in_most_frames(name: str) -> None:
    """With tyres from 0.6 to 1.4 of the nominal ones; a car that spins looks elsewhere."""
    scenario = SCENARIOS[name]
    assert scenario.front_stiffness == (0.6, 1.4) and scenario.camera_heading < 0.4
    least = {"limit": 0.6, "road": 0.75}.get(scenario.tier, 0.8)
    assert share_seen(scenario) > least


@pytest.mark.parametrize("name", ["coms-brake-in-turn", "coms-step", "limit-step"])
def test_on_a_straight_road_it_would_not(name: str) -> None:
    scenario = SCENARIOS[name]
    assert share_seen(scenario.replace(road="straight")) < min(0.9, share_seen(scenario))
