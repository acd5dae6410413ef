"""The contests of a class, and a contestant's costs in one of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...agents import make_agent
from ...agents.rollout import steps_of
from ...agents.rungs import FILTER, OUTPUTS, RUNGS, levels_of, make_rung
from ...agents.tuned import Options
from ...envs.arguments import check_choice
from ...envs.scenarios.manoeuvres import SCENARIOS
from ...estimators.vector.estimate import EstimateObservation
from ..harness.drives import quietly
from .spaces import KINDS

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Contest:
    """A scenario in an environment with its car and reference."""

    env_id: str
    env_options: Mapping[str, Any] = field(hash=False)
    name: str = ""


def drive(
    contest: Contest, name: str, options: Options, seeds: Sequence[int]
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """(costs, whether it failed) of a contestant's episodes, (seeds,) each.

    options: over the defaults. Raises what the env, the filter and the controller raise.
    """
    env, agent = cars_of(contest, name, options, len(seeds))
    costs, failed = np.zeros(len(seeds)), np.zeros(len(seeds), np.bool_)
    for step in steps_of(env, agent, list(seeds)):
        costs -= np.where(step.running, step.reward, 0.0)
        failed |= step.running & (step.info["failure"] != 0)
    env.close()
    return costs, failed


def cars_of(contest: Contest, name: str, options: Options, count: int) -> tuple[Any, Any]:
    """(vector env of so many rows, agent): a rung, or an agent on `exact-kf` with all sensors."""
    kwargs: dict[str, Any] = {"on_bad_action": "fail", **contest.env_options}
    if name in RUNGS:
        return make_rung(name, contest.env_id, count, options=options, **kwargs)
    env: Any = gym.make_vec(contest.env_id, num_envs=count, **kwargs)
    base = env.unwrapped
    levels = levels_of(base.scenario[0]) | {"slow": list(base.slow_sensors[0])}
    settings = levels | options.get("filter", {})
    env = quietly(EstimateObservation, env, FILTER, outputs=OUTPUTS, std=False, options=settings)
    more: dict[str, Any] = {"rejection": False} if name == "model-following" else {}
    return env, make_agent(name, env, **more, **options.get("controller", {}))


FIRST_SEED = 2**29  # tests, calibration and tunings of filters have others


def tuning_seeds(n: int) -> list[int]:
    """The first n seeds that controllers are tuned on: no test's."""
    return list(range(FIRST_SEED, FIRST_SEED + n))


_DRIVEN: dict[str, tuple[str, str, str, tuple[str, ...]]] = {
    "coms-model": ("sideslip/AfsYawFusion-v0", "coms", "model", ("1",)),
    "coms-zero-slip": ("sideslip/YawFusion-v0", "coms", "zero-slip", ("1",)),
    "car-yaw": ("sideslip/YawFusion-v0", "passenger-car", "limited", ("2a", "2b", "2c")),
    "car-steering": ("sideslip/AfsYawFusion-v0", "passenger-car", "limited", ("2a", "2b", "2c")),
}


def contests_of(kind: str) -> tuple[Contest, ...]:
    """The contests of a class; ValueError for another name."""
    check_choice("class", kind, KINDS)
    env_id, car, reference, tiers = _DRIVEN[kind]
    common = {"vehicle": car, "nominal": car, "reference": reference}
    return tuple(
        Contest(env_id, {"scenario": name, **common}, name)
        for name, scenario in SCENARIOS.items()
        if scenario.tier in tiers
    )
