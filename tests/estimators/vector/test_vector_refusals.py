"""What the vector EstimateObservation refuses, and what it says then."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.error import ResetNeeded
from gymnasium.vector import SyncVectorEnv

from sideslip.estimators.vector.estimate import EstimateObservation
from tests.estimators.vector.fleets import BAD, VISION, fleet

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")


def test_a_native_env_refuses_all_rows_and_the_estimators_go_on() -> None:
    native = gym.make_vec(VISION, num_envs=2), gym.make_vec(VISION, num_envs=2)
    env, twin = (EstimateObservation(each, "multirate-kf") for each in native)
    for each in (env, twin):
        each.reset(seed=0)
    still = np.zeros((2, 1), np.float32)
    for bad in (np.array([[0.0], [BAD]], np.float32), still[:1]):
        with pytest.raises(ValueError, match="nothing was stepped"):
            env.step(bad)
        assert env.step(still)[0].tobytes() == twin.step(still)[0].tobytes()


def test_a_failed_step_or_none_asks_for_a_reset() -> None:
    """Some rows were stepped, others not: no estimator may go on as if nothing had happened."""
    env: Any = EstimateObservation(
        fleet(VISION, 2, "NextStep", on_bad_action="raise"), "multirate-kf"
    )
    still = np.zeros((2, 1), np.float32)
    with pytest.raises(ResetNeeded, match="before the first step"):
        env.step(still)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="not finite"):
        env.step(np.array([[0.0], [BAD]], np.float32))
    with pytest.raises(ResetNeeded, match="after one that failed"):
        env.step(still)
    with pytest.raises(ResetNeeded, match="reset all rows"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    env.step(still)


def test_it_is_the_innermost_wrapper_or_an_error() -> None:
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(fleet(VISION, 2, "NextStep"))
    with pytest.raises(TypeError, match=r"innermost wrapper.*RecordEpisodeStatistics"):
        EstimateObservation(wrapped, "multirate-kf")
    clipped = fleet(VISION, 2, "NextStep", gym.wrappers.ClipAction)
    with pytest.raises(TypeError, match=r"innermost wrapper.*ClipAction"):
        EstimateObservation(clipped, "multirate-kf")
    with pytest.raises(TypeError, match="CartPoleEnv has no rows"):
        EstimateObservation(SyncVectorEnv([CartPoleEnv]), "multirate-kf")
    with pytest.raises(TypeError, match="CartPoleVectorEnv has no rows"):
        EstimateObservation(gym.make_vec("CartPole-v1", num_envs=2), "multirate-kf")
    single: Any = gym.make(VISION)
    with pytest.raises(TypeError, match=r"no vector env.*sideslip\.estimators\.EstimateObs"):
        EstimateObservation(single, "multirate-kf")


def test_worker_processes_are_out_of_reach() -> None:
    env = gym.make_vec("sideslip:" + VISION, num_envs=1, vectorization_mode="async")
    try:
        with pytest.raises(TypeError, match=r"AsyncVectorEnv.*wrappers=\[functools\.partial"):
            EstimateObservation(env, "multirate-kf")
    finally:
        env.close()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"estimator": "dakf"}, ValueError, "dakf needs the slow sensor gps; there is: camera"),
        ({"estimator": "bicycle-kf", "outputs": ["psi"]}, ValueError, "no state 'psi'"),
        ({"estimator": "multirate-kf", "options": {"q": 1}}, TypeError, "unknown option 'q'"),
    ],
)
def test_wrong_arguments(options: Any, error: Any, message: Any) -> None:
    with pytest.raises(error, match=message):
        EstimateObservation(fleet(VISION, 2, "NextStep"), **options)


def test_no_autoreset_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must reset rows itself.*DISABLED"):
        EstimateObservation(fleet(VISION, 2, "Disabled"), "multirate-kf")
