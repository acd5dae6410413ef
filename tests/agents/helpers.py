"""Short cuts that several of these tests share."""

from typing import Any

import numpy as np


def compute_gains(agent: Any, speed: float, front: float = 0.0, rear: float = 0.0) -> np.ndarray:
    """The gains K (m, n) on the states of an LQR's design; stiffnesses in N/rad, 0: the car's."""
    KS: np.ndarray = agent._interpolate(speed, front, rear)
    return KS[:, : len(agent.design_spec.states)]


def observe(env: Any, speed: float = 7.0, **values: float) -> np.ndarray:
    """An observation at a speed (m/s) that is zero but for some values."""
    names = [entry.name for entry in env.get_wrapper_attr("layout")]
    obs = np.zeros(len(names), np.float32)
    for name, value in ({"wheel_left": speed, "wheel_right": speed} | values).items():
        obs[names.index(name)] = value
    return obs
