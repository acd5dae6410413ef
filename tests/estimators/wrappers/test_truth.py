"""TruthObservation and filters of the true car: what is read, in single and vector alike."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from sideslip.envs import COMS
from sideslip.envs.engine.layout import TRUE_STATE
from sideslip.estimators import EstimateObservation, make_estimator
from sideslip.estimators.vector import estimate as vectorised
from sideslip.estimators.vector.estimate import TruthObservation as VectorTruthObservation
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.envs.helpers import bits

FUSION = "sideslip/YawFusion-v0"
PARAMETERS = ["front_stiffness", "rear_stiffness", "friction"]
OUTPUTS = ["beta", "gamma", "F_d", "N_d"]
OPTIONS: dict[str, Any] = {"outputs": OUTPUTS, "std": False, "vehicle": "truth"}


def test_filter_and_observation_have_the_car_of_each_episode() -> None:
    inner = EstimateObservation(gym.make(FUSION), "exact-kf", **OPTIONS)
    env: Any = TruthObservation(inner, PARAMETERS)
    seen = set()
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        car = env.unwrapped.vehicle
        true = [car.front_stiffness, car.rear_stiffness, car.friction]
        assert obs[-3:] == pytest.approx(true, rel=1e-7)
        believed = env.get_wrapper_attr("estimator").filters[0].car
        assert list(believed[4:6]) == true[:2]
        seen.add(car.front_stiffness)
        env.step(np.zeros(1, np.float32))
    assert len(seen) == 3


def test_a_filter_given_the_car_at_the_reset_is_one_that_is_built_for_it() -> None:
    """The short way, without a design, gives the bits of the long one."""
    env = EstimateObservation(gym.make(FUSION), "exact-kf", **OPTIONS)
    for seed in range(2):
        env.reset(seed=seed)
    base: Any = env.unwrapped
    other = make_estimator("exact-kf", vehicle=base.vehicle, sensors=base.slow_sensors)
    other.step(base.record.fast, base.record.packets)
    for _ in range(30):
        env.step(np.array([0.3], np.float32))
        other.step(base.record.fast, base.record.packets)
    assert (env.estimator.x == other.x).all() and (env.estimator.P == other.P).all()


def test_periodic_gains_are_designed_for_the_true_car() -> None:
    env: Any = EstimateObservation(
        gym.make("sideslip/YawVision-v0"), "multirate-kf", vehicle="truth", std=False
    )
    first = env.estimator
    env.reset(seed=1)
    assert env.estimator is not first
    believed = env.estimator.filters[0].car[4]
    assert believed == env.get_wrapper_attr("vehicle").front_stiffness != COMS.front_stiffness


def test_states_are_the_plants_own() -> None:
    env: Any = TruthObservation(gym.make(FUSION), (), list(TRUE_STATE._fields))
    obs, info = env.reset(seed=0)
    for _ in range(20):
        state = dict(zip(TRUE_STATE._fields, obs[-len(TRUE_STATE) :].tolist(), strict=True))
        motion = env.unwrapped.motion
        assert state["beta"] == pytest.approx(info["beta"], rel=1e-6, abs=1e-9)
        assert state["gamma"] == pytest.approx(info["gamma"], rel=1e-6, abs=1e-9)
        assert (state["phi"], state["phi_rate"]) == pytest.approx(
            (motion.phi, motion.phi_dot), rel=1e-6, abs=1e-9
        )
        obs, _, _, _, info = env.step(np.zeros(1, np.float32))


def test_disturbances_are_all_that_pushes() -> None:
    """The wind with its arm, and a bank whose left side is up, which pulls to the right."""
    still = {"base": "straight", "disturbance_force": 0.0, "disturbance_moment": 0.0}
    wind = {"wind_force": 100.0, "wind_arm": 0.2, "wind_length": 9.0, "mirror": False}
    for more, wanted in (
        (wind, [100.0, 20.0]),
        ({"bank": 0.05, "curve_start": -100.0, "mirror": False}, [-380 * 9.81 * 0.05, 0.0]),
    ):
        env = TruthObservation(gym.make(FUSION, scenario=still | more), (), ["F_d", "N_d"])
        obs, _ = env.reset(seed=0)
        assert obs[-2:] == pytest.approx(wanted, rel=1e-3)


def _wrapped(vector: bool, env: Any, states: tuple[str, ...]) -> Any:
    truth = VectorTruthObservation if vector else TruthObservation
    wrapper = vectorised.EstimateObservation if vector else EstimateObservation
    options = OPTIONS | ({"outputs": ["psi"]} if states else {})
    return truth(wrapper(env, "exact-kf", **options), PARAMETERS, states)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mode", "states"),
    [("NextStep", ()), ("SameStep", ()), ("NextStep", tuple(TRUE_STATE._fields))],
)
def test_rows_of_a_vector_env_have_bits_of_single_ones(mode: str, states: tuple[str, ...]) -> None:
    def made(i: int, wrap: bool) -> Any:
        env = gym.make(FUSION, scenario={"base": "random-steering", "duration": 0.05 + 0.02 * i})
        return _wrapped(False, env, states) if wrap else env

    def fleet(wrap: bool) -> Any:
        makers = [functools.partial(made, i, wrap) for i in range(3)]
        return SyncVectorEnv(makers, autoreset_mode=mode)

    alone, together = fleet(True), _wrapped(True, fleet(False), states)
    observed = [env.reset(seed=5)[0] for env in (alone, together)]
    rng = np.random.default_rng(0)
    for _ in range(25):
        assert bits(observed[0]) == bits(observed[1])
        action = rng.uniform(-0.3, 0.3, (3, 1)).astype(np.float32)
        steps = [env.step(action) for env in (alone, together)]
        observed = [step[0] for step in steps]
        assert ("final_obs" in steps[0][-1]) == ("final_obs" in steps[1][-1])
        for i in np.flatnonzero(steps[0][-1].get("_final_obs", ())):
            assert bits(steps[0][-1]["final_obs"][i]) == bits(steps[1][-1]["final_obs"][i])


def test_the_batch_engine_offers_the_states_of_its_rows() -> None:
    envs: Any = VectorTruthObservation(gym.make_vec(FUSION, num_envs=3), (), ["beta", "F_d"])
    alone: Any = TruthObservation(gym.make(FUSION), (), ["beta", "F_d"])
    rows, _ = envs.reset(seed=4)
    one, _ = alone.reset(seed=6)
    for _ in range(5):
        assert bits(rows[2]) == bits(one)
        rows = envs.step(np.full((3, 1), 0.2, np.float32))[0]
        one = alone.step(np.full(1, 0.2, np.float32))[0]


@pytest.mark.long
def test_given_the_truth_the_filter_knows_its_error() -> None:
    """Small angles and linear tyres, car and speed drawn: the squared errors are those of P."""
    plain = {"small_angle": True, "tyres": "linear", "roll": False, "lags": False}
    scenario = {"base": "random-steering", **plain}
    options = {"slow": ["camera", "gps"], "hdop_table": [(1.0, 1.0), (101.0, 51.0)]}
    bare = gym.make(FUSION, scenario=scenario)
    env = EstimateObservation(bare, "exact-kf", vehicle="truth", options=options)
    means = []
    for seed in range(16):
        env.reset(seed=seed)
        nees, over = [], False
        while not over:
            _, _, terminated, truncated, info = env.step(np.zeros(1, np.float32))
            over = terminated or truncated
            nees.append(info["nees"])
        means.append(np.mean(nees[100:]))
    error = np.std(means, ddof=1) / len(means) ** 0.5
    assert abs(np.mean(means) - 1.0) < 3.0 * error < 0.3


@pytest.mark.parametrize("num_envs", [None, 3])
def test_beside_states_the_friction_is_the_present_one(num_envs: int | None) -> None:
    """Without states it is the one at the reset: a change is no parameter."""
    jump = {"base": "limit-friction-jump", "tyre_change_time": 0.2, "friction_change": 0.5}
    told: Any = {"scenario": jump, "vehicle": "passenger-car"}
    env: Any = gym.make(FUSION, **told)
    wrapper: Any = TruthObservation
    if num_envs:
        env, wrapper = gym.make_vec(FUSION, num_envs=num_envs, **told), VectorTruthObservation
    for states, factor in (((), 1.0), (("beta",), 0.5)):
        wrapped = wrapper(env, ("friction",), states)
        column = [entry.name for entry in wrapped.layout].index("true_friction")
        first = np.atleast_2d(wrapped.reset(seed=3)[0])[:, column]
        idle = np.zeros(wrapped.action_space.shape or (1,), np.float32)
        seen = np.array([np.atleast_2d(wrapped.step(idle)[0])[:, column] for _ in range(40)])
        assert (seen[:18] == first).all() and seen[-1] == pytest.approx(factor * first)
