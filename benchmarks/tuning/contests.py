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
from ...estimators.vector.estimate import EstimateObservation
from ..control.contests import candidates
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


def contests_of(kind: str) -> tuple[Contest, ...]:
    """The contests of a class; ValueError for another name."""
    check_choice("class", kind, KINDS)
    return tuple(
        Contest(each.env_id, each.env_options, each.scenario)
        for each in candidates()
        if each.kind == kind
    )
