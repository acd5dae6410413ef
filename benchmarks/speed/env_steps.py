"""CPU time of an env-step, driven or learned: ours with full sensors, beside other packages'.

Ours is 10 ms of driving: ten ticks of plant and sensors, infos included. Single ones are reset
after at most 500 steps; batches run on, and reset their rows themselves. Learning is a rollout of
PPO and the gradient steps on it, with the same settings for both environments.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.numerics.functions import TICK
from ...envs.record import Array
from ...estimators.filters import FILTERS
from ...estimators.make import make_estimator
from ...estimators.vector.estimate import EstimateObservation as EstimateObservations
from ...estimators.wrappers.estimate import EstimateObservation
from .timing import Effort, TimeTable, Workload, measure_interleaved

COUNT, FEWER = 1024, 256  # environments at once, alone and with each filter
EPISODE, _CHUNK = 500, 50  # steps, the most; in one call
_STEPS, _FRAMES = 10, 33  # of a batch, in one call; until camera frames fall on steps as before

_FUSION_ID, _VISION_ID = "sideslip/YawFusion-v0", "sideslip/YawVision-v0"
FUSION, VISION = "YawFusion-v0", "YawVision-v0"
FUSION_V1 = "YawFusion-v1"  # with cars and sensors that err
_PROMPT: dict[str, Any] = {"camera": {"delays": [0.0]}}
_FILTER: dict[str, Any] = {"estimator": "exact-kf", "options": {"gains": "covariance"}}
AT_ONCE, V1_AT_ONCE = f"{FUSION} x {COUNT}", f"{FUSION_V1} x {COUNT}"
FILTERED = f"{AT_ONCE} + exact-kf, full P"
LATE, NONE_LATE = f"{VISION} x {COUNT}", f"{VISION} x {COUNT}, no delay"
CARTPOLE, LANE = "CartPole-v1", "lane-keeping-v0 (highway-env)"
CARTPOLES, PENDULUMS = f"{CARTPOLE} x {COUNT}", f"Pendulum-v1 x {COUNT}"


def _choose_upright_action(obs: Array) -> npt.NDArray[np.int_]:
    """Choose the action that keeps a cart's pole up, so that episodes are long."""
    return (obs[..., 2] + 0.3 * obs[..., 3] > 0.0).astype(int)


def _make_episode(
    env: Any, policy: Callable[[Array], Any] | None = None, max_steps: int = 0
) -> Workload:
    """Make calls of `_CHUNK` steps of one episode, in which a policy acts, or nothing is done."""
    idle = env.action_space.sample() * 0
    obs, _ = env.reset(seed=0)
    actions, over = list[object](), False
    while not over and len(actions) < (max_steps or EPISODE):
        action = idle if policy is None else policy(obs)
        actions.append(action if np.ndim(action) else int(action))  # Discrete takes an int
        obs, _, terminated, truncated, _ = env.step(actions[-1])
        over = bool(np.all(terminated | truncated))

    chunk = min(_CHUNK, len(actions))
    end = position = len(actions) // chunk * chunk

    def run_chunk() -> None:
        nonlocal position
        if position == end:
            env.reset(seed=0)
            position = 0
        for action in actions[position : position + chunk]:
            env.step(action)
        position += chunk

    return Workload(run_chunk, chunk * getattr(env, "num_envs", 1))


def _make_batch(env: Any, steps: int = _STEPS) -> Workload:
    """Make calls of some steps of a batch in which nothing is done."""
    env.reset(seed=0)
    idle = np.zeros(env.action_space.shape, env.action_space.dtype)

    def run_steps() -> None:
        for _ in range(steps):
            env.step(idle)

    return Workload(run_steps, steps * env.num_envs)


def _make_cartpoles() -> Workload:
    """Make calls of Gymnasium's own batch of carts, with poles kept up."""
    env = gym.make_vec(CARTPOLE, COUNT, vectorization_mode="vector_entry_point")
    return _make_episode(env, _choose_upright_action, EPISODE // 5)


def _make_lane_keeping() -> Workload:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import highway_env  # noqa: F401  registers it

        return _make_episode(gym.make("lane-keeping-v0"))


_WORKLOADS: dict[str, Callable[[], Workload]] = {
    FUSION: lambda: _make_episode(gym.make(_FUSION_ID)),
    AT_ONCE: lambda: _make_batch(gym.make_vec(_FUSION_ID, COUNT)),
    FUSION_V1: lambda: _make_episode(gym.make(f"sideslip/{FUSION_V1}")),
    V1_AT_ONCE: lambda: _make_batch(gym.make_vec(f"sideslip/{FUSION_V1}", COUNT)),
    FILTERED: lambda: _make_batch(EstimateObservations(gym.make_vec(_FUSION_ID, COUNT), **_FILTER)),
    LATE: lambda: _make_batch(gym.make_vec(_VISION_ID, COUNT), _FRAMES),
    NONE_LATE: lambda: _make_batch(gym.make_vec(_VISION_ID, COUNT, **_PROMPT), _FRAMES),
    CARTPOLE: lambda: _make_episode(gym.make(CARTPOLE), _choose_upright_action),
    LANE: _make_lane_keeping,
    CARTPOLES: _make_cartpoles,
    # Pendulum has no batch of arrays
    PENDULUMS: lambda: _make_batch(gym.make_vec("Pendulum-v1", COUNT, "sync"), 1),
}


def measure_steps(effort: Effort) -> TimeTable:
    """Measure steps, but those of packages that are not installed."""
    note = (
        "Ours: 10 ms of driving, ten ticks of plant and sensors, with infos. Singles through "
        f"gym.make, in episodes of at most {EPISODE} steps; x {COUNT}: a step of one environment "
        "of a batch. Filters with full P compute the covariance of six states at every tick; a "
        "filter's own cost is the difference to the line without."
    )
    table = TimeTable("Cost of an env-step", "us_per_step", "us per step", note)
    return table.measure(_WORKLOADS, effort)


def measure_filters(effort: Effort) -> TimeTable:
    """Measure the CPU time that each filter adds to a step."""
    note = (
        f"CPU us that a filter adds to an env-step of {FUSION}, its first two states and their "
        "deviations in the observation: differences round by round."
    )
    table = TimeTable("Cost of a filter", "us_added", "us added", note)
    bare_one, bare_batch = gym.make(_FUSION_ID), gym.make_vec(_FUSION_ID, FEWER)
    envs = {"one": _make_episode(bare_one), "many": _make_batch(bare_batch)}
    for name in FILTERS:
        taken = measure_interleaved(envs | _make_filtered(name), effort.quarter)
        table.times[f"{FUSION} + {name}"] = taken["one filtered"] - taken["one"]
        table.times[f"{FUSION} x {FEWER} + {name}"] = taken["many filtered"] - taken["many"]
    return table


def _make_filtered(name: str) -> dict[str, Workload]:
    """Make calls of one environment and of a batch with a filter."""
    env, many = gym.make(_FUSION_ID), gym.make_vec(_FUSION_ID, FEWER)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it cannot see
        outputs = make_estimator(name, sensors=env.get_wrapper_attr("slow_sensors")).names[:2]
        return {
            "one filtered": _make_episode(EstimateObservation(env, name, outputs)),
            "many filtered": _make_batch(EstimateObservations(many, name, outputs)),
        }


PPO_YAW, PENDULUM = "PPO, YawFusion-v0", "PPO, Pendulum-v1"
_LEARNERS = 256  # environments of a learner


def _make_learner(env_id: str) -> Workload:
    """Make calls of a rollout and its update, ours through the bridge."""
    from stable_baselines3 import PPO
    from stable_baselines3.common import env_util

    from ...agents import vec_env
    from ...agents.training.config import TrainingTask

    options = TrainingTask(_FUSION_ID, num_envs=_LEARNERS).make_model_options(10 * TICK)
    settings = {name: options[name] for name in ("n_steps", "n_epochs", "batch_size", "gamma")}
    make = vec_env.make_vec_env if env_id == _FUSION_ID else env_util.make_vec_env
    env = make(env_id, _LEARNERS, seed=0)
    model = PPO("MlpPolicy", env, seed=0, device="cpu", **settings)
    steps = _LEARNERS * model.n_steps
    return Workload(lambda: model.learn(steps, reset_num_timesteps=False), steps)


def measure_learners(effort: Effort) -> TimeTable:
    """Measure both learners, unless stable-baselines3 is not installed."""
    note = (
        f"PPO of stable-baselines3, rollout and gradient steps, on {_LEARNERS} environments each, "
        "YawFusion-v0 through the bridge; n_steps, n_epochs, batch_size and gamma are those of "
        "`sideslip train`, the rest is its default."
    )
    table = TimeTable("Cost of a learned env-step", "us_per_step", "us per step", note)
    ids = {PPO_YAW: _FUSION_ID, PENDULUM: "Pendulum-v1"}
    return table.measure({x: partial(_make_learner, ids[x]) for x in ids}, effort.quarter)
