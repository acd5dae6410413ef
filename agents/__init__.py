"""Everything that acts, with stable-baselines3's `predict`: controllers and learned policies."""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, overload

from ..envs.validation import check_options
from ..estimators.make import Registry
from .controllers.base import Controller, NoControl
from .controllers.lqr import AdaptiveLqr, LaneKeeping, Lqr
from .controllers.mpc import AdaptiveNmpc, Mpc, Nmpc
from .controllers.two_dof import Feedforward, TwoDof
from .controllers.yaw_stability import Esc, ModelFollowing, SlidingMode
from .env_info import AnyEnv
from .learned.policy import ZIP, PolicyController, is_policy, list_shipped

# Every agent that has a name, but for policies: the package's own and those registered.
AGENTS = Registry(
    "agent",
    {
        "none": NoControl, "feedforward": Feedforward, "two-dof": TwoDof,
        "model-following": ModelFollowing, "esc": Esc, "sliding-mode": SlidingMode, "lqr": Lqr,
        "adaptive-lqr": AdaptiveLqr, "adaptive-nmpc": AdaptiveNmpc, "mpc": Mpc, "nmpc": Nmpc,
        "lane-keeping": LaneKeeping, "learned": PolicyController,
    },
)  # fmt: skip

__all__ = [
    "AGENTS", "AdaptiveLqr", "AdaptiveNmpc", "Agent", "Controller", "Esc", "Feedforward",
    "LaneKeeping", "Lqr", "ModelFollowing", "Mpc", "Nmpc", "NoControl", "PolicyController",
    "SlidingMode", "TwoDof", "make_agent", "register_agent",
]  # fmt: skip


class Agent(Protocol):
    """An actor in an env: a model of stable-baselines3, a controller, or a user's own object."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:  # fmt: skip
        """Compute the action, shape (width,) or (N, width), for an observation, and the next state.

        Args:
            observation: Observation, shape (k,) or (N, k).
            state: Memory from the last call; None at first.
            episode_start: Rows whose episode has just begun, bool, shape (N,).
            deterministic: Whether to take the mean action instead of a sample.
        """


if TYPE_CHECKING:

    @overload
    def make_agent(name: str, env: AnyEnv, **options: Any) -> Controller: ...

    @overload
    def make_agent(name: Agent | Callable[..., Agent], env: AnyEnv, **options: Any) -> Agent: ...


def make_agent(
    name: str | Agent | Callable[..., Agent], env: AnyEnv, *, trust: bool = False, **options: Any
) -> Controller | Agent:
    """Make an agent for an env, single or vector; controllers are designed for its nominal vehicle.

    Args:
        name: Name in `AGENTS`, shipped policy, `.../NAME.safetensors`, `.../NAME.zip` of a
            stable-baselines3 model trained on this env, "package.module:Name", "FILE.py:Name"; a
            factory, called with env and options; or an `Agent`, which is returned.
        env: Env of this package.
        trust: Whether a zip may be read, which can run code of its author.
        options: Arguments of the controller, or of `agents.training.export.policy_from_zip`.

    Raises:
        ValueError: The name is unknown, or the observation lacks what the controller needs.
        TypeError: An option is unknown or stands beside an `Agent`, or there is no `predict`.
        PermissionError: The name is a zip and `trust` is False.

    >>> import gymnasium as gym
    >>> env = gym.make("sideslip/YawVision-v0")
    >>> observation, _ = env.reset(seed=0)
    >>> action, state = make_agent("feedforward", env).predict(observation)
    >>> action.shape
    (1,)

    See also `Controller`, the base class of the controllers, and `sideslip.rollout`.
    """
    agent: Any = name
    if isinstance(name, str):
        if name.endswith(ZIP):
            # by name: it needs the extra `train`
            zips = import_module(".training.export", __name__)
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
    """Give a user's agent a name that works wherever an agent's name does.

    Raises TypeError for a wrong type, ValueError for an invalid name or factory or a taken name.

    Args:
        name: New name, in this process alone; workers and the command line take the entry point.
        factory: Called with env and options; or "package.module:Name", imported at its first use.
    """
    if isinstance(name, str) and (is_policy(name) or name.endswith(ZIP)):
        raise ValueError(f"{name!r} is the name of a policy")
    AGENTS.register(name, factory)
