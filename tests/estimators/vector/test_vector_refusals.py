"""What the vector EstimateObservation and batches refuse, and what they say then."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.error import ResetNeeded
from gymnasium.vector import SyncVectorEnv

from sideslip.estimators import make_estimator
from sideslip.estimators.vector.estimate import EstimateObservation
from tests.envs.batches import actions
from tests.estimators.simulation import CAMERA, GPS
from tests.estimators.vector.fleets import BAD, VISION, fleet, make_batch, native
from tests.estimators.wrappers.constant import Constant

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
STILL = np.zeros((2, 1), np.float32)
FIG7: Any = {"scenario": "tie-vision-fig7"}


FLEET = functools.partial(fleet, VISION, 2, "NextStep")


def wrap(env: Any = None, estimator: Any = "multirate-kf", **options: Any) -> Any:
    return EstimateObservation(FLEET() if env is None else env, estimator, **options)


def reset(estimator: Any, told: Any = None, **arguments: Any) -> Any:
    return wrap(native("NextStep"), estimator, **arguments).reset(seed=0, options=told)


def batch(**changes: Any) -> Any:
    told: dict[str, Any] = {"count": 2, "sensors": {"camera": CAMERA}} | changes
    return make_batch("multirate-kf", **told)


def changing(speed: float | None, **_: Any) -> Constant:
    own = Constant()
    own.names = ("mu", "gamma", "beta") if speed is None else ("mu", "gamma", "psi")
    return own


def wavering(speed: float | None, **more: Any) -> Any:
    return make_estimator("exact-kf", speed=speed, **more) if speed is None else Constant()


STATISTICS = gym.wrappers.vector.RecordEpisodeStatistics
REFUSALS: dict[type[Exception], dict[str, Callable[[], Any]]] = {
    TypeError: {
        r"innermost wrapper.*RecordEpisodeStatistics": lambda: wrap(STATISTICS(FLEET())),
        r"innermost wrapper.*ClipAction": lambda: wrap(FLEET(gym.wrappers.ClipAction)),
        "CartPoleEnv has no rows": lambda: wrap(SyncVectorEnv([CartPoleEnv])),
        "CartPoleVectorEnv has no rows": lambda: wrap(gym.make_vec("CartPole-v1", num_envs=2)),
        r"no vector env.*sideslip\.estimators\.EstimateObs": lambda: wrap(gym.make(VISION)),
        "Constant cannot estimate 3 rows: pass": lambda: wrap(native("NextStep"), Constant()),
        "of filters of ours or of none": lambda: reset(wavering, FIG7),
        "SyncVectorEnv makes no snapshots; the vector env that": lambda: wrap().get_state(),
    },
    ValueError: {
        r"must reset rows itself.*DISABLED": lambda: wrap(fleet(VISION, 2, "Disabled")),
        r"x has shape \(3,\)": lambda: reset(Constant, options={"value": (1.0, 2.0)}),
        "filters of a batch have the same states, row 0 has": lambda: reset(changing, FIG7),
        "needs the slow sensor camera": lambda: batch(sensors={"gps": GPS}, slow="camera"),
        "same states, row 0 .*row 1": lambda: batch(sensors=[{"camera": CAMERA}, {"gps": GPS}]),
    },
}


@pytest.mark.parametrize(
    ("error", "message"), [(error, message) for error in REFUSALS for message in REFUSALS[error]]
)
def test_what_is_wrong_is_refused_and_said(error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        REFUSALS[error][message]()


def test_worker_processes_are_out_of_reach() -> None:
    env = gym.make_vec("sideslip:" + VISION, num_envs=1, vectorization_mode="async")
    try:
        with pytest.raises(TypeError, match=r"AsyncVectorEnv.*wrappers=\[functools\.partial"):
            EstimateObservation(env, "multirate-kf")
    finally:
        env.close()


def test_a_native_env_refuses_all_rows_and_the_estimators_go_on() -> None:
    env, twin = (wrap(gym.make_vec(VISION, num_envs=2)) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=0)
    for bad in (np.array([[0.0], [BAD]], np.float32), STILL[:1]):
        with pytest.raises(ValueError, match="nothing was stepped"):
            env.step(bad)
        assert env.step(STILL)[0].tobytes() == twin.step(STILL)[0].tobytes()


def test_a_failed_step_or_none_asks_for_a_reset() -> None:
    """Some rows were stepped, others not: no estimator may go on as if nothing had happened."""
    env = wrap(fleet(VISION, 2, "NextStep", on_bad_action="raise"))
    with pytest.raises(ResetNeeded, match="before the first step"):
        env.step(STILL)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="not finite"):
        env.step(np.array([[0.0], [BAD]], np.float32))
    with pytest.raises(ResetNeeded, match="after one that failed"):
        env.step(STILL)
    with pytest.raises(ResetNeeded, match="reset all rows"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    env.step(STILL)


def test_an_estimator_that_raises_asks_for_a_reset() -> None:
    """Some rows took the step, others did not."""
    env = wrap(native("NextStep", 2), Constant)
    env.reset(seed=0)
    env.estimator[1].inner.value = "lost"
    with pytest.raises(TypeError, match="x is no array of numbers"):
        env.step(STILL)
    with pytest.raises(ResetNeeded, match="after one that failed"):
        env.step(STILL)


def test_a_snapshot_that_does_not_fit_or_is_of_no_episode() -> None:
    env = wrap(native("NextStep"), "bicycle-kf")
    snapshot = env.get_state()  # before the first reset
    env.reset(seed=0)
    env.set_state(snapshot)
    with pytest.raises(ResetNeeded):
        env.step(actions(env, 0))
    with pytest.raises(ValueError, match="the snapshot has 3 rows"):
        wrap(native("NextStep", 2), "bicycle-kf").set_state(snapshot)
