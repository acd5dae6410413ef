"""What every classical controller shares: named inputs, batches, memory outside the object."""

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt

from ..env_facts import AnyEnv, given

Array = npt.NDArray[np.float64]


class Controller(ABC):
    """Stable-baselines3's `predict` around a compiled law.

    A subclass names its inputs (`needs`, entries of the env's layout), how many numbers it
    remembers (`memory`), and fills `_law`. `predict` is pure: all memory is in `state`, an array
    (N, memory).

    A controller serves a single env or all rows of a vector env, which then share its design.
    Where a needed entry is not finite the action is NaN and the memory stays as it was, so that an
    estimator that fails is seen: an env with `on_bad_action="fail"` ends the episode, others raise.

    Raises ValueError when the env's observation lacks a needed entry, or where the rows of a vector
    env were told different cars.
    """

    needs: tuple[str, ...] = ()
    memory = 0

    def __init__(self, env: AnyEnv) -> None:
        told = given(env)
        names = [entry.name for entry in told.layout]
        missing = [name for name in self.needs if name not in names]
        if missing:
            raise ValueError(
                f"{type(self).__name__} needs {', '.join(missing)} in the observation"
                f"{_hint(missing)}"
            )
        self._columns = np.array([names.index(name) for name in self.needs], dtype=np.int64)
        self._width = len(names)
        self.nominal = told.nominal
        self.full_scale, self.authority = told.full_scale, told.authority
        self.control_period, self.reference = told.control_period, told.reference
        self.width = told.width

    @abstractmethod
    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        """Fill action (N, width), which is zero, and update state (N, memory) in place.

        inputs: (N, len(needs)), finite. A NaN that the law leaves in an action says that it failed.
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
        inputs = batch[:, self._columns].astype(np.float64)
        bad = ~np.isfinite(inputs).all(axis=1)
        if bad.any():
            before = memory[bad]
            inputs[bad] = 0.0
            self._law(inputs, memory, action)
            memory[bad], action[bad] = before, np.nan
        else:
            self._law(inputs, memory, action)
        shares = np.clip(action, -1.0, 1.0).astype(np.float32)
        return (shares[0] if obs.ndim == 1 else shares), memory


def _hint(missing: list[str]) -> str:
    """What to wrap the env in, so that its observation has these entries."""
    if any(name.startswith("true_") for name in missing):
        return "; build env and agent with sideslip.agents.informed.make_informed"
    if any(name.endswith("_hat") for name in missing):
        return "; wrap the env in sideslip.estimators.EstimateObservation"
    return ""


class NoControl(Controller):
    """The uncontrolled car."""

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        pass
