"""One row of a native vector env, as far as it can be asked what a single environment is asked."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper

from ...envs.task.info import make_info
from ...envs.vehicle.dynamics import Motion
from ...estimators.vector import estimate as vector
from ...estimators.vector import truth as truth_vector
from ...estimators.wrappers import estimate as wrappers
from ...estimators.wrappers import truth

_ROW_ATTRIBUTES = (  # a sequence in the vector env, with an item for each row
    "vehicle", "nominal", "scenario", "record", "held_speed", "slow_sensors", "motion",
    "estimator", "np_random", "np_random_seed",
)  # fmt: skip
_SHARED_ATTRIBUTES = (
    "layout", "control_period", "reference", "dt", "setting", "spec", "render_mode", "metadata",
)  # fmt: skip
_SPACES = ("observation_space", "action_space")
_METHODS = ("reset", "get_wrapper_attr", "has_wrapper_attr", "set_wrapper_attr")
_TWINS: dict[type, type] = {
    wrappers.EstimateObservation: vector.EstimateObservation,
    truth.TruthObservation: truth_vector.TruthObservation,
}


class VecEnvRow:
    """One row of a vector env, with the attributes of the single env under the same names.

    It has those of `_ROW_ATTRIBUTES`, `_SHARED_ATTRIBUTES` and `_SPACES`, the methods, and values
    set here.

    Args:
        env: Vector env, wrapped or bare.
        i: Index of the row.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], i: int) -> None:
        self._env, self._i = env, i
        self._set: dict[str, Any] = {}

    def _iterate_layers(self) -> Iterator[VectorEnv[Any, Any, Any]]:
        """Iterate from the outermost wrapper to the bare vector env."""
        layer = self._env
        while isinstance(layer, VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def get_wrapper_attr(self, name: str) -> Any:
        """Get an attribute of this row from the outermost layer that has it.

        Args:
            name: Name of the attribute.

        Returns:
            Value of this row.

        Raises:
            AttributeError: No layer has it.
        """
        if name in self._set:
            return self._set[name]
        if name in _METHODS:
            return getattr(self, name)
        attribute = f"single_{name}" if name in _SPACES else name
        if name in (*_ROW_ATTRIBUTES, *_SHARED_ATTRIBUTES, *_SPACES):
            for layer in self._iterate_layers():
                if attribute in vars(layer) or hasattr(type(layer), attribute):
                    value = getattr(layer, attribute)
                    return self._get_row_value(name, value) if name in _ROW_ATTRIBUTES else value
        known = (*_ROW_ATTRIBUTES, *_SHARED_ATTRIBUTES, *_SPACES, *_METHODS, *self._set)
        raise AttributeError(f"a row of a vector env has {', '.join(known)}; not {name!r}")

    def _get_row_value(self, name: str, value: Any) -> Any:
        return Motion(*value[self._i].tolist()) if name == "motion" else value[self._i]

    def has_wrapper_attr(self, name: str) -> bool:
        """Return whether `get_wrapper_attr` finds an attribute.

        Args:
            name: Name of the attribute.

        Returns:
            True if it does.
        """
        try:
            self.get_wrapper_attr(name)
        except AttributeError:
            return False
        return True

    def set_wrapper_attr(self, name: str, value: Any, **_: Any) -> None:
        """Set a value beside the env, under a name that the env does not have.

        Args:
            name: Name of the value.
            value: Value for `get_wrapper_attr`.

        Raises:
            AttributeError: The name is the env's.
        """
        if name not in self._set and self.has_wrapper_attr(name):
            raise AttributeError(
                f"{name!r} is the environment's and is not set from outside; options of reset "
                "(`set_options`) change the scenario, vehicle, friction, state and duration"
            )
        self._set[name] = value

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start a new episode in this row alone.

        Args:
            seed: Seed of the row.
            options: Options of the reset.

        Returns:
            Observation of shape (k,), and info.
        """
        mask = np.arange(self._env.num_envs) == self._i
        seeds: Any = [seed if is_row else None for is_row in mask]
        more = {name: [value] * len(mask) for name, value in (options or {}).items()}
        obs, _ = self._env.reset(seed=seeds, options={**more, "reset_mask": mask})
        base: Any = self._env.unwrapped
        return obs[self._i], make_info(base.reports[self._i].tolist())

    def is_wrapped(self, wrapper_class: type) -> bool:
        """Return whether a layer has a class, or is the vector twin of a single wrapper.

        Args:
            wrapper_class: Class of a wrapper.

        Returns:
            True if one does.
        """
        wanted = _TWINS.get(wrapper_class, wrapper_class)
        return any(isinstance(layer, wanted) for layer in self._iterate_layers())
