"""What an environment, single or vector, tells those who act in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv, VectorWrapper

from ..envs.layout import Entry
from ..envs.vehicle import Vehicle

AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


@dataclass(frozen=True)
class Given:
    """What controllers are designed from, the same for all rows of a vector env.

    layout: of an observation. nominal: the vehicle that controllers are told. full_scale: N m of
    the action 1. authority: rad of added steering of the action 1. control_period: ticks.
    reference: of `envs.reference.REFERENCES`. width: of an action.
    """

    layout: tuple[Entry, ...]
    nominal: Vehicle
    full_scale: float
    authority: float
    control_period: int
    reference: str
    width: int


def given(env: AnyEnv) -> Given:
    """Read it; ValueError where the rows of a vector env were told different cars."""
    if isinstance(env, VectorEnv):
        base: Any = env.unwrapped
        layout, width = _layout(env), base.single_action_space.shape[0]
        nominals, vehicles = _rows(base, "nominal"), _rows(base, "vehicle")
        period, kind = _common(base, "control_period"), _common(base, "reference")
    else:
        base = env.unwrapped
        layout, width = env.get_wrapper_attr("layout"), base.action_space.shape[0]
        nominals, vehicles = [base.nominal], [base.vehicle]
        period, kind = base.control_period, base.reference
    limits = [(car.yaw_moment_limit, car.steering_authority) for car in vehicles]
    for i, told in enumerate(zip(nominals, limits, strict=True)):
        if told != (nominals[0], limits[0]):
            raise ValueError(
                f"the rows of a vector env share one design, but row {i} was told another nominal "
                "vehicle or has other limits than row 0: make an agent for each kind of car"
            )
    return Given(layout, nominals[0], *limits[0], period, kind, width)


def _layout(env: VectorEnv[Any, Any, Any]) -> tuple[Entry, ...]:
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
