"""Lateral stability of electric vehicles with in-wheel motors: environments and a benchmark.

Importing this package registers its Gymnasium environments and loads nothing else of it:

>>> import gymnasium as gym
>>> import sideslip
>>> for name in sorted(name for name in gym.registry if name.startswith("sideslip/")):
...     print(name)
sideslip/AfsYawFusion-v0
sideslip/Highway-v0
sideslip/Outside-v0
sideslip/YawFusion-v0
sideslip/YawGps-v0
sideslip/YawVision-v0
sideslip/YawVisionUneven-v0

`rollout`, `score`, `make_agent`, `make_estimator`, `register_agent`, `register_estimator` and the
subpackages are loaded when first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gymnasium import register, registry

if TYPE_CHECKING:
    from .agents import make_agent, register_agent
    from .agents.rollout import rollout
    from .estimators import make_estimator, register_estimator

__version__ = "0.1.0"
__all__ = [
    "__version__",
    "make_agent",
    "make_estimator",
    "register_agent",
    "register_estimator",
    "rollout",
    "score",
]

_HOMES = {
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

# This file runs again under the checkout's own name (pytest) and in every worker process, so the
# entry point is a string and an id that stands in the registry is left alone.
for _id, _kwargs in _ENVIRONMENTS.items():
    if _id not in registry:
        register(
            _id,
            entry_point="sideslip.envs.stability:StabilityEnv",
            vector_entry_point="sideslip.envs.vector:StabilityVectorEnv",
            kwargs=_kwargs,
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
