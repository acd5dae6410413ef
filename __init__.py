"""Lateral stability of electric vehicles with in-wheel motors: environments and a benchmark.

Importing this package registers its Gymnasium environments and loads nothing else of it:

>>> import gymnasium as gym
>>> import sideslip
>>> for name in sorted(name for name in gym.registry if name.startswith("sideslip/")):
...     print(name)
sideslip/AfsYawFusion-v0
sideslip/AfsYawFusion-v1
sideslip/Highway-v0
sideslip/LinearYawGps-v0
sideslip/LinearYawVision-v0
sideslip/Outside-v0
sideslip/YawFusion-v0
sideslip/YawFusion-v1
sideslip/YawGps-v0
sideslip/YawGps-v1
sideslip/YawVision-v0
sideslip/YawVision-v1
sideslip/YawVisionUneven-v0
sideslip/YawVisionUneven-v1

`Stream`, `estimate`, `rollout`, `score`, `make_agent`, `make_estimator`, `register_agent`,
`register_estimator` and the subpackages are loaded when first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any
from warnings import filterwarnings

from gymnasium import register, registry

if TYPE_CHECKING:
    from .agents import make_agent, register_agent
    from .agents.rollout import rollout
    from .estimators import make_estimator, register_estimator
    from .estimators.joint import Stream, estimate

__version__ = "0.2.0"
__all__ = [
    "Stream",
    "__version__",
    "estimate",
    "make_agent",
    "make_estimator",
    "register_agent",
    "register_estimator",
    "rollout",
    "score",
]

_HOMES = {
    "Stream": ".estimators.joint",
    "estimate": ".estimators.joint",
    "make_agent": ".agents",
    "make_estimator": ".estimators",
    "register_agent": ".agents",
    "register_estimator": ".estimators",
    "rollout": ".agents.rollout",
    "score": ".benchmarks.entrants.score",
}
_ROOMS = ("envs", "estimators", "agents", "benchmarks")
_ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "sideslip/YawVision-v0": {"sensors": "vision", "reference": "zero-slip"},
    "sideslip/YawVisionUneven-v0": {"sensors": "vision-uneven", "reference": "zero-slip"},
    "sideslip/YawGps-v0": {"sensors": "gps", "reference": "model"},
    "sideslip/YawFusion-v0": {"sensors": "fusion", "reference": "model"},
    "sideslip/AfsYawFusion-v0": {"sensors": "fusion", "reference": "model", "steering": True},
}
# Version 1 has cars and sensors that err; version 0 is the same with all ranges zero. It stays, for
# it is the papers' world: Gymnasium's advice to leave an older version would mislead.
_ENVIRONMENTS |= {
    _id.replace("-v0", "-v1"): _kwargs | {"world": "v1"} for _id, _kwargs in _ENVIRONMENTS.items()
}
filterwarnings("ignore", r".*environment sideslip/\w+-v0 is out of date", DeprecationWarning)
# Linear, Gaussian, known: the best policy's cost is computed (`agents.baselines`).
# The noise of sensors that the optimal filter does not read leaves them nothing to say.
_MOTORS = {"motor_lag": 0.0, "steering_lag": 0.0, "motor_torque": 600.0}
_LINEAR = {
    "name": "linear",
    "steering": "wander",
    "amplitude": 0.005,
    "frequency": 0.2,
    "hold": 0.01,
    "disturbance_time": 1.0,
    "small_angle": True,
    "tyres": "linear",
    "roll": False,
    "vehicle": _MOTORS,
    "nominal": _MOTORS,
    "hdop_law": "constant",
    "hdop_spread": 0.0,
    "half_width": 1e9,
    "noise": {
        "gyro": 0.003,
        "camera_psi": 3e-4,
        "camera_y": 0.001,
        "course": 0.003,
        "accel": 1e4,
        "wheel": 100.0,
        "gps_speed": 100.0,
        "gps_position": 1e4,
    },
}
_OPTIMA = {
    "sideslip/LinearYawVision-v0": ("vision", -0.021510993),
    "sideslip/LinearYawGps-v0": ("gps", -0.014128621),
}
_ENVIRONMENTS |= {
    _id: {
        "sensors": _sensors,
        "reference": "zero-slip",
        "fast": "all",
        "scenario": _LINEAR,
    }
    for _id, (_sensors, _) in _OPTIMA.items()
}

# This file runs again under the checkout's own name (pytest) and in every worker process, so the
# entry point is a string and an id that stands in the registry is left alone.
for _id, _kwargs in _ENVIRONMENTS.items():
    if _id not in registry:
        register(
            _id,
            entry_point="sideslip.envs.stability:StabilityEnv",
            vector_entry_point="sideslip.envs.vector:StabilityVectorEnv",
            kwargs=_kwargs,
            reward_threshold=_OPTIMA[_id][1] if _id in _OPTIMA else None,
        )
for _id, _entry in {
    "sideslip/Highway-v0": "sideslip.envs.highway.env:HighwayEnv",
    "sideslip/Outside-v0": "sideslip.envs.outside.env:OutsideEnv",
}.items():
    if _id not in registry:
        register(_id, entry_point=_entry, kwargs={"sensors": "fusion"})


def __getattr__(name: str) -> Any:
    """Load a name of the package's face from the module where it lives."""
    if name in _ROOMS:
        return import_module(f".{name}", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name], __name__), name)
    return value


def __dir__() -> list[str]:
    return sorted(globals().keys() | _HOMES.keys())
