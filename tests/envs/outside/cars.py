"""Cars on outside plants, as the tests drive them."""

from typing import Any

import gymnasium as gym
import pytest

from sideslip.envs.vehicle.dynamics import Motion

from ..helpers import SILENT

pytest.importorskip("vehiclemodels")
from sideslip.envs.outside.env import OutsideEnv
from sideslip.envs.outside.plants import OUTSIDE_PLANTS, OutsideInputs

MODELS = tuple(OUTSIDE_PLANTS)
V = 80.0 / 3.6
CALM: dict[str, Any] = {
    "duration": 2.0, "speed": V, "friction": 1.0489, "disturbance_force": 0.0,
    "disturbance_moment": 0.0, "noise": SILENT,
}  # fmt: skip
STEP = CALM | {"steering": "step", "amplitude": 0.02}


def outside(model: str, **changes: Any) -> OutsideEnv:
    env = gym.make("sideslip/Outside-v0", model=model, **changes).unwrapped
    assert isinstance(env, OutsideEnv)
    return env


def driven(model: str, acting: OutsideInputs, seconds: float = 1.0, speed: float = V) -> Any:
    """The plant after so long of the same inputs from straight ahead at 80 km/h."""
    plant = OUTSIDE_PLANTS[model]()
    plant.start(Motion(speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for _ in range(round(1e3 * seconds)):
        plant.step(acting, 1e-3)
    return plant
