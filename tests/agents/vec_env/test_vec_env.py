"""The bridge to stable-baselines3: the bits of its DummyVecEnv, the manners its users expect."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector

from sideslip.agents import make_agent
from sideslip.agents.env_info import get_env_facts
from sideslip.envs import SCENARIOS, StabilityVectorEnv
from sideslip.estimators import EstimateObservation
from sideslip.estimators.vector import EstimateObservation as VectorEstimate
from sideslip.estimators.vector import TruthObservation as VectorTruth

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from sideslip.agents.training.normalise import RewardScale, RewardScaleWrapper
from sideslip.agents.vec_env import _NativeVecEnv, get_scales, make_vec_env
from tests.envs.helpers import bits

VISION, FUSION = "sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0"
SHORT: dict[str, Any] = {"base": "random-steering", "duration": 0.25}
NARROW: dict[str, Any] = {"base": "straight", "half_width": 0.3, "wind_force": 900.0}
ESTIMATE: dict[str, Any] = {"estimator": "exact-kf", "outputs": ["beta"]}
RANDOM: dict[str, Any] = {"phase": None, "loss": 0.2}


def native(name: str, count: int, wish: Any = None, **arguments: Any) -> _NativeVecEnv:
    env = make_vec_env(name, count, estimator=wish, env_kwargs=arguments, scaled=False).venv
    assert isinstance(env, _NativeVecEnv)
    return env


def dummy(name: str, count: int, wish: Any = None, **arguments: Any) -> DummyVecEnv:
    def make() -> gym.Env[Any, Any]:
        env = gym.make(name, **arguments)
        return env if wish is None else EstimateObservation(env, **wish)

    return DummyVecEnv([make] * count)


def drawn(env: Any, step: int) -> Any:
    shape = (env.num_envs, *env.action_space.shape)
    return np.random.default_rng(step).uniform(-1.2, 1.2, shape).astype(np.float32)


@pytest.mark.parametrize("scenario", [SHORT, NARROW], ids=["truncated", "terminated"])
@pytest.mark.parametrize("wish", [None, ESTIMATE], ids=["raw", "estimator"])
@pytest.mark.parametrize("name", [VISION, FUSION])
def test_it_has_the_bits_of_the_single_environments(name: str, wish: Any, scenario: Any) -> None:
    """Observations, rewards, ends, the infos where episodes end and those of resets."""
    told = {"scenario": scenario, "camera": RANDOM, "on_bad_action": "fail"}
    ours, theirs = native(name, 3, wish, **told), dummy(name, 3, wish, **told)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.seed(40) == theirs.seed(40) == [40, 41, 42]
    assert bits(ours.reset()) == bits(theirs.reset())
    causes = set()
    for step in range(400):
        actions = drawn(ours, step)
        actions[step % 3, 0] = np.nan if step % 97 == 0 else 0.9
        one, other = ours.step(actions), theirs.step(actions)
        assert [bits(each) for each in one[:3]] == [bits(each) for each in other[:3]]
        for i, done in enumerate(one[2]):
            if not done:
                assert one[3][i] == {}
                continue
            assert bits(one[3][i]) == bits(other[3][i])
            causes.add(one[3][i]["TimeLimit.truncated"])
            known = {key: theirs.reset_infos[i][key] for key in ours.reset_infos[i]}
            assert bits(ours.reset_infos[i]) == bits(known)
    assert causes == ({True, False} if scenario is SHORT else {False})
    assert bits(ours.reset()) == bits(theirs.reset())  # generators go on


def test_seeds_and_options_serve_one_reset_each_row_its_own() -> None:
    ours, theirs = native(FUSION, 3), dummy(FUSION, 3)
    options: list[dict[str, Any]] = [{}, {"friction": 0.5, "duration": 0.1}, {"duration": 0.5}]
    for env in (ours, theirs):
        env.seed(5)
        env.set_options(options)
    for _ in range(2):
        assert bits(ours.reset()) == bits(theirs.reset())
        for name in ("vehicle", "scenario", "nominal"):
            assert ours.get_attr(name) == theirs.get_attr(name)
    for env in (ours, theirs):
        env.set_options({"scenario": "slalom"})
        env.reset()
    assert ours.get_attr("scenario") == theirs.get_attr("scenario") == [SCENARIOS["slalom"]] * 3


def test_a_row_tells_what_a_single_environment_tells() -> None:
    told: dict[str, Any] = {"camera": RANDOM, "vehicle": "coms", "nominal": "passenger-car"}
    ours, theirs = native(FUSION, 3, ESTIMATE, **told), dummy(FUSION, 3, ESTIMATE, **told)
    for env in (ours, theirs):
        env.seed(5)
        env.reset()
        env.step(drawn(env, 0))
    same = "vehicle nominal scenario held_speed slow_sensors motion np_random_seed layout reference"
    for name in f"{same} control_period dt render_mode observation_space action_space".split():
        assert ours.get_attr(name) == theirs.get_attr(name), name
    for one, other in zip(ours.get_attr("estimator"), theirs.get_attr("estimator"), strict=True):
        assert bits(one.x) == bits(other.x) and bits(one.P) == bits(other.P)
    for one, other in zip(ours.get_attr("record"), theirs.get_attr("record"), strict=True):
        assert bits(one.fast) == bits(other.fast) and bits(one.packets) == bits(other.packets)
    assert ours.get_attr("vehicle", 1) == [theirs.get_attr("vehicle")[1]]
    assert ours.get_attr("vehicle", [2, 0]) == theirs.get_attr("vehicle", [2, 0])
    assert ours.has_attr("layout") and not ours.has_attr("envs")
    with pytest.raises(AttributeError, match=r"a row of a vector env has vehicle.*not 'speed'"):
        ours.get_attr("speed")


def test_nothing_is_set_or_called_from_outside() -> None:
    env = native(VISION, 3)
    with pytest.raises(AttributeError, match=r"'vehicle' is not set from outside.*set_options"):
        env.set_attr("vehicle", None)
    with pytest.raises(AttributeError, match="has no method 'reset'"):
        env.env_method("reset")


def test_vector_wrappers_are_known_by_their_class() -> None:
    plain, wearing = native(VISION, 2), native(VISION, 2, ESTIMATE)
    assert wearing.env_is_wrapped(VectorEstimate) == [True, True]  # type: ignore[arg-type]
    assert wearing.env_is_wrapped(VectorTruth, indices=1) == [False]  # type: ignore[arg-type]
    assert plain.env_is_wrapped(VectorEstimate) == [False, False]  # type: ignore[arg-type]
    assert plain.env_is_wrapped(Monitor) == [False, False]


def test_monitor_and_normalisation_work_on_it() -> None:
    """The same sums and statistics as around the single environments."""
    ours: Any = make_vec_env(VISION, 3, seed=3, env_kwargs={"scenario": SHORT}, scaled=False)
    theirs: Any = DummyVecEnv([lambda: Monitor(gym.make(VISION, scenario=SHORT))] * 3)
    theirs.seed(3)
    one: Any = VecNormalize(VecCheckNan(ours, True))
    other: Any = VecNormalize(theirs)
    assert bits(one.reset()) == bits(other.reset())
    for step in range(60):
        ours_, theirs_ = one.step(drawn(one, step)), other.step(drawn(one, step))
        assert [bits(each) for each in ours_[:3]] == [bits(each) for each in theirs_[:3]]
        for i in np.flatnonzero(ours_[2]):
            info, wanted = ours_[3][i], theirs_[3][i]
            assert bits(info["terminal_observation"]) == bits(wanted["terminal_observation"])
            assert info["episode"]["l"] == wanted["episode"]["l"] == 25
            assert info["episode"]["r"] == pytest.approx(wanted["episode"]["r"], abs=1e-6)
    assert bits(one.obs_rms.mean) == bits(other.obs_rms.mean)


def test_the_monitors_file_keeps_words_of_the_last_info(tmp_path: Path) -> None:
    path, words = tmp_path / "monitor.csv", ("cost", "is_success", "beta_hat")
    env = make_vec_env(VISION, 2, 0, ESTIMATE, {"scenario": SHORT}, str(path), words)
    env.reset()
    for step in range(25):
        env.step(drawn(env, step))
    env.close()
    lines = path.read_text().splitlines()
    assert lines[1] == "r,l,t,cost,is_success,beta_hat" and len(lines) == 4
    assert lines[2].split(",")[4] == "True"


@pytest.mark.parametrize("name", ["sideslip/YawVision-v1", "sideslip/AfsYawFusion-v1"])
def test_what_learners_see_is_of_order_one_and_the_cost_is_the_envs(name: str) -> None:
    """Observations in every unit and rewards per second; the monitor has the plain sums."""
    scenario = {"base": "random-steering", "duration": 2.0}
    options: Any = {"estimator": "exact-kf", "env_kwargs": {"scenario": scenario}}
    ours: Any = make_vec_env(name, 32, 3, **options)
    plain: Any = make_vec_env(name, 32, 3, **options, scaled=False)
    scales = get_scales(get_env_facts(plain).layout)
    seen, paid = [ours.reset()], []
    assert bits(seen[0]) == bits(plain.reset() / scales)
    for step in range(200):
        (obs, rewards, dones, infos), other = (env.step(drawn(ours, step)) for env in (ours, plain))
        assert bits(obs) == bits(other[0] / scales) and obs[0] in ours.observation_space
        np.testing.assert_allclose(rewards, 100.0 * other[1], rtol=1e-6)
        seen.append(obs)
        paid.append(rewards)
    assert dones.all()
    for info, wanted in zip(infos, other[3], strict=True):
        assert info["episode"]["r"] == wanted["episode"]["r"] and info["cost"] == wanted["cost"]
        assert bits(info["terminal_observation"]) == bits(wanted["terminal_observation"] / scales)
    settled = np.array(seen[50:-1])  # until then a sensor has said nothing
    assert np.abs(settled).max() < 40.0 and 0.1 < settled.std(axis=(0, 1)).max() < 10.0
    assert -5.0 < np.mean(paid) < -0.2


@pytest.mark.parametrize("agent", ["none", "lqr"])
def test_a_controller_is_evaluated_like_a_network(agent: str) -> None:
    """The returns of each row's first episodes are those of the single environments."""
    wish = {"estimator": "exact-kf", "outputs": ["beta", "gamma", "F_d", "N_d"], "std": False}
    rewards = []
    for env in (
        make_vec_env(VISION, 2, 3, wish, {"scenario": SHORT}, scaled=False),
        dummy(VISION, 2, wish, scenario=SHORT),
    ):
        env.seed(3)
        model: Any = make_agent(agent, env)
        told = evaluate_policy(model, env, 6, return_episode_rewards=True, warn=False)
        assert told[1] == [25] * 6
        rewards.append(sorted(told[0]))
    assert rewards[0] == pytest.approx(rewards[1], rel=1e-5)


def test_ppo_learns_on_it_and_is_evaluated() -> None:
    env = make_vec_env(VISION, 8, 0, env_kwargs={"scenario": SHORT})
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(512)
    assert model.num_timesteps == 512 and len(model.ep_info_buffer or ()) == 16
    returns, lengths = evaluate_policy(model, env, 8, return_episode_rewards=True)
    assert lengths == [25] * 8 and np.max(returns) < 0.0


@pytest.mark.parametrize("wish", [None, "exact-kf"])
def test_bad_actions_step_nothing(wish: Any) -> None:
    env, twin = native(VISION, 3, wish and ESTIMATE), native(VISION, 3, wish and ESTIMATE)
    for each in (env, twin):
        each.seed(0)
        each.reset()
    before = env.get_attr("motion")
    bad = np.zeros((3, 1), np.float32)
    bad[1] = np.nan
    for actions, said in (
        (np.zeros((2, 1)), r"shape \(3, 1\), got 2 rows; nothing was stepped"),
        (np.zeros((3, 2)), r"got in rows 0, 1, 2 \(3 of them\) shape \(2,\); nothing was stepped"),
        (bad, r"row 1 is not finite.*; nothing was stepped"),
    ):
        with pytest.raises(ValueError, match=said):
            env.step(actions)
        assert env.get_attr("motion") == before
    assert bits(env.step(drawn(env, 0))[0]) == bits(twin.step(drawn(env, 0))[0])


def test_what_cannot_be_bridged_says_why() -> None:
    with pytest.raises(ValueError, match="num_envs is at least 1, got 0"):
        make_vec_env(VISION, 0)
    with pytest.raises(ValueError, match="has no native vector env"):
        make_vec_env("Pendulum-v1", 2)
    with pytest.raises(ValueError, match=r"autoreset_mode='SameStep', not .*NEXT_STEP"):
        _NativeVecEnv(StabilityVectorEnv(2))
    with pytest.raises(gym.error.NameNotFound):
        make_vec_env("sideslip/Yaw-v0", 2)
    with pytest.raises(ValueError, match="dakf needs the slow sensor gps"):
        make_vec_env(VISION, 2, estimator="dakf")


def within(wrapper: Any) -> Any:
    """A bridged vector env with a wrapper of Gymnasium's inside of the bridge."""
    return make_vec_env(VISION, 2, 0, wrapper_class=wrapper, scaled=False)


def test_a_controller_is_not_designed_on_changed_observations(tmp_path: Path) -> None:
    env = make_vec_env(VISION, 2, 0, scaled=False)
    single = DummyVecEnv([lambda: Monitor(gym.make(VISION))])
    rated = RewardScaleWrapper(env, RewardScale([[1.0, 1.0]]))
    filmed = make_vec_env(VISION, 2, 0, env_kwargs={"render_mode": "rgb_array"}, scaled=False)
    film = VecVideoRecorder(filmed, str(tmp_path), lambda _: False)
    rewards = VecNormalize(env, norm_obs=False)
    for same in (env, single, rated, film, rewards, VecCheckNan(env), VecMonitor(env)):
        assert make_agent("none", same).nominal == env.get_attr("nominal")[0]
    assert make_agent("none", within(vector.NormalizeReward)).control_period == 10
    changed: Any = VecNormalize(env), VecFrameStack(env, 2), within(vector.ClipAction)
    changed += (DummyVecEnv([lambda: wrappers.NormalizeObservation(gym.make(VISION))]),)
    changed += (make_vec_env(VISION, 2, 0),)
    names = "VecNormalize", "VecFrameStack", "ClipAction", "NormalizeObservation", "ScaledVecEnv"
    for name, each in zip(names, changed, strict=True):
        with pytest.raises(ValueError, match=f"^{name} may change observations or actions"):
            make_agent("none", each)


def test_a_wrapper_that_adds_entries_has_its_own_scales() -> None:
    """Of an angle 0.05 rad is one, in the wrapper's entries as in the env's."""
    wrapper = VectorTruth
    plain: Any = make_vec_env(VISION, 2, 0, wrapper_class=wrapper, scaled=False)
    scaled: Any = make_vec_env(VISION, 2, 0, wrapper_class=wrapper)
    bare: Any = make_vec_env(VISION, 2, 0)
    names = [entry.name for entry in plain.get_attr("layout")[0]]
    raw, divided = plain.reset(), scaled.reset()
    assert raw.shape[1] > bare.observation_space.shape[0]
    for name, scale in (("steer", 0.05), ("true_front_stiffness", 1.0)):
        column = names.index(name)
        assert divided[:, column] == pytest.approx(raw[:, column] / scale, rel=1e-6), name


def test_each_row_has_its_own_config() -> None:
    env = make_vec_env(VISION, 2, env_kwargs={"scenario": ["straight", "slalom"]})
    assert [config.scenario.name for config in env.get_attr("config")] == ["straight", "slalom"]
