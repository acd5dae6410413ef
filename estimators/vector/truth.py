"""TruthObservation for vector environments."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.task import make_space
from ..wrappers.truth import STIFFNESSES, make_truth_entries, read_states
from ..wrappers.truth import TruthObservation as Single
from .records import get_env_state, get_true_vehicles, make_vector_spec

_Observations = npt.NDArray[np.float32]


class TruthObservation(
    VectorWrapper[_Observations, Any, _Observations, Any, Any], RecordConstructorArgs
):
    """`sideslip.estimators.wrappers.truth.TruthObservation` of all rows, with the same bits.

    It stands outside of `sideslip.estimators.vector.EstimateObservation`. A row has the parameters
    of its new car from the first observation of an episode on; `final_obs` holds the old one's.
    `spec` names the single wrapper: `gym.make_vec(spec)` builds environments that are wrapped one
    by one.

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
        RecordConstructorArgs.__init__(self, parameters=list(parameters), states=list(states))
        VectorWrapper.__init__(self, env)
        if not hasattr(env, "layout"):
            raise TypeError(
                f"{type(env).__name__} has no layout; wrap it in "
                "sideslip.estimators.vector.EstimateObservation first"
            )
        self._parameters, self._states = tuple(parameters), tuple(states)
        self.layout = make_truth_entries(self._parameters, self._states, env.layout)
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
        if self._same_step and states:
            raise ValueError("true states need autoreset_mode 'NextStep' or 'Disabled'")
        self._values = np.zeros((env.num_envs, len(self._parameters)), np.float32)
        self._ended = np.ones(env.num_envs, np.bool_)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # as in VectorWrapper
        """The env's spec with the single wrapper; JSON-able, None where the env has none."""
        return make_vector_spec(self.env.spec, Single, self._saved_kwargs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[_Observations, dict[str, Any]]:
        """Reset the rows (those of options["reset_mask"]) and read their cars.

        Args:
            seed: Seed of row 0, or a list (N,); see `gymnasium.vector.VectorEnv.reset`.
            options: Options of the env.

        Returns:
            Observations and infos.
        """
        mask = None if options is None else options.get("reset_mask")
        rows = np.ones(self.num_envs, np.bool_) if mask is None else np.array(mask)
        obs, infos = self.env.reset(seed=seed, options=options)
        self._read_cars(rows)
        self._ended &= ~rows
        return self._append_truth(obs), infos

    def _append_truth(self, obs: _Observations) -> _Observations:
        parts = [obs, self._values]
        if self._states:
            base: Any = self.unwrapped
            if isinstance(base, SyncVectorEnv):
                true_states = np.array([env.unwrapped.true_state for env in base.envs])  # type: ignore[attr-defined]
            elif hasattr(base, "true_state"):
                true_states = np.asarray(base.true_state)
            else:
                raise TypeError(f"{type(base).__name__} does not offer the true states of its rows")
            parts.append(read_states(true_states, self._states))
        return np.hstack(parts)

    def step(self, actions: Any) -> tuple[_Observations, Any, Any, Any, dict[str, Any]]:
        """Step all rows; `final_obs` gets the parameters of the old cars.

        Args:
            actions: Actions of all rows.

        Returns:
            Observations, rewards, terminations, truncations and infos.
        """
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = np.logical_or(terminated, truncated)
        if self._same_step:
            for i in np.flatnonzero(ended):
                infos["final_obs"][i] = np.concatenate([infos["final_obs"][i], self._values[i]])
        self._read_cars(ended if self._same_step else self._ended)
        self._ended = ended
        return self._append_truth(obs), rewards, terminated, truncated, infos

    def get_state(self) -> dict[str, Any]:
        """Return a snapshot for `set_state`; TypeError where the env makes none."""
        arrays = {"values": self._values.copy(), "ended": self._ended.copy()}
        return arrays | {"env": get_env_state(self.env)}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        env: Any = self.env
        env.set_state(snapshot["env"])
        self._values, self._ended = snapshot["values"].copy(), snapshot["ended"].copy()

    def _read_cars(self, mask: npt.NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(mask)
        cars = get_true_vehicles(self.unwrapped, rows.tolist())
        for i, car in zip(rows, cars, strict=True):
            self._values[i] = [getattr(car, name) for name in self._parameters]
