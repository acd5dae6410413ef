"""The base of the wrappers of vector environments."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.engine.views import CarTruth
from ...envs.task import Infos, ObservationEntry, make_space

Mask = npt.NDArray[np.bool_]
Observations = npt.NDArray[np.float32]
Snapshot = dict[str, Any]
AnyVectorEnv = VectorEnv[Any, Any, Any]


class VectorObservation(VectorWrapper[Observations, Any, Observations, Any, Any]):
    """A wrapper that appends entries of its own to the observations of all rows.

    A row whose episode ended begins anew in the next step or, where the env resets it within the
    step that ends it, in that one. `spec` is the env's, without this wrapper.

    Args:
        env: Vector environment of N rows.
    """

    layout: tuple[ObservationEntry, ...]

    def __init__(self, env: AnyVectorEnv) -> None:
        super().__init__(env)
        self._same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
        self._ended: Mask | None = None  # rows that the next step resets; None: all are to be

    def _set_layout(self, layout: tuple[ObservationEntry, ...]) -> None:
        """Set the entries of a row's observation."""
        self.layout, self.single_observation_space = layout, make_space(layout)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def _begin(self, mask: Mask) -> None:
        """Begin the new episodes of some rows."""
        raise NotImplementedError

    def _append(self, obs: Observations, infos: Infos, mask: Mask) -> Observations:
        """Make the observations of all rows, of which some got a new one, and their `infos`."""
        raise NotImplementedError

    def _finish(self, infos: Infos, ended: Mask) -> None:
        """Make `final_obs` and `final_info` of rows that ended within the step."""
        raise NotImplementedError

    def _restore_ended(self, ended_before: Mask | None, error: Exception) -> None:
        """Restore the flags after an error of the env, unless it may have moved some rows."""
        self._ended = ended_before

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, Infos]:
        """Reset the rows, or those of options["reset_mask"], as `gymnasium.vector.VectorEnv` does.

        Args:
            seed: Seed of row 0, or a list (N,).
            options: Options of the env. ResetNeeded if a mask leaves out rows and no step succeeded
                since the last whole reset.
        """
        mask = None if options is None else options.get("reset_mask")
        rows = np.ones(self.num_envs, np.bool_) if mask is None else np.array(mask)
        ended_before, self._ended = self._ended, None
        if ended_before is None and not rows.all():
            text = "reset all rows first: no step succeeded since then, or none was made"
            raise ResetNeeded(text)
        try:
            obs, infos = self.env.reset(seed=seed, options=options)
        except Exception as error:
            self._restore_ended(ended_before, error)
            raise
        self._ended = np.zeros_like(rows) if ended_before is None else ended_before & ~rows
        self._begin(rows)
        return self._append(obs, infos, rows), infos

    def step(self, actions: Any) -> tuple[Observations, Any, Any, Any, Infos]:
        """Step all rows as Gymnasium does; ResetNeeded before `reset` and after a step that failed.

        Args:
            actions: Actions of all rows.
        """
        ended_before, self._ended = self._ended, None  # an error on the way leaves rows apart
        if ended_before is None:
            text = "call reset() first: before the first step, and after one that failed"
            raise ResetNeeded(text)
        try:
            obs, rewards, terminated, truncated, infos = self.env.step(actions)
        except Exception as error:
            self._restore_ended(ended_before, error)
            raise
        ended = np.logical_or(terminated, truncated)
        if not self._same_step:
            self._begin(ended_before)
        elif ended.any():
            self._finish(infos, ended)
            self._begin(ended)
        obs = self._append(obs, infos, np.ones_like(ended))
        self._ended = ended
        return obs, rewards, terminated, truncated, infos

    def get_state(self) -> Snapshot:
        """Return a snapshot for `set_state`; TypeError where the env makes none."""
        env: Any = self.env
        if not hasattr(env, "get_state"):
            text = "makes no snapshots; the vector env that gym.make_vec builds by itself does"
            raise TypeError(f"{type(env).__name__} {text}")
        ended = None if self._ended is None else self._ended.copy()
        return {"env": env.get_state(), "ended": ended} | self._get_memory()

    def set_state(self, snapshot: Snapshot) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        env: Any = self.env
        env.set_state(snapshot["env"])
        self._ended = None if snapshot["ended"] is None else snapshot["ended"].copy()
        self._set_memory(snapshot)

    def _get_memory(self) -> Snapshot:
        """Return a snapshot of what the wrapper has beside the env."""
        raise NotImplementedError

    def _set_memory(self, snapshot: Snapshot) -> None:
        """Restore what `_get_memory` returned."""
        raise NotImplementedError

    def _get_truths(self, rows: Sequence[int]) -> list[CarTruth]:
        """Return what is told of some rows' episodes; TypeError where it is out of reach."""
        base: Any = self.unwrapped
        if isinstance(base, SyncVectorEnv):
            return [base.envs[i].unwrapped.car_truth for i in rows]  # type: ignore[attr-defined]
        if not hasattr(base, "car_truth"):
            raise TypeError(f"{type(base).__name__} does not offer which vehicles its rows drive")
        return [base.car_truth[i] for i in rows]
