"""Short cuts that several of these tests share."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import gymnasium
import numpy as np

import sideslip
from sideslip.envs import Record, StabilityEnv
from sideslip.envs.sensors.inertial import Noise

assert sideslip.__version__  # importing it registers the ids
_EXTRA = {"sideslip/Highway-v0", "sideslip/Outside-v0"}
"""The ids that need an extra."""
_V0 = {name for name in gymnasium.registry if re.fullmatch("sideslip/.*-v0", name)}
IDS = tuple(sorted(_V0 - _EXTRA))
V1 = tuple(sorted(name for name in gymnasium.registry if re.fullmatch("sideslip/.*-v1", name)))

SILENT: dict[str, float] = dict.fromkeys(Noise._fields, 0.0)
"""Sensors without noise."""

LINEAR: dict[str, Any] = {
    "base": "straight", "mirror": False, "speed": 25.0 / 3.6, "friction": 0.9,
    "front_stiffness": 1.0, "rear_stiffness": 1.0, "disturbance_force": 0.0,
    "disturbance_moment": 0.0, "small_angle": True, "tyres": "linear", "lags": False,
    "roll": False, "hdop": 1.0, "hdop_spread": 0.0, "noise": SILENT,
}  # fmt: skip
"""The papers' plant: nothing drawn, nothing disturbed, sensors without noise."""

BAD_ACTIONS: list[tuple[Any, str]] = [
    (0.5, r"shape \(\)"),
    (np.zeros(2, np.float32), r"shape \(2,\)"),
    (np.zeros((1, 1), np.float32), r"shape \(1, 1\)"),
    (np.zeros(0, np.float32), r"shape \(0,\)"),
    (["left"], r"\['left'\]: could not convert"),
    ([[0.0], [0.0, 0.0]], r"\[\[0.0\], \[0.0, 0.0\]\]: .*inhomog"),
    (None, r"shape \(\)"),
    ({}, r"\{\}: .* 'dict'; nothing was stepped"),
    ([10**400], ".*too large"),
]
"""What is no action of one number, and what is said of it."""

FULL: dict[str, Any] = LINEAR | {"small_angle": False, "tyres": "fiala"}
"""The same with the full equations and Fiala tyres."""


class Moment(NamedTuple):
    """What one reset or step gave."""

    obs: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    record: Record


def unwrapped(name: str, **changes: Any) -> StabilityEnv:
    """The bare environment of an id."""
    env = gymnasium.make(name, **changes).unwrapped
    assert isinstance(env, StabilityEnv)
    return env


def play(env: StabilityEnv, actions: Iterable[Any]) -> list[Moment]:
    """One Moment for each action, up to the end of the episode; a number stands for every entry."""
    moments = []
    for action in actions:
        filled = np.full(env.action_space.shape or (), action, np.float32)
        moments.append(Moment(*env.step(filled), env.record))
        if moments[-1].terminated or moments[-1].truncated:
            break
    return moments


def fast_rows(moments: list[Moment]) -> np.ndarray:
    """The fast rows of all moments."""
    return np.concatenate([moment.record.fast for moment in moments])


def packets(moments: list[Moment]) -> np.ndarray:
    """The packets of all moments."""
    return np.concatenate([moment.record.packets for moment in moments])


def bits(value: Any) -> Any:
    """A form in which two values are equal if and only if they have the same bits and shape."""
    if isinstance(value, dict):
        return {name: bits(each) for name, each in value.items()}
    if isinstance(value, Record):
        return bits((value.fast, value.packets, value.first))
    if isinstance(value, tuple | list):
        return tuple(bits(each) for each in value)
    if isinstance(value, float | np.ndarray | np.generic):
        array = np.asarray(value)
        return array.dtype.str, array.shape, array.tobytes()
    return value
