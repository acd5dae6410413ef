"""Observations of vector environments: all rows' estimates in one compiled call, or the truth."""

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper

from ...envs.record import FAST_WIDTH, PACKET_WIDTH, Array
from ...envs.task import Infos, ObservationEntry
from ...envs.vehicle.parameters import VehicleSource
from ..core.filter import Observed, StepRecord
from ..filters import FILTERS
from ..make import make_estimator
from ..protocol import EstimatorFactory, ForeignEstimator, get_label
from ..wrappers.estimate import (
    BETA,
    NEES,
    STD,
    Arguments,
    EstimatorSource,
    EstimatorSpec,
    find_base_env,
    make_spec,
    replace_body,
)
from ..wrappers.truth import (
    STIFFNESSES,
    TruthEntries,
    calibrate,
    choose_vehicle,
    refuse_stacked,
    set_stiffness,
)
from .batch import BatchEstimator, ForeignBatch
from .records import AnyVectorEnv, Mask, Observations, Snapshot, VectorObservation

_MEMBERS = ("rows", "ticks_done", "packets", "delivered")  # of a `StepRecord` in the env
_BATCHED_MEMBERS = (
    *_MEMBERS,
    *(f"final_{name}" for name in _MEMBERS),  # before a car's newest reset
    *("slow_sensors", "nominal", "held_speed"),  # of each car, as those of a single env
    *("layout", "dt"),
)
"""What a vector env that steps all cars at once offers."""


class _BatchedRecords:
    """The records of a vector env that offers `_BATCHED_MEMBERS`."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.layout: tuple[ObservationEntry, ...] = env.layout
        self.dt: float = env.dt

    def read(self, prefix: str, rows: Iterable[int]) -> StepRecord:
        """Return the newest step's records, or with "final_" those of episodes that just ended."""
        arrays = (getattr(self._env, prefix + name) for name in _MEMBERS)
        types = (np.float64, np.int64) * 2
        records: Any = map(np.ascontiguousarray, arrays, types)  # copied where they are not
        return StepRecord(*records)

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        env = self._env
        cars = {i: replace_body(env.nominal[i], env.scenario[i]) for i in rows}
        return [EstimatorSpec(cars[i], env.slow_sensors[i], env.held_speed[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: Mask) -> None:
        """Pass estimates (rad) of some rows to an env that draws, beside the truth."""
        if hasattr(self._env, "annotate"):
            self._env.annotate(label, beta, std, rows)


class _SyncRecords:
    """The records of the environments in a `SyncVectorEnv`, copied into one array each."""

    def __init__(self, env: SyncVectorEnv[Any, Any]) -> None:
        self._bases = bases = [find_base_env(sub_env) for sub_env in env.envs]
        layouts = [sub_env.get_wrapper_attr("layout") for sub_env in env.envs]
        for i, layout in enumerate(layouts):
            if layout != layouts[0]:
                raise ValueError(f"environment {i} of the vector env has another layout than 0")
        self.layout: tuple[ObservationEntry, ...] = layouts[0]
        self.dt: float = bases[0].dt
        N = len(bases)
        fast = np.zeros((N, max(len(base.rows) for base in bases), FAST_WIDTH))
        packets = np.zeros((N, max(len(base.packets) for base in bases), PACKET_WIDTH))
        self._records = StepRecord(fast, np.zeros(N, np.int64), packets, np.zeros(N, np.int64))

    def read(self, prefix: str, rows: Iterable[int]) -> StepRecord:
        """Copy the records of some environments, those before a reset with "final_"."""
        records = self._records
        for i in rows:
            ticks, n, arrived, m = (getattr(self._bases[i], prefix + name) for name in _MEMBERS)
            records.fast[i, :n], records.packets[i, :m] = ticks[:n], arrived[:m]
            records.rows[i], records.count[i] = n, m
        return records

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        return [make_spec(self._bases[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: Mask) -> None:
        """Pass estimates (rad) of some rows to the envs that draw."""
        for i in np.flatnonzero(rows):
            self._bases[i].annotate(label, float(beta[i]), float(std[i]))


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
        self,
        env: AnyVectorEnv,
        estimator: EstimatorSource | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: VehicleSource | None = None,
        options: Mapping[str, object] | None = None,
        name: str | None = None,
        **misplaced: object,
    ) -> None:
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
        self.estimator = _build_batch(arguments.estimator, specs, dt, arguments.options)
        inner = getattr(env, "layout", self._records.layout)
        self._outputs = self._arguments.make_outputs(self.estimator.names, inner)
        self._set_layout(self._outputs.layout)
        self._out = np.zeros((env.num_envs, len(self.layout)), np.float32)

    def _restore_ended(self, ended_before: Mask | None, error: Exception) -> None:
        # such an env raises these before it moves any row
        if isinstance(self._records, _BatchedRecords) and isinstance(error, TypeError | ValueError):
            self._ended = ended_before

    def _get_memory(self) -> Snapshot:
        return {"estimator": self.estimator.get_state(), "out": self._out.copy()}

    def _set_memory(self, snapshot: Snapshot) -> None:
        self._update_cars(range(self.num_envs))
        self.estimator.set_state(snapshot["estimator"])
        self._out[:] = snapshot["out"]

    def _make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        specs, car = self._records.make_specs(rows), self._arguments.vehicle
        if self._arguments.is_told_truth:
            truths = self._get_truths(rows)
            self._calibration[rows] = [item.calibration for item in truths]
            pairs = zip(specs, truths, strict=True)
            return [spec._replace(vehicle=item.fiala) for spec, item in pairs]
        return specs if car is None else [spec._replace(vehicle=car) for spec in specs]

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


def _build_batch(
    source: str | EstimatorFactory, specs: Sequence[EstimatorSpec], dt: float,
    options: Mapping[str, Any],
) -> BatchEstimator:  # fmt: skip
    """Build an estimator for each spec, compiled together where all are ours and none is late."""
    build_one = functools.partial(make_estimator, source, dt=dt, **options)
    if not (isinstance(source, str) and source in FILTERS) or options.get("latency"):
        first = build_one(**specs[0]._asdict())
        if isinstance(first, ForeignEstimator):
            batch_class = getattr(first.inner, "batch", ForeignBatch)
            return batch_class(first, specs, dt, build_one)
        if not first.compiled:
            return ForeignBatch(first, specs, dt, build_one)
    return BatchEstimator(get_label(source), specs, dt, build_one)


def _find_records(env: AnyVectorEnv) -> _SyncRecords | _BatchedRecords:
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
        return _SyncRecords(layer)
    if missing := [name for name in _BATCHED_MEMBERS if not hasattr(layer, name)]:
        text = "EstimateObservation reads the records of a sideslip vector environment"
        raise TypeError(f"{text}; {type(layer).__name__} has no {', '.join(missing)}")
    return _BatchedRecords(layer)


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
        self,
        env: AnyVectorEnv,
        parameters: Sequence[str] = STIFFNESSES,
        states: Sequence[str] = (),
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
        rows = np.flatnonzero(mask)
        for i, truth in zip(rows, self._get_truths(rows.tolist()), strict=True):
            self._values[i], self._calibration[i] = self._entries.read(truth)

    def _finish(self, infos: Infos, ended: Mask) -> None:
        for i in np.flatnonzero(ended):
            car = self._values[i], self._calibration[i]
            infos["final_obs"][i] = self._entries.append(infos["final_obs"][i], *car, None)

    def _append(self, obs: Observations, infos: Infos, mask: Mask) -> Observations:
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

    def _get_memory(self) -> Snapshot:
        return {"values": self._values.copy(), "calibration": self._calibration.copy()}

    def _set_memory(self, snapshot: Snapshot) -> None:
        self._values = snapshot["values"].copy()
        self._calibration = snapshot["calibration"].copy()
