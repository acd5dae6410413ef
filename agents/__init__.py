"""Everything that acts, with stable-baselines3's `predict`: controllers and learned policies."""

from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol, overload

from ..envs.arguments import check_options
from ..estimators.registry import Registry
from .controllers.adaptive import AdaptiveLqr, AdaptiveNmpc
from .controllers.base import Controller, NoControl
from .controllers.esc import Esc
from .controllers.lane_keeping import LaneKeeping
from .controllers.lqr import Lqr
from .controllers.model_following import ModelFollowing
from .controllers.mpc import Mpc
from .controllers.nmpc import Nmpc
from .controllers.sliding_mode import SlidingMode
from .controllers.two_dof import Feedforward, TwoDof
from .env_facts import AnyEnv
from .learned.files import ZIP, is_policy, list_shipped
from .learned.policy import PolicyController

AGENTS = Registry(
    "agent",
    {
        "none": NoControl,
        "feedforward": Feedforward,
        "two-dof": TwoDof,
        "model-following": ModelFollowing,
        "esc": Esc,
        "sliding-mode": SlidingMode,
        "lqr": Lqr,
        "adaptive-lqr": AdaptiveLqr,
        "adaptive-nmpc": AdaptiveNmpc,
        "mpc": Mpc,
        "nmpc": Nmpc,
        "lane-keeping": LaneKeeping,
        "learned": PolicyController,
    },
)
"""Every agent that has a name, but for policies: the package's own and those registered."""

__all__ = [
    "AGENTS",
    "AdaptiveLqr",
    "AdaptiveNmpc",
    "Agent",
    "Controller",
    "Esc",
    "Feedforward",
    "LaneKeeping",
    "Lqr",
    "ModelFollowing",
    "Mpc",
    "Nmpc",
    "NoControl",
    "PolicyController",
    "SlidingMode",
    "TwoDof",
    "make_agent",
    "register_agent",
]


class Agent(Protocol):
    """What acts in an env: stable-baselines3's models, our controllers, or a user's own object."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """The action (width,) for an observation (k,), or (N, width) for (N, k); the next state.

        state: as returned by the last call, None at first; the agent's memory, if it has one.
        episode_start: (N,) of bool, the rows whose episode has just begun.
        """


@overload
def make_agent(name: str, env: AnyEnv, **options: Any) -> Controller: ...


@overload
def make_agent(name: Agent | Callable[..., Agent], env: AnyEnv, **options: Any) -> Agent: ...


def make_agent(
    name: str | Agent | Callable[..., Agent], env: AnyEnv, *, trust: bool = False, **options: Any
) -> Controller | Agent:
    """An agent for an env, single or vector; ours are designed from the env's nominal vehicle.

    name: of `AGENTS`, a shipped policy, the path of one (`.../NAME.safetensors`), a zip of
    stable-baselines3 trained on this env (`.../NAME.zip`), an entry point "package.module:Name", or
    a class in a file, "FILE.py:Name"; or a factory, called with the env and the options; or an
    `Agent`, which is returned. trust: whether a zip may be read, which runs code of its maker's.
    options: arguments of that controller, or of `agents.training.zips.policy_from_zip`.
    Raises ValueError for an unknown name or an observation without what the controller needs,
    TypeError for an unknown option, options beside an `Agent`, or what has no `predict`,
    PermissionError for a zip without trust.

    >>> import gymnasium as gym
    >>> env = gym.make("sideslip/YawVision-v0")
    >>> observation, _ = env.reset(seed=0)
    >>> action, state = make_agent("feedforward", env).predict(observation)
    >>> action.shape
    (1,)

    See also `Controller`, the base class of ours, and `sideslip.rollout`.
    """
    agent: Any = name
    if isinstance(name, str):
        if name.endswith(ZIP):
            zips = import_module(".training.zips", __name__)  # by name: a room above `learned`
            return PolicyController(env, zips.policy_from_zip(name, env, trust=trust, **options))
        if name not in AGENTS and is_policy(name):
            return PolicyController(env, policy=name, **options)
        factory = AGENTS.load(name, list_shipped())
        check_options(name, factory, options)
        agent = factory(env, **options)
    elif isinstance(name, type) or not hasattr(name, "predict"):
        agent = name(env, **options) if callable(name) else name
    elif options:
        raise TypeError(f"{type(name).__name__} is built already, got {', '.join(options)}")
    if not hasattr(agent, "predict"):
        raise TypeError(f"{name!r} is no agent: {type(agent).__name__} has no predict")
    result: Controller | Agent = agent
    return result


def register_agent(name: str, factory: Callable[..., Agent] | str) -> None:
    """Give an agent of your own a name that works wherever an agent's name does.

    factory: called with the env and options, as the classes of `AGENTS` are; or
    "package.module:Name", which is imported when first asked for. A name is known in this process
    alone; worker processes and `sideslip`'s command line take the entry point itself for a name.
    Raises TypeError or ValueError for a name or factory that is none, ValueError for a name that is
    taken.
    """
    if isinstance(name, str) and (is_policy(name) or name.endswith(ZIP)):
        raise ValueError(f"{name!r} is the name of a policy")
    AGENTS.register(name, factory)
