"""What an env-step costs: ours with full sensors, single and in batches, beside others'.

Ours is 10 ms of driving, ten ticks of plant and sensors, infos included. Singles are of `gym.make`,
reset after at most 500 steps; batches run on, and reset their rows themselves.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from ...estimators.filters import FILTERS
from ...estimators.learned.files import shipped
from ...estimators.make import make_estimator
from ...estimators.vector.estimate import EstimateObservation as EstimateObservations
from ...estimators.wrappers.estimate import EstimateObservation
from ..harness.results import Suite, Table
from .contestants import Field, add_row, three
from .timing import Contestant, Effort, Taken, interleaved

COUNT, FEWER = 1024, 256  # environments at once, alone and with each filter
EPISODE, CHUNK = 500, 50  # steps, the most; in one call
STEPS, FRAMES = 10, 33  # of a batch, in one call; until camera frames fall on steps as before

FUSION_ID, VISION_ID = "sideslip/YawFusion-v0", "sideslip/YawVision-v0"
FUSION, VISION = "YawFusion-v0", "YawVision-v0"
PROMPT: dict[str, Any] = {"camera": {"delays": [0.0]}}
FILTER: dict[str, Any] = {"estimator": "exact-kf", "options": {"gains": "covariance"}}
AT_ONCE = f"{FUSION} x {COUNT}"
FILTERED = f"{AT_ONCE} + exact-kf, full P"
LATE, NONE_LATE = f"{VISION} x {COUNT}", f"{VISION} x {COUNT}, no delay"
CARTPOLE, LANE = "CartPole-v1", "lane-keeping-v0 (highway-env)"
CARTPOLES, PENDULUMS = f"{CARTPOLE} x {COUNT}", f"Pendulum-v1 x {COUNT}"
ENVPOOL = f"{PENDULUMS} (EnvPool)"

Policy = Callable[[Any], Any]


def upright(obs: Any) -> Any:
    """Keeps a cart's pole up, so that its episodes are long."""
    return (obs[..., 2] + 0.3 * obs[..., 3] > 0.0).astype(int)


def episode(env: gym.Env[Any, Any], policy: Policy | None = None) -> Contestant:
    """`CHUNK` steps a call of an episode of at most `EPISODE`, always the same one.

    policy: what acts (None: action 0, or the one that does nothing); it runs once, its actions are
    replayed.
    """
    idle = env.action_space.sample() * 0
    obs, _ = env.reset(seed=0)
    actions, over = list[Any](), False
    while not over and len(actions) < EPISODE:
        actions.append(idle if policy is None else int(policy(obs)))
        obs, _, terminated, truncated, _ = env.step(actions[-1])
        over = terminated or truncated

    chunk = min(CHUNK, len(actions))
    end = at = len(actions) // chunk * chunk

    def work() -> None:
        nonlocal at
        if at == end:
            env.reset(seed=0)
            at = 0
        for action in actions[at : at + chunk]:
            env.step(action)
        at += chunk

    return Contestant(work, chunk)


def batch(env: Any, steps: int = STEPS) -> Contestant:
    """Steps of a batch in which nothing is done."""
    env.reset(seed=0)
    idle = np.zeros(env.action_space.shape, env.action_space.dtype)

    def work() -> None:
        for _ in range(steps):
            env.step(idle)

    return Contestant(work, steps * env.num_envs)


def _cartpoles() -> Contestant:
    """Gymnasium's own batch of carts, each call from a reset on, with poles kept up."""
    env: Any = gym.make_vec(CARTPOLE, COUNT, vectorization_mode="vector_entry_point")
    obs, _ = env.reset(seed=0)
    actions = []
    for _ in range(EPISODE // 5):
        actions.append(upright(obs))
        obs, *_ = env.step(actions[-1])

    def work() -> None:
        env.reset(seed=0)
        for action in actions:
            env.step(action)

    return Contestant(work, len(actions) * COUNT)


def _pendulums() -> Contestant:
    """Gymnasium's own batch; Pendulum has none of arrays."""
    return batch(gym.make_vec("Pendulum-v1", COUNT, vectorization_mode="sync"), 1)


def _envpool() -> Contestant:
    import envpool

    env: Any = envpool.make("Pendulum-v1", env_type="gymnasium", num_envs=COUNT, num_threads=1)
    env.reset()
    idle = np.zeros((COUNT, 1), np.float32)

    def work() -> None:
        for _ in range(STEPS):
            env.step(idle)

    return Contestant(work, STEPS * COUNT)


def _lane_keeping() -> Contestant:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return episode(gym.make("highway_env:lane-keeping-v0"))


def _vector(env_id: str, **arguments: Any) -> Any:
    return gym.make_vec(env_id, COUNT, **arguments)


def contestants() -> Field:
    """All environments; those of packages that are not installed are absent."""
    field = Field()
    field.add(FUSION, lambda: episode(gym.make(FUSION_ID)))
    field.add(AT_ONCE, lambda: batch(_vector(FUSION_ID)))
    field.add(FILTERED, lambda: batch(EstimateObservations(_vector(FUSION_ID), **FILTER)))
    field.add(LATE, lambda: batch(_vector(VISION_ID), FRAMES))
    field.add(NONE_LATE, lambda: batch(_vector(VISION_ID, **PROMPT), FRAMES))
    field.add(CARTPOLE, lambda: episode(gym.make(CARTPOLE), upright))
    field.add(LANE, _lane_keeping, "highway-env")
    field.add(CARTPOLES, _cartpoles)
    field.add(PENDULUMS, _pendulums)
    field.add(ENVPOOL, _envpool, "envpool")
    return field


def add(suite: Suite, effort: Effort) -> tuple[dict[str, Taken], dict[str, str]]:
    """Rows and a table; what each contestant took, and why others are absent."""
    note = (
        "Ours: 10 ms of driving, ten ticks of plant and sensors, with infos. Singles through "
        f"gym.make, in episodes of at most {EPISODE} steps; x {COUNT}: a step of one environment "
        "of a batch. Filters with full P compute the covariance of six states at every tick; a "
        "filter's own cost is the difference to the line without."
    )
    return contestants().measure(suite, "Cost of an env-step", "step", effort, note)


def add_filters(suite: Suite, effort: Effort) -> None:
    """Add rows and a table of what each filter adds to a step, in a third of the rounds each."""
    envs = {"one": episode(gym.make(FUSION_ID)), "many": batch(gym.make_vec(FUSION_ID, FEWER))}
    header = ("", "one", "range", f"of {FEWER}", "range")
    fewer, cells = replace(effort, rounds=max(1, effort.rounds // 3)), []
    for name in (*FILTERS, *(f"learned-{base}" for base in shipped())):
        taken = interleaved(envs | _filtered(name), fewer)
        bare, bare_many, one, many = (np.array(values) for values in taken.values())
        cells.append([name])
        for env, added in ((FUSION, one - bare), (f"{FUSION} x {FEWER}", many - bare_many)):
            middle, *ends = add_row(suite, f"{env} + {name}", "us_added", added.tolist())
            cells[-1] += three(middle), " .. ".join(map(three, ends))
    note = (
        f"CPU us that a filter adds to an env-step of {FUSION}, its first two states and their "
        "deviations in the observation: differences round by round."
    )
    suite.tables.append(Table("Cost of a filter", header, cells, note, keyed=False))


def _filtered(name: str) -> dict[str, Contestant]:
    """One environment and a batch with a filter."""
    env, many = gym.make(FUSION_ID), gym.make_vec(FUSION_ID, FEWER)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it cannot see
        outputs = make_estimator(name, sensors=env.get_wrapper_attr("slow_sensors")).names[:2]
        return {
            "one filtered": episode(EstimateObservation(env, name, outputs)),
            "many filtered": batch(EstimateObservations(many, name, outputs)),
        }
