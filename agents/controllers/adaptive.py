"""Adaptive control: gains and predictions follow the tyres that a filter estimates on the way."""

from typing import Any

import numpy as np

from ...envs.record import Array
from ..env_facts import AnyEnv
from .lqr import IN, Lqr
from .nmpc import Nmpc

TYRES = ("front_tyres_hat", "rear_tyres_hat")
INVERSE_FRICTION = "inverse_friction_hat"
MIN_FRICTION, MAX_FRICTION = 0.2, 1.2  # of the friction that is believed


class AdaptiveLqr(Lqr):
    """`Lqr` scheduled on the stiffness factors front_tyres_hat and rear_tyres_hat of `joint`.

    Where the observation has inverse_friction_hat (`joint` with inverse_friction_sd), limits use
    that friction, within 0.2 to 1.2.

    Args:
        env: Env of the controller, with both factors in its observation.
        grip: Grip limit, as for `Controller`.
        options: Other arguments of `Lqr`.

    Raises:
        ValueError: The tyres are not in the observation, or as `Lqr`.
    """

    def __init__(self, env: AnyEnv, grip: float | None = 0.7, **options: Any) -> None:
        super().__init__(env, stiffness=TYRES, grip=grip, **options)

    def _list_extra_entries(self, names: set[str]) -> tuple[str, ...]:
        return (
            *super()._list_extra_entries(names),
            *((INVERSE_FRICTION,) if INVERSE_FRICTION in names else ()),
        )

    def _get_friction(self, inputs: Array) -> Array:
        if INVERSE_FRICTION not in self.needs:
            return super()._get_friction(inputs)
        estimated = inputs[:, self.needs.index(INVERSE_FRICTION)]
        return np.asarray(1.0 / np.clip(estimated, 1.0 / MAX_FRICTION, 1.0 / MIN_FRICTION))

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        inputs[:, IN.front_stiffness] *= self.vehicle.front_stiffness
        inputs[:, IN.rear_stiffness] *= self.vehicle.rear_stiffness
        super()._law(inputs, state, action)


class AdaptiveNmpc(AdaptiveLqr, Nmpc):
    """`Nmpc` that predicts with the tyres and the friction of `joint`, as `AdaptiveLqr` has them.

    Args:
        env: Env of the controller, with both factors in its observation.
        grip: Grip limit, as for `Controller`.
        options: Other arguments of `Nmpc`.
    """
