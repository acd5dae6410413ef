"""TruthObservation for vector environments."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv

from ..wrappers.truth import STIFFNESSES, TruthEntries, check_single
from ..wrappers.truth import TruthObservation as Single
from .records import Mask, Observations, VectorObservation


class TruthObservation(VectorObservation):
    """`sideslip.estimators.wrappers.truth.TruthObservation` of all rows, with the same bits.

    It stands outside of `sideslip.estimators.vector.EstimateObservation`. A row has the parameters
    of its new car from the first observation of an episode on; `final_obs` holds the old one's.

    Args:
        env: Vector environment of N rows with a `layout`.
        parameters: Names of `Vehicle`, appended as `true_<name>` in their units.
        states: Names of `TrueState`, appended as `<name>_hat` as if by an estimator without error.

    Raises:
        TypeError: The env has no layout or no vehicles.
        ValueError: A name is unknown or stands twice, or rows with states reset in the same step.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        parameters: Sequence[str] = STIFFNESSES,
        states: Sequence[str] = (),
    ) -> None:
        recorded = {"parameters": list(parameters), "states": list(states)}
        super().__init__(env, Single, recorded)
        check_single(env, type(self))
        if not hasattr(env, "layout"):
            raise TypeError(
                f"{type(env).__name__} has no layout; wrap it in "
                "sideslip.estimators.vector.EstimateObservation first"
            )
        self._entries = TruthEntries(parameters, states, env.layout)
        self._set_layout(self._entries.layout)
        if self._same_step and states:
            raise ValueError("true states need autoreset_mode 'NextStep' or 'Disabled'")
        self._values = np.zeros((env.num_envs, len(parameters)), np.float32)
        shape = env.num_envs, 2, len(self._entries.columns)
        self._calibration: Observations = np.ones(shape, np.float32)
        self._ended = np.ones(env.num_envs, np.bool_)

    def _begin(self, mask: Mask) -> None:
        rows = np.flatnonzero(mask)
        for i, truth in zip(rows, self._get_truths(rows.tolist()), strict=True):
            self._values[i], self._calibration[i] = self._entries.read(truth)

    def _finish(self, infos: dict[str, Any], ended: Mask) -> None:
        for i in np.flatnonzero(ended):
            car = self._values[i], self._calibration[i]
            infos["final_obs"][i] = self._entries.append(infos["final_obs"][i], *car, None)

    def _append(self, obs: Observations, infos: dict[str, Any], mask: Mask) -> Observations:
        true_states: Any = None
        if self._entries.states:
            base: Any = self.unwrapped
            if isinstance(base, SyncVectorEnv):
                true_states = np.array([env.unwrapped.true_state for env in base.envs])  # type: ignore[attr-defined]
            elif hasattr(base, "true_state"):
                true_states = np.asarray(base.true_state)
            else:
                raise TypeError(f"{type(base).__name__} does not offer the true states of its rows")
        return self._entries.append(obs, self._values, self._calibration, true_states)

    def _get_memory(self) -> dict[str, Any]:
        return {"values": self._values.copy(), "calibration": self._calibration.copy()}

    def _set_memory(self, snapshot: Mapping[str, Any]) -> None:
        self._values = snapshot["values"].copy()
        self._calibration = snapshot["calibration"].copy()
