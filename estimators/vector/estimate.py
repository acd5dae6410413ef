"""Observations of vector environments: all rows' estimates in one compiled call, or the truth."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.record import FAST_WIDTH
from ...envs.task import Infos, ObservationEntry, make_space
from ...envs.vehicle.parameters import VehicleSource
from ..core.filter import Observed, StepRecord
from ..wrappers.estimate import BETA, NEES, STD, Arguments, EstimatorSource, EstimatorSpec
from ..wrappers.truth import (
    STIFFNESSES,
    TruthEntries,
    calibrate,
    choose_vehicle,
    refuse_stacked,
    set_stiffness,
)
from .batch import BATCHED_MEMBERS, BatchedRecords, SyncRecords, build_batch

Mask = npt.NDArray[np.bool_]
Observations = npt.NDArray[np.float32]
Snapshot = dict[str, Any]
AnyVectorEnv = VectorEnv[Any, Any, Any]


class VectorObservation(VectorWrapper[Observations, Any, Observations, Any, Any]):
    """A wrapper that appends entries of its own to the observations of all rows.

    A row whose episode ended begins anew in the next step or, where the env resets it within the
    step that ends it, in that one. `spec` is the env's, without this wrapper.
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
        return {"env": env.get_state(), "ended": ended}

    def set_state(self, snapshot: Snapshot) -> None:
        """Restore a snapshot of this env or of one built with the same arguments."""
        env: Any = self.env
        env.set_state(snapshot["env"])
        self._ended = None if snapshot["ended"] is None else snapshot["ended"].copy()

    def _read_rows(self, name: str, rows: Sequence[int]) -> list[Any]:
        """Read an attribute of some rows' episodes; TypeError where it is out of reach."""
        base: Any = self.unwrapped
        if isinstance(base, SyncVectorEnv):
            return [getattr(base.envs[i].unwrapped, name) for i in rows]
        if not hasattr(base, name):
            raise TypeError(f"{type(base).__name__} does not offer the {name} of its rows")
        values = getattr(base, name)
        return [values[i] for i in rows]


class EstimateObservation(VectorObservation):
    """Runs an estimator on each car's record and appends its states to the observations.

    `sideslip.estimators.EstimateObservation` of all rows: every row gets the bits that the single
    wrapper would give it. It must be the innermost wrapper; others of its class may be stacked,
    each with its own `name`. It works on `SyncVectorEnv` and on a vector env with records as those
    of `StabilityVectorEnv`.

    A row whose episode ended starts a new one with a fresh filter; where that is within the step
    that ended it, the old filter first takes the last record into `final_obs`. As the environments
    do, `infos` has arrays (N,) of `beta_hat`, `beta_std` and `nees` with masks. `layout` describes
    a row; `estimator` is the `BatchEstimator` at work. Errors are those of the single wrapper.

    Args:
        env: Vector environment of N rows.
        estimator: As of the single wrapper, but for an object. A factory is called once for each
            row, and again where a row's car changes.
        outputs: States to append, each as `<state>_hat`.
        std: Whether each one's standard deviation is appended as `<state>_std`.
        replace: Whether the observation is these alone.
        vehicle: Vehicle as the estimator believes it to be; "truth" is each row's own.
        options: Options of `make_estimator`.
        name: Put before every name as `<name>_`.
        **misplaced: Refused; the message names the nearest argument or option.

    Raises:
        TypeError: It is not innermost, records are out of reach, or the estimator is one object.
        ValueError: An output is unknown, names would stand twice, or there is no autoreset.
    """

    def __init__(
        self, env: AnyVectorEnv, estimator: EstimatorSource | None = None,
        outputs: Sequence[str] = ("beta", "gamma"), std: bool = True, replace: bool = False,
        vehicle: VehicleSource | None = None, options: Mapping[str, object] | None = None,
        name: str | None = None, **misplaced: object,
    ) -> None:  # fmt: skip
        self._records = _find_records(env)
        clocks = self._records.make_specs([0])[0].sensors
        values = estimator, outputs, std, replace, vehicle, options, name
        self._arguments = Arguments.read(clocks, *values, **misplaced)
        if self._arguments.is_object:
            text = f"one {self._arguments.label} cannot estimate {env.num_envs} rows"
            raise TypeError(f"{text}: pass its class, another factory or a name")
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            raise ValueError(f"the vector env must reset rows itself; its autoreset_mode is {mode}")
        self._calibration = np.ones((env.num_envs, 2, FAST_WIDTH))
        specs, arguments = self._make_specs(range(env.num_envs)), self._arguments
        self._first_vehicle, dt = specs[0].vehicle, self._records.dt
        self.estimator = build_batch(arguments.estimator, specs, dt, arguments.options)
        inner = getattr(env, "layout", self._records.layout)
        self._outputs = self._arguments.make_outputs(self.estimator.names, inner)
        self._set_layout(self._outputs.layout)
        self._out = np.zeros((env.num_envs, len(self.layout)), np.float32)

    def _restore_ended(self, ended_before: Mask | None, error: Exception) -> None:
        # such an env raises these before it moves any row
        if isinstance(self._records, BatchedRecords) and isinstance(error, TypeError | ValueError):
            self._ended = ended_before

    def get_state(self) -> Snapshot:
        """Return a snapshot for `set_state` as `VectorObservation.get_state` does."""
        memory = {"estimator": self.estimator.get_state(), "out": self._out.copy()}
        return super().get_state() | memory

    def set_state(self, snapshot: Snapshot) -> None:
        """Restore a snapshot as `VectorObservation.set_state` does."""
        super().set_state(snapshot)
        self._update_cars(range(self.num_envs))
        self.estimator.set_state(snapshot["estimator"])
        self._out[:] = snapshot["out"]

    def _make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        specs, car = self._records.make_specs(rows), self._arguments.vehicle
        if self._arguments.is_told_truth:
            truths = self._read_rows("car_truth", rows)
            self._calibration[rows] = [item.calibration for item in truths]
            pairs = zip(specs, truths, strict=True)
            return [spec.replace_vehicle(item.fiala) for spec, item in pairs]
        return specs if car is None else [spec.replace_vehicle(car) for spec in specs]

    def _update_cars(self, rows: Sequence[int]) -> None:
        """Fit the estimators of some rows to the cars of their present episodes."""
        specs = self._make_specs(rows)
        if not self._arguments.is_told_truth:
            self.estimator.configure(rows, specs)
            return
        first = self.estimator[0]
        cars = [choose_vehicle(first, self._first_vehicle, spec.vehicle) for spec in specs]
        pairs = zip(specs, cars, strict=True)
        self.estimator.configure(rows, [spec._replace(vehicle=car) for spec, car in pairs])
        for i, spec in zip(rows, specs, strict=True):
            set_stiffness(self.estimator[i], spec.vehicle)

    def _begin(self, mask: Mask) -> None:
        rows = np.flatnonzero(mask).tolist()
        if rows:
            self._update_cars(rows)
            self.estimator.reset(mask)

    def _append(self, obs: Observations, infos: Infos, mask: Mask) -> Observations:
        self._observe(self._records.read("", range(self.num_envs)), obs, infos, mask, self._out)
        return self._out.copy()

    def _finish(self, infos: Infos, ended: Mask) -> None:
        inner, out = self._outputs.table.inner, np.zeros_like(self._out)
        obs = np.zeros((self.num_envs, inner), np.float32)
        if inner > 0:
            obs[ended] = np.stack(infos["final_obs"][ended])
        indices = np.flatnonzero(ended).tolist()
        records = self._records.read("final_", indices)
        self._observe(records, obs, infos["final_info"], ended, out)
        for i in indices:
            infos["final_obs"][i] = out[i].copy()

    def _observe(
        self, records: StepRecord, obs: Observations, infos: Infos, mask: Mask,
        out: Observations,
    ) -> None:  # fmt: skip
        """Process the records of some rows; write their observations and their part of `infos`."""
        N, beta, gamma = self.num_envs, infos.get("beta"), infos.get("gamma")
        has_truth = beta is not None and gamma is not None
        truth: Any = (beta, gamma) if has_truth else (np.zeros(N), np.zeros(N))
        summary, inner = np.zeros((N, 4)), np.ascontiguousarray(obs, np.float32)
        observed = Observed(inner, self._outputs.table, truth[0], truth[1], out, summary)
        if self._arguments.is_told_truth:
            fast = calibrate(records.fast, self._calibration[:, None])
            records = records._replace(fast=fast)
        self.estimator.take(mask, records, observed)
        for key, index in self._outputs.keys:
            if index == NEES and not has_truth:
                continue
            values, present = summary[:, index].copy(), mask.copy()
            if index == NEES:  # the truth of some rows may be missing
                present &= infos.get("_beta", True)
                values[~present] = 0.0
            infos[key], infos[f"_{key}"] = values, present
            if index == BETA:
                self._records.annotate(self._outputs.title, values, summary[:, STD], mask)


def _find_records(env: AnyVectorEnv) -> SyncRecords | BatchedRecords:
    """Find the records; TypeError if anything in between may hide ticks from the estimators."""
    if not isinstance(env, VectorEnv):
        text = f"{type(env).__name__} is no vector environment; the wrapper of a single one"
        raise TypeError(f"{text} is sideslip.estimators.EstimateObservation")
    layer = env
    while isinstance(layer, VectorWrapper):
        if not isinstance(layer, EstimateObservation):
            text = "EstimateObservation must be the innermost wrapper, directly around the vector"
            raise TypeError(f"{text} environment; inside it is {type(layer).__name__}")
        layer = layer.env
    if isinstance(layer, AsyncVectorEnv):
        raise TypeError(
            "the records in AsyncVectorEnv's worker processes are out of reach; wrap each "
            "environment in its worker with sideslip.estimators.EstimateObservation: "
            "gym.make_vec(id, vectorization_mode='async', wrappers=[functools.partial("
            "EstimateObservation, estimator=...)]), or use vectorization_mode='sync'"
        )
    if isinstance(layer, SyncVectorEnv):
        return SyncRecords(layer)
    if missing := [name for name in BATCHED_MEMBERS if not hasattr(layer, name)]:
        text = "EstimateObservation reads the records of a sideslip vector environment"
        raise TypeError(f"{text}; {type(layer).__name__} has no {', '.join(missing)}")
    return BatchedRecords(layer)


class TruthObservation(VectorObservation):
    """`sideslip.estimators.wrappers.truth.TruthObservation` of all rows, with the same bits.

    It stands outside of `sideslip.estimators.vector.EstimateObservation`. A row has the parameters
    of its new car from the first observation of an episode on; `final_obs` holds the old one's.

    TypeError says that the env has no layout or no vehicles, ValueError that a name is unknown or
    stands twice, or that rows with states reset in the same step.

    Args:
        env: Vector environment of N rows with a `layout`.
        parameters: Names of `Vehicle`, appended as `true_<name>` in their units.
        states: Names of `TrueState`, appended as `<name>_hat` as if by an estimator without error.
    """

    def __init__(
        self, env: AnyVectorEnv, parameters: Sequence[str] = STIFFNESSES, states: Sequence[str] = ()
    ) -> None:
        super().__init__(env)
        refuse_stacked(env, type(self))
        if not hasattr(env, "layout"):
            text = f"{type(env).__name__} has no layout; wrap it in"
            raise TypeError(f"{text} sideslip.estimators.vector.EstimateObservation first")
        self._entries = TruthEntries(parameters, states, env.layout)
        self._set_layout(self._entries.layout)
        if self._same_step and states:
            raise ValueError("true states need autoreset_mode 'NextStep' or 'Disabled'")
        self._values = np.zeros((env.num_envs, len(parameters)), np.float32)
        shape = env.num_envs, 2, len(self._entries.columns)
        self._calibration: Observations = np.ones(shape, np.float32)
        self._ended = np.ones(env.num_envs, np.bool_)

    def _begin(self, mask: Mask) -> None:
        rows = np.flatnonzero(mask).tolist()
        for i, truth in zip(rows, self._read_rows("car_truth", rows), strict=True):
            self._values[i], self._calibration[i] = self._entries.read(truth)

    def _finish(self, infos: Infos, ended: Mask) -> None:
        for i in np.flatnonzero(ended):
            car = self._values[i], self._calibration[i]
            infos["final_obs"][i] = self._entries.append(infos["final_obs"][i], *car, None)

    def _append(self, obs: Observations, infos: Infos, mask: Mask) -> Observations:
        states = None
        if self._entries.states:
            states = np.array(self._read_rows("true_state", range(self.num_envs)))
        return self._entries.append(obs, self._values, self._calibration, states)

    def get_state(self) -> Snapshot:
        """Return a snapshot for `set_state` as `VectorObservation.get_state` does."""
        memory = {"values": self._values.copy(), "calibration": self._calibration.copy()}
        return super().get_state() | memory

    def set_state(self, snapshot: Snapshot) -> None:
        """Restore a snapshot as `VectorObservation.set_state` does."""
        super().set_state(snapshot)
        self._values = snapshot["values"].copy()
        self._calibration = snapshot["calibration"].copy()
