"""What every classical controller shares: named inputs, batches, memory outside the object."""

from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ..envs.vehicle import Vehicle

Array = npt.NDArray[np.float64]


class Controller(ABC):
    """Stable-baselines3's `predict` around a compiled law.

    A subclass names its inputs (`needs`, entries of the env's layout), how many numbers it
    remembers (`memory`), and fills `_law`. `predict` is pure: all memory is in `state`, an array
    (N, memory).

    Raises ValueError when the env's observation lacks a needed entry.
    """

    needs: tuple[str, ...] = ()
    memory = 0

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        layout = env.get_wrapper_attr("layout")
        names = [entry.name for entry in layout]
        missing = [name for name in self.needs if name not in names]
        if missing:
            hint = (
                "; wrap the env in sideslip.estimators.EstimateObservation"
                if any(name.endswith("_hat") for name in missing)
                else ""
            )
            raise ValueError(
                f"{type(self).__name__} needs {', '.join(missing)} in the observation{hint}"
            )
        self._columns = np.array([names.index(name) for name in self.needs], dtype=np.int64)
        self._width = len(names)
        base: Any = env.unwrapped
        self.nominal: Vehicle = base.nominal
        self.full_scale = base.vehicle.yaw_moment_limit
        self.control_period: int = base.control_period
        self.width: int = base.action_space.shape[0]

    @abstractmethod
    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        """Fill action (N, width), which is zero, and update state (N, memory) in place.

        Its first column is the yaw moment as a share of full scale, its second, where the env has
        one, the added steering as a share of the vehicle's authority.
        """

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Array | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Array]:
        """The action for an observation (k,) or a batch (N, k), and the next state.

        state: (N, memory), None at the start. episode_start: (N,) rows whose memory is cleared.
        Raises ValueError for an observation of another width.
        """
        obs = np.asarray(observation)
        if obs.shape[-1] != self._width or obs.ndim > 2:
            raise ValueError(f"expected observations of width {self._width}, got {obs.shape}")
        batch = obs.reshape(-1, self._width)
        memory = np.zeros((len(batch), self.memory)) if state is None else np.array(state)
        if episode_start is not None:
            memory[np.asarray(episode_start, bool)] = 0.0
        action = np.zeros((len(batch), self.width))
        self._law(batch[:, self._columns].astype(np.float64), memory, action)
        shares = np.clip(action, -1.0, 1.0).astype(np.float32)
        return (shares[0] if obs.ndim == 1 else shares), memory


class NoControl(Controller):
    """The uncontrolled car."""

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        pass
