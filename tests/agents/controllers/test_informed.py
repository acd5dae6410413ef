"""The informed controller: told the truth of each episode, in single and vector alike."""

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from sideslip.agents import make_agent
from sideslip.agents.controllers.informed import GRIP, OUTPUTS, PARAMETERS, levels_of, make_informed
from sideslip.agents.controllers.lqr import Lqr
from sideslip.agents.design.sampled_model import design_model, regulator
from sideslip.envs import COMS
from sideslip.envs.scenarios.manoeuvres import SCENARIOS
from sideslip.estimators import EstimateObservation, make_estimator
from sideslip.estimators.vector import estimate as vectorised
from sideslip.estimators.vector.truth import TruthObservation as VectorTruthObservation
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.envs.helpers import bits

FUSION = "sideslip/YawFusion-v0"
LINEAR = {"base": "random-steering", "tyres": "linear"}
OPTIONS: dict[str, Any] = {"outputs": OUTPUTS, "std": False, "vehicle": "truth"}


def cost(env: Any, agent: Any, seeds: range) -> np.ndarray:
    """J of each seed."""
    costs = []
    for seed in seeds:
        obs, _ = env.reset(seed=seed)
        state, J, over = None, 0.0, False
        while not over:
            action, state = agent.predict(obs, state)
            obs, reward, terminated, truncated, _ = env.step(action)
            J, over = J - float(reward), terminated or truncated
        costs.append(J)
    return np.array(costs)


def test_gains_between_the_knots_are_those_of_the_true_car() -> None:
    """Interpolated over speed and both stiffnesses, against a design for the car at hand."""
    _, agent = make_informed(FUSION)
    rng = np.random.default_rng(0)
    for _ in range(20):
        speed, front, rear = rng.uniform((5.0, 0.6, 0.6), (10.0, 1.4, 1.4))
        car = COMS.scaled(front, rear)
        K = agent.gains(speed, car.front_stiffness, car.rear_stiffness)
        wanted = regulator(design_model(car, speed, agent.purpose))[0]
        assert np.abs(K[:, :4] - wanted[:, :4]).max() < 0.02 * np.abs(wanted[:, :4]).max()


def test_filter_and_observation_are_told_the_car_of_each_episode() -> None:
    env, _ = make_informed(FUSION)
    seen = set()
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        car = env.unwrapped.vehicle
        told = [car.front_stiffness, car.rear_stiffness, car.friction]
        assert obs[-3:] == pytest.approx(told, rel=1e-7)
        told = env.get_wrapper_attr("estimator").filters[0].car
        assert list(told[4:6]) == [car.front_stiffness, car.rear_stiffness]
        seen.add(car.front_stiffness)
        env.step(np.zeros(1, np.float32))
    assert len(seen) == 3


def test_a_filter_told_at_the_reset_is_one_that_is_built_for_the_car() -> None:
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
    told = env.estimator.filters[0].car[4]
    assert told == env.get_wrapper_attr("vehicle").front_stiffness != COMS.front_stiffness


def _told(vector: bool, env: Any) -> Any:
    wrapper = vectorised.EstimateObservation if vector else EstimateObservation
    truth = VectorTruthObservation if vector else TruthObservation
    return truth(wrapper(env, "exact-kf", **OPTIONS), PARAMETERS)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_rows_of_a_vector_env_have_the_bits_of_single_ones(mode: str) -> None:
    def made(i: int, wrap: bool) -> Any:
        env = gym.make(FUSION, scenario={"base": "random-steering", "duration": 0.05 + 0.02 * i})
        return _told(False, env) if wrap else env

    def fleet(wrap: bool) -> Any:
        makers = [functools.partial(made, i, wrap) for i in range(3)]
        return SyncVectorEnv(makers, autoreset_mode=mode)

    alone, together = fleet(True), _told(True, fleet(False))
    agents = [make_agent("informed", env) for env in (alone, together)]
    observed = [env.reset(seed=5)[0] for env in (alone, together)]
    for _ in range(25):
        assert bits(observed[0]) == bits(observed[1])
        actions = [a.predict(obs)[0] for a, obs in zip(agents, observed, strict=True)]
        assert bits(actions[0]) == bits(actions[1])
        steps = [env.step(actions[0]) for env in (alone, together)]
        observed = [step[0] for step in steps]
        assert ("final_obs" in steps[0][-1]) == ("final_obs" in steps[1][-1])
        for i in np.flatnonzero(steps[0][-1].get("_final_obs", ())):
            assert bits(steps[0][-1]["final_obs"][i]) == bits(steps[1][-1]["final_obs"][i])


@pytest.mark.long
def test_knowing_the_car_pays() -> None:
    """Linear tyres, which it is the optimum for: paired seeds, three standard errors."""
    env, agent = make_informed(FUSION, scenario=LINEAR)
    options = levels_of(env.unwrapped.scenario) | {"slow": ["camera", "gps"]}
    nominal = EstimateObservation(
        gym.make(FUSION, scenario=LINEAR), "exact-kf", outputs=OUTPUTS, options=options
    )
    seeds = range(40)
    informed = cost(env, agent, seeds)
    for name in ("lqr", "two-dof", "feedforward"):
        log_ratio = np.log(informed / cost(nominal, make_agent(name, nominal), seeds))
        assert log_ratio.mean() + 3.0 * log_ratio.std() / len(seeds) ** 0.5 < 0.0, name


@pytest.mark.long
def test_told_the_truth_the_filter_knows_its_error() -> None:
    """Small angles and linear tyres, car and speed drawn: the squared errors are those of P."""
    plain = {"small_angle": True, "tyres": "linear", "roll": False, "lags": False}
    env, agent = make_informed(FUSION, scenario={"base": "random-steering", **plain})
    means = []
    for seed in range(16):
        obs, _ = env.reset(seed=seed)
        nees, over = [], False
        while not over:
            obs, _, terminated, truncated, info = env.step(agent.predict(obs)[0])
            over = terminated or truncated
            nees.append(info["nees"])
        means.append(np.mean(nees[100:]))
    error = np.std(means, ddof=1) / len(means) ** 0.5
    assert abs(np.mean(means) - 1.0) < 3.0 * error < 0.3


def test_levels_are_the_scenarios() -> None:
    scenario = SCENARIOS["straight"].replace(
        tyres="linear", disturbance_force=7.0, noise={"gyro": 0.1}, hdop_law="table"
    )
    levels = levels_of(scenario)
    assert levels["force_sd"] == 7.0 and levels["gyro_noise"] == 0.1
    assert levels["hdop_table"] == [(1.0, 1.0), (101.0, 101.0)]
    assert levels_of(scenario.replace(tyres="fiala"))["force_sd"] > 7.0


def test_bad_input() -> None:
    env = EstimateObservation(gym.make(FUSION), "exact-kf")
    with pytest.raises(ValueError, match=r"true_front_stiffness.*make_informed"):
        make_agent("informed", env)
    with pytest.raises(ValueError, match="no parameter 'colour'; it has: mass"):
        TruthObservation(env, ["colour"])
    with pytest.raises(ValueError, match="true_mass would stand twice"):
        TruthObservation(TruthObservation(env, ["mass"]), ["mass"])
    rows = SyncVectorEnv([lambda: gym.make(FUSION)])
    with pytest.raises(TypeError, match="has no layout"):
        VectorTruthObservation(rows)
    kinds = ("coms", "passenger-car")
    cars = SyncVectorEnv([functools.partial(gym.make, FUSION, vehicle=kind) for kind in kinds])
    with pytest.raises(ValueError, match="row 1 has another nominal vehicle"):
        make_agent("feedforward", cars)


def test_one_table_serves_all_who_ask_for_it() -> None:
    """The design takes a second: it is kept."""
    one, other = make_informed(FUSION)[1], make_informed(FUSION, scenario="gust")[1]
    assert isinstance(one, Lqr) and one.table is other.table


@pytest.mark.parametrize("env_id", [FUSION, "sideslip/AfsYawFusion-v0"])
def test_it_asks_for_no_more_than_the_true_friction_gives(env_id: str) -> None:
    """The motors take at most GRIP of the rear tyres' grip; steering does not slide the front."""
    env, agent = make_informed(env_id)
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    obs, _ = env.reset(seed=0)
    for friction in (0.05, 0.3, 0.9):
        harsh = obs.copy()
        harsh[names.index("true_friction")] = friction
        harsh[names.index("beta_hat")] = 0.3
        action, _ = agent.predict(harsh)
        load = COMS.mass * 9.80665 * COMS.front_arm / (2.0 * COMS.wheelbase)  # N, a rear tyre's
        most = GRIP * friction * load * COMS.rear_track / COMS.yaw_moment_limit
        assert abs(action[0]) == pytest.approx(min(most, 1.0), rel=1e-3)
        if len(action) == 2:
            driver, gamma = harsh[names.index("steer_command")], harsh[names.index("gamma_hat")]
            v = 0.5 * (harsh[names.index("wheel_left")] + harsh[names.index("wheel_right")])
            slip = driver + 0.1 * action[1] - 0.3 - COMS.front_arm * gamma / v
            front = COMS.mass * 9.80665 * COMS.rear_arm / (2.0 * COMS.wheelbase)
            most = 3.0 * friction * front / harsh[names.index("true_front_stiffness")]
            assert action[1] == 0.0 or abs(slip) <= most + 1e-6 or abs(action[1]) == 1.0


def test_without_the_true_friction_it_says_who_tells_it() -> None:
    env = _short()
    with pytest.raises(ValueError, match=r"true_friction.*make_informed"):
        make_agent("informed", env)


def _short() -> Any:
    return TruthObservation(EstimateObservation(gym.make(FUSION), "exact-kf", **OPTIONS))
