"""Facts of an environment, single or vector, that controllers are designed from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.vector import VectorEnv, VectorWrapper

from ..envs.engine.config import EnvConfig
from ..envs.task.observation import Entry
from ..envs.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any] | VecEnv
else:
    AnyEnv = Any  # stable-baselines3 comes with an extra, and needs a second to load


@dataclass(frozen=True)
class EnvFacts:
    """What controllers are designed from, the same for all rows of a vector env.

    layout: of an observation. nominal: the vehicle as controllers know it. full_scale: N m of
    the action 1. authority: rad of added steering of the action 1. control_period: ticks.
    reference: of `envs.task.reference.REFERENCES`. width: of an action.
    """

    layout: tuple[Entry, ...]
    nominal: Vehicle
    full_scale: float
    authority: float
    control_period: int
    reference: str
    width: int


def made(env_id: str, options: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """The env of an id; what its arguments lack is said as the env says it, and no longer."""
    try:
        return gym.make(env_id, **options)
    except TypeError as error:  # of which Gymnasium makes a longer one
        raise TypeError(str(error).partition(" was raised from the environment")[0]) from None


def facts_of(env: AnyEnv) -> EnvFacts:
    """The facts of an env, a vector env or a stable-baselines3 `VecEnv`.

    Raises ValueError where the rows of a vector env have different nominal cars or limits, or where
    a wrapper of stable-baselines3 changes the observations.
    """
    nominals: Sequence[Any]
    vehicles: Sequence[Any]
    if isinstance(env, gym.Env):
        base: Any = env.unwrapped
        layout, width = env.get_wrapper_attr("layout"), base.action_space.shape[0]
        nominals, vehicles = [base.nominal], [base.vehicle]
        period, kind = base.control_period, base.reference
    elif isinstance(env, VectorEnv):
        base = env.unwrapped
        layout, width = layout_of(env), base.single_action_space.shape[0]
        nominals, vehicles = _rows(base, "nominal"), _rows(base, "vehicle")
        period, kind = _common(base, "control_period"), _common(base, "reference")
    else:
        base = env.unwrapped
        layout, width = _plain(env, _common(base, "layout")), base.action_space.shape[0]
        nominals, vehicles = base.get_attr("nominal"), base.get_attr("vehicle")
        period, kind = _common(base, "control_period"), _common(base, "reference")
    limits = [(car.yaw_moment_limit, car.steering_authority) for car in vehicles]
    for i, car in enumerate(zip(nominals, limits, strict=True)):
        if car != (nominals[0], limits[0]):
            raise ValueError(
                f"the rows of a vector env share one design, but row {i} has another nominal "
                "vehicle or other limits than row 0: make an agent for each kind of car"
            )
    return EnvFacts(layout, nominals[0], *limits[0], period, kind, width)


def configs_of(env: AnyEnv) -> Sequence[EnvConfig]:
    """The arguments of an env, or of each environment in a vector env that has no one for all."""
    base: Any = env.unwrapped
    return [base.config] if hasattr(base, "config") else base.get_attr("config")


def _plain(env: Any, layout: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """The layout, if the outermost observations of a stable-baselines3 env have it."""
    layer = env
    while layer is not None:
        if vars(layer).get("norm_obs") or layer.observation_space.shape != (len(layout),):
            raise ValueError(
                f"{type(layer).__name__} changes the observations, which a controller reads by "
                "name: design and drive it on the env inside"
            )
        layer = vars(layer).get("venv")
    return layout


def layout_of(env: VectorEnv[Any, Any, Any]) -> tuple[Entry, ...]:
    """The outermost layout that a layer offers, else that of the sub-environments."""
    layer: Any = env
    while True:
        if "layout" in vars(layer):
            return tuple(layer.layout)
        if not isinstance(layer, VectorWrapper):
            return tuple(_common(layer, "layout"))
        layer = layer.env


def _rows(base: Any, name: str) -> Sequence[Any]:
    """An attribute of each row: the vector env's own sequence, or its sub-environments'."""
    return list(getattr(base, name) if hasattr(base, name) else base.get_attr(name))


def _common(base: Any, name: str) -> Any:
    """An attribute that all rows share; ValueError where they do not."""
    if hasattr(base, name):
        return getattr(base, name)
    rows = base.get_attr(name)
    for i, row in enumerate(rows):
        if row != rows[0]:
            raise ValueError(f"row {i} of the vector env has another {name} than row 0")
    return rows[0]
