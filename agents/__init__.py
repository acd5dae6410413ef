"""Everything that acts, with stable-baselines3's `predict`: controllers and learned policies."""

from collections.abc import Callable
from typing import Any

from .controllers.base import Controller, NoControl
from .controllers.esc import Esc
from .controllers.informed import Informed
from .controllers.lane_keeping import LaneKeeping
from .controllers.lqr import Lqr
from .controllers.model_following import ModelFollowing
from .controllers.mpc import Mpc
from .controllers.sliding_mode import SlidingMode
from .controllers.two_dof import Feedforward, TwoDof
from .env_facts import AnyEnv
from .learned.files import is_policy
from .learned.policy import Learned

AGENTS: dict[str, Callable[..., Controller]] = {
    "none": NoControl,
    "feedforward": Feedforward,
    "two-dof": TwoDof,
    "model-following": ModelFollowing,
    "esc": Esc,
    "sliding-mode": SlidingMode,
    "lqr": Lqr,
    "mpc": Mpc,
    "lane-keeping": LaneKeeping,
    "informed": Informed,
    "learned": Learned,
}

__all__ = [
    "AGENTS",
    "Controller",
    "Esc",
    "Feedforward",
    "Informed",
    "LaneKeeping",
    "Learned",
    "Lqr",
    "ModelFollowing",
    "Mpc",
    "NoControl",
    "SlidingMode",
    "TwoDof",
    "make_agent",
]


def make_agent(name: str, env: AnyEnv, **options: Any) -> Controller:
    """A controller designed for an env, single or vector, from the env's nominal vehicle.

    name: a key of `AGENTS`, a shipped policy, or the path of one (`.../NAME.safetensors`).
    options: arguments of that controller.
    Raises ValueError for an unknown name or an observation without what the controller needs,
    TypeError for an unknown option.
    """
    if name not in AGENTS and is_policy(name):
        return Learned(env, policy=name, **options)
    if name not in AGENTS:
        raise ValueError(f"unknown agent {name!r}; known: {', '.join(AGENTS)}")
    return AGENTS[name](env, **options)
