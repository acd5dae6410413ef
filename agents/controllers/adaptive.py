"""Adaptive control: gains and predictions follow the tyres that a filter estimates on the way."""

from typing import Any

import numpy as np

from ..env_facts import AnyEnv
from .base import Array
from .lqr import IN, Lqr
from .nmpc import Nmpc

TYRES = ("front_tyres_hat", "rear_tyres_hat")
GRIP = "inverse_friction_hat"
LEAST, MOST = 0.2, 1.2  # of the friction that is believed


class AdaptiveLqr(Lqr):
    """`Lqr` scheduled on the factors of stiffness front_tyres_hat and rear_tyres_hat of `joint`.

    Where the observation has inverse_friction_hat (`joint` with inverse_friction_sd), limits go by
    that friction, within 0.2 to 1.2. grip: of `Controller`. options: of `Lqr`.

    Raises what `Lqr` does, and ValueError where the tyres are not in the observation.
    """

    def __init__(self, env: AnyEnv, grip: float | None = 0.7, **options: Any) -> None:
        super().__init__(env, stiffness=TYRES, grip=grip, **options)

    def _more(self, names: set[str]) -> tuple[str, ...]:
        return (*super()._more(names), *((GRIP,) if GRIP in names else ()))

    def _friction(self, inputs: Array) -> Array:
        if GRIP not in self.needs:
            return super()._friction(inputs)
        estimated = inputs[:, self.needs.index(GRIP)]
        return np.asarray(1.0 / np.clip(estimated, 1.0 / MOST, 1.0 / LEAST))

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        inputs[:, IN.front_stiffness] *= self.vehicle.front_stiffness
        inputs[:, IN.rear_stiffness] *= self.vehicle.rear_stiffness
        super()._law(inputs, state, action)


class AdaptiveNmpc(AdaptiveLqr, Nmpc):
    """`Nmpc` that foresees the tyres, and the friction, which `joint` estimates; as `AdaptiveLqr`.

    grip: of `Controller`. options: of `Nmpc`.
    """
