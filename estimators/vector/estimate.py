"""EstimateObservation for vector environments: all rows' estimators in one compiled call."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.task.observation import Entry
from ...envs.vehicle.vehicle import Vehicle, vehicle_from
from ..wrappers.estimate import TRUTH, usual_estimator
from ..wrappers.estimate import EstimateObservation as Single
from ..wrappers.outputs import BETA, NEES, outputs_of
from ..wrappers.truth import as_built, tell_stiffness
from .batch import BatchEstimator
from .designs import Told
from .records import Batch, BatchedRecords, SyncRecords, records_of, true_vehicles
from .spec import twin_spec

Observations = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Step = tuple[Observations, Any, Any, Any, dict[str, Any]]


class EstimateObservation(
    VectorWrapper[Observations, Any, Observations, Any, Any], RecordConstructorArgs
):
    """Runs an estimator on each car's record and appends what it says to the observations.

    The vector twin of `sideslip.estimators.EstimateObservation`, with the same arguments: every
    row gets the bits that the single wrapper would give it. It must be the innermost wrapper;
    others of its kind may be stacked, each with its own `name`. It works on `SyncVectorEnv` and
    on a vector env that offers what `records.Batched` says.

    A row whose episode ended starts a new one with a fresh filter: in the next step, or within
    the step that ended it, where the old filter first takes the last record into `final_obs`. As
    the environments do, `infos` has arrays (N,) of `beta_hat`, `beta_std` and `nees` with masks.

    `layout` describes a row; `estimator` is the `BatchEstimator` at work. `spec` names the single
    wrapper: `gym.make_vec(spec)` builds environments that are wrapped one by one.

    Raises TypeError if it is not the innermost wrapper or the records are out of reach; ValueError
    for an unknown output, where names would stand twice, or without autoreset.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        estimator: str | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: str | Mapping[str, Any] | Vehicle | None = None,
        options: Mapping[str, Any] | None = None,
        name: str | None = None,
    ) -> None:
        self._records = _records_below(env)
        if estimator is None:
            estimator = usual_estimator(self._records.told([0])[0].sensors)
        car = vehicle.to_dict() if isinstance(vehicle, Vehicle) else vehicle
        RecordConstructorArgs.__init__(
            self,
            estimator=estimator,
            outputs=list(outputs),
            std=bool(std),
            replace=bool(replace),
            vehicle=dict(car) if isinstance(car, Mapping) else car,
            options=dict(options or {}),
            name=name,
        )
        VectorWrapper.__init__(self, env)
        mode = env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            raise ValueError(f"the vector env must reset rows itself; its autoreset_mode is {mode}")
        self._same_step = mode == AutoresetMode.SAME_STEP
        self._truth = isinstance(vehicle, str) and vehicle == TRUTH
        self._vehicle = None if vehicle is None or self._truth else vehicle_from(vehicle)
        told = self._told(range(env.num_envs))
        self._built = told[0].vehicle
        self.estimator = BatchEstimator(estimator, told, self._records.dt, options or {})
        inner = () if replace else getattr(env, "layout", self._records.layout)
        self._says = outputs_of(estimator, self.estimator.names, outputs, std, name, inner)
        self.layout: tuple[Entry, ...] = self._says.layout
        low, high = self._says.bounds
        self.single_observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._out = np.zeros((env.num_envs, len(self.layout)), np.float32)
        self._ended: Mask | None = None  # rows that the next step resets; None: all are to be reset

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # as in VectorWrapper
        """The env's with the single wrapper; JSON-able, None where the env has none."""
        return twin_spec(self.env.spec, Single, self._saved_kwargs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Reset the rows (those of options["reset_mask"]) and their estimators; take tick 0."""
        mask = None if options is None else options.get("reset_mask")
        rows = np.ones(self.num_envs, np.bool_) if mask is None else np.array(mask)
        before, self._ended = self._ended, None
        if before is None and not rows.all():
            raise ResetNeeded(
                "reset all rows first: no step succeeded since then, or none was made"
            )
        obs, infos = self.env.reset(seed=seed, options=options)
        self._ended = np.zeros(self.num_envs, np.bool_) if before is None else before & ~rows
        self._restart(rows)
        self._observe(self._records.newest(), obs, infos, rows, self._out)
        return self._out.copy(), infos

    def step(self, actions: Any) -> Step:
        """One step of all rows, whose records the estimators take before observations are made."""
        before, self._ended = self._ended, None  # an error on the way leaves rows apart
        if before is None:
            raise ResetNeeded(
                "call reset() first: before the first step, and after one that failed"
            )
        try:
            obs, rewards, terminated, truncated, infos = self.env.step(actions)
        except ValueError:
            if isinstance(self._records, BatchedRecords):  # it refuses before it steps any row
                self._ended = before
            raise
        self._ended = ended = np.logical_or(terminated, truncated)
        if not self._same_step:
            self._restart(before)
        elif ended.any():
            self._finish(infos, ended)
            self._restart(ended)
        everyone = np.ones(self.num_envs, np.bool_)
        self._observe(self._records.newest(), obs, infos, everyone, self._out)
        return self._out.copy(), rewards, terminated, truncated, infos

    def _told(self, rows: Sequence[int]) -> list[Told]:
        told = self._records.told(rows)
        if self._truth:
            cars = true_vehicles(self.unwrapped, rows)
            return [each._replace(vehicle=car) for each, car in zip(told, cars, strict=True)]
        if self._vehicle is None:
            return told
        return [each._replace(vehicle=self._vehicle) for each in told]

    def _restart(self, mask: Mask) -> None:
        """Reset the estimators of some rows with the clocks of their new episodes."""
        rows = np.flatnonzero(mask).tolist()
        if rows:
            told = self._told(rows)
            if not self._truth:
                self.estimator.tell(rows, told)
            else:
                first = self.estimator[0]
                plain = [as_built(first, self._built, each.vehicle) for each in told]
                cars = zip(told, plain, strict=True)
                self.estimator.tell(rows, [each._replace(vehicle=car) for each, car in cars])
                for i, each in zip(rows, told, strict=True):
                    tell_stiffness(self.estimator[i], each.vehicle)
            self.estimator.reset(mask)

    def _finish(self, infos: dict[str, Any], ended: Mask) -> None:
        """Take the last record of the rows that ended into their `final_obs` and `final_info`."""
        obs, out = np.zeros((self.num_envs, self._says.kept), np.float32), np.zeros_like(self._out)
        if self._says.kept > 0:
            obs[ended] = np.stack(infos["final_obs"][ended])
        self._observe(self._records.final(ended), obs, infos["final_info"], ended, out)
        for i in np.flatnonzero(ended):
            infos["final_obs"][i] = out[i].copy()

    def _observe(
        self, batch: Batch, obs: Observations, infos: dict[str, Any], mask: Mask, out: Observations
    ) -> None:
        """Take the records of some rows; write their observations and what `infos` tells."""
        says, N = self._says, self.num_envs
        beta, gamma = infos.get("beta"), infos.get("gamma")
        known = beta is not None and gamma is not None
        truth = (beta, gamma) if known else (np.zeros(N), np.zeros(N))
        said = np.zeros((N, 3))
        self.estimator.take(
            mask,
            *batch,
            np.ascontiguousarray(obs, np.float32),
            says.kept,
            says.plan,
            says.limits,
            *truth,
            out,
            said,
        )
        for key, place in says.keys:
            if place == NEES and not known:
                continue
            values, told = said[:, place].copy(), mask.copy()
            if place == NEES:  # some rows' truth may be untold
                told &= infos.get("_beta", True)
                values[~told] = 0.0
            infos[key], infos[f"_{key}"] = values, told
            if place == BETA:
                self._records.annotate(key, values, mask)


def _records_below(env: VectorEnv[Any, Any, Any]) -> SyncRecords | BatchedRecords:
    """The records; TypeError if anything that may hide ticks from the estimators is in between."""
    if not isinstance(env, VectorEnv):
        raise TypeError(
            f"{type(env).__name__} is no vector environment; the wrapper of a single one is "
            "sideslip.estimators.EstimateObservation"
        )
    layer = env
    while isinstance(layer, VectorWrapper):
        if not isinstance(layer, EstimateObservation):
            raise TypeError(
                "EstimateObservation must be the innermost wrapper, directly around the vector "
                f"environment; inside it is {type(layer).__name__}"
            )
        layer = layer.env
    return records_of(layer)
