"""EstimateObservation for vector environments: all rows' estimators in one compiled call."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.record import FAST_WIDTH, PACKET_WIDTH, Array
from ...envs.task import ObservationEntry, make_space
from ...envs.vehicle.parameters import VehicleSource
from ..wrappers.estimate import (
    Arguments,
    EstimatorSource,
    EstimatorSpec,
    find_base_env,
    make_spec,
)
from ..wrappers.estimate import EstimateObservation as Single
from ..wrappers.outputs import BETA, NEES, STD, make_outputs
from ..wrappers.truth import choose_vehicle, set_stiffness
from .make import build_batch
from .records import BatchedEnv, IntArray, get_env_state, get_true_vehicles, make_vector_spec

_Observations = npt.NDArray[np.float32]
_Mask = npt.NDArray[np.bool_]
_Step = tuple[_Observations, Any, Any, Any, dict[str, Any]]


class _RecordBatch(NamedTuple):
    """The records of N cars' newest step."""

    fast: Array  # (N, k, FAST_WIDTH)
    rows: IntArray  # (N,), how many of them are there
    packets: Array  # (N, capacity, PACKET_WIDTH)
    counts: IntArray  # (N,)


_MEMBERS = ("rows", "ticks_done", "packets", "delivered")  # of a `_RecordBatch` in the env


class _BatchedRecords:
    """The records of a `BatchedEnv`."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.layout: tuple[ObservationEntry, ...] = env.layout
        self.dt: float = env.dt

    def read(self, prefix: str, rows: Iterable[int]) -> _RecordBatch:
        """Return the newest step's records, or with "final_" those of episodes that just ended."""
        arrays = (getattr(self._env, prefix + name) for name in _MEMBERS)
        types = (np.float64, np.int64) * 2
        records: Any = map(np.ascontiguousarray, arrays, types)  # copied where they are not
        return _RecordBatch(*records)

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        env = self._env
        return [EstimatorSpec(env.nominal[i], env.slow_sensors[i], env.held_speed[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: _Mask) -> None:
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
        self._records = _RecordBatch(fast, np.zeros(N, np.int64), packets, np.zeros(N, np.int64))

    def read(self, prefix: str, rows: Iterable[int]) -> _RecordBatch:
        """Copy the records of some environments, those before a reset with "final_"."""
        records = self._records
        for i in rows:
            ticks, n, arrived, m = (getattr(self._bases[i], prefix + name) for name in _MEMBERS)
            records.fast[i, :n], records.packets[i, :m] = ticks[:n], arrived[:m]
            records.rows[i], records.counts[i] = n, m
        return records

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        return [make_spec(self._bases[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: _Mask) -> None:
        """Pass estimates (rad) of some rows to the envs that draw."""
        for i in np.flatnonzero(rows):
            self._bases[i].annotate(label, float(beta[i]), float(std[i]))


class EstimateObservation(
    VectorWrapper[_Observations, Any, _Observations, Any, Any], RecordConstructorArgs
):
    """Runs an estimator on each car's record and appends its states to the observations.

    `sideslip.estimators.EstimateObservation` of all rows, with the same arguments: every row gets
    the bits that the single wrapper would give it. It must be the innermost wrapper; others of its
    class may be stacked, each with its own `name`. It works on `SyncVectorEnv` and on a vector env
    that offers what `records.BatchedEnv` lists.

    A row whose episode ended starts a new one with a fresh filter: in the next step, or within
    the step that ended it, where the old filter first takes the last record into `final_obs`. As
    the environments do, `infos` has arrays (N,) of `beta_hat`, `beta_std` and `nees` with masks.

    `layout` describes a row; `estimator` is the `BatchEstimator` at work. `spec` names the single
    wrapper: `gym.make_vec(spec)` builds environments that are wrapped one by one.

    Args:
        env: Vector environment of N rows.
        estimator: Name, entry point or factory. A factory is called once for each row, and again
            where a row's car changes. None for `choose_estimator` of the env's sensors.
        outputs: States to append, each as `<state>_hat`.
        std: Whether each one's standard deviation is appended as `<state>_std`.
        replace: Whether the observation is these alone.
        vehicle: Vehicle as estimators believe it to be; None: each row's nominal, "truth": its own.
        options: Options of `make_estimator`.
        name: Put before every name as `<name>_`.
        **misplaced: Refused; the message names the nearest argument or option.

    Raises:
        TypeError: It is not innermost, records are out of reach, or the estimator is one object.
        ValueError: An output is unknown, names would stand twice, or there is no autoreset.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        estimator: EstimatorSource | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: VehicleSource | None = None,
        options: Mapping[str, Any] | None = None,
        name: str | None = None,
        **misplaced: Any,
    ) -> None:
        self._records = _find_records(env)
        clocks = self._records.make_specs([0])[0].sensors
        self._arguments = arguments = Arguments(
            estimator, outputs, std, replace, vehicle, options, name, clocks, misplaced
        )
        if arguments.object is not None:
            raise TypeError(
                f"one {arguments.label} cannot estimate {env.num_envs} rows: pass its class, "
                "another factory or a name"
            )
        RecordConstructorArgs.__init__(self, **arguments.recorded)
        VectorWrapper.__init__(self, env)
        mode = env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            raise ValueError(f"the vector env must reset rows itself; its autoreset_mode is {mode}")
        self._same_step = mode == AutoresetMode.SAME_STEP
        specs = self._make_specs(range(env.num_envs))
        self._first_vehicle = specs[0].vehicle
        dt = self._records.dt
        self.estimator = build_batch(arguments.source, specs, dt, arguments.options)
        inner = () if replace else getattr(env, "layout", self._records.layout)
        states, label = self.estimator.names, arguments.label
        self._outputs = make_outputs(label, states, outputs, std, name, inner)
        self._title = label if name is None else f"{label} ({name})"
        self.layout: tuple[ObservationEntry, ...] = self._outputs.layout
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._out = np.zeros((env.num_envs, len(self.layout)), np.float32)
        # rows that the next step resets; None: all are to be reset
        self._ended: _Mask | None = None

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # as in VectorWrapper
        """The env's spec with the single wrapper; JSON-able, None where the env has none."""
        return make_vector_spec(self.env.spec, Single, self._saved_kwargs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[_Observations, dict[str, Any]]:
        """Reset the rows (those of options["reset_mask"]) and their estimators; take tick 0.

        Args:
            seed: Seed of row 0, or a list (N,); see `gymnasium.vector.VectorEnv.reset`.
            options: Options of the env.

        Returns:
            Observations and infos.

        Raises:
            ResetNeeded: A mask leaves out rows, and no step succeeded since the last whole reset.
        """
        mask = None if options is None else options.get("reset_mask")
        rows = np.ones(self.num_envs, np.bool_) if mask is None else np.array(mask)
        ended_before, self._ended = self._ended, None
        if ended_before is None and not rows.all():
            raise ResetNeeded(
                "reset all rows first: no step succeeded since then, or none was made"
            )
        try:
            obs, infos = self.env.reset(seed=seed, options=options)
        except (TypeError, ValueError):
            self._restore_ended(ended_before)
            raise
        self._ended = (
            np.zeros(self.num_envs, np.bool_) if ended_before is None else ended_before & ~rows
        )
        self._reset_rows(rows)
        records = self._records.read("", range(self.num_envs))
        self._observe(records, obs, infos, rows, self._out)
        return self._out.copy(), infos

    def step(self, actions: Any) -> _Step:
        """Step all rows; the estimators take their records before observations are made.

        Args:
            actions: Actions of all rows.

        Returns:
            Observations, rewards, terminations, truncations and infos.

        Raises:
            ResetNeeded: It is called before `reset`, or after a step that failed.
        """
        ended_before, self._ended = self._ended, None  # an error on the way leaves rows apart
        if ended_before is None:
            raise ResetNeeded(
                "call reset() first: before the first step, and after one that failed"
            )
        try:
            obs, rewards, terminated, truncated, infos = self.env.step(actions)
        except ValueError:
            self._restore_ended(ended_before)
            raise
        ended = np.logical_or(terminated, truncated)
        if not self._same_step:
            self._reset_rows(ended_before)
        elif ended.any():
            self._finish(infos, ended)
            self._reset_rows(ended)
        records, all_rows = self._records.read("", range(self.num_envs)), np.ones_like(ended)
        self._observe(records, obs, infos, all_rows, self._out)
        self._ended = ended
        return self._out.copy(), rewards, terminated, truncated, infos

    def _restore_ended(self, ended_before: _Mask | None) -> None:
        """Restore the flags after an error: a `BatchedEnv` raises it before it moves any row."""
        if isinstance(self._records, _BatchedRecords):
            self._ended = ended_before

    def get_state(self) -> dict[str, Any]:
        """Return a snapshot of env and estimators; TypeError where the vector env makes none."""
        return {
            "env": get_env_state(self.env),
            "estimator": self.estimator.get_state(),
            "out": self._out.copy(),
            "ended": None if self._ended is None else self._ended.copy(),
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        env: Any = self.env
        env.set_state(snapshot["env"])
        self._update_cars(range(self.num_envs))
        self.estimator.set_state(snapshot["estimator"])
        self._out[:], ended = snapshot["out"], snapshot["ended"]
        self._ended = None if ended is None else ended.copy()

    def _make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        specs = self._records.make_specs(rows)
        if self._arguments.truth:
            cars = get_true_vehicles(self.unwrapped, rows)
            return [spec._replace(vehicle=car) for spec, car in zip(specs, cars, strict=True)]
        if self._arguments.vehicle is None:
            return specs
        return [spec._replace(vehicle=self._arguments.vehicle) for spec in specs]

    def _update_cars(self, rows: Sequence[int]) -> None:
        """Fit the estimators of some rows to the cars of their present episodes."""
        specs = self._make_specs(rows)
        if not self._arguments.truth:
            self.estimator.configure(rows, specs)
            return
        first = self.estimator[0]
        cars = [choose_vehicle(first, self._first_vehicle, spec.vehicle) for spec in specs]
        pairs = zip(specs, cars, strict=True)
        self.estimator.configure(rows, [spec._replace(vehicle=car) for spec, car in pairs])
        for i, spec in zip(rows, specs, strict=True):
            set_stiffness(self.estimator[i], spec.vehicle)

    def _reset_rows(self, mask: _Mask) -> None:
        """Reset the estimators of some rows with the clocks of their new episodes."""
        rows = np.flatnonzero(mask).tolist()
        if rows:
            self._update_cars(rows)
            self.estimator.reset(mask)

    def _finish(self, infos: dict[str, Any], ended: _Mask) -> None:
        """Process the last record of rows that ended into their `final_obs` and `final_info`."""
        inner, out = self._outputs.inner, np.zeros_like(self._out)
        obs = np.zeros((self.num_envs, inner), np.float32)
        if inner > 0:
            obs[ended] = np.stack(infos["final_obs"][ended])
        indices = np.flatnonzero(ended).tolist()
        records = self._records.read("final_", indices)
        self._observe(records, obs, infos["final_info"], ended, out)
        for i in indices:
            infos["final_obs"][i] = out[i].copy()

    def _observe(
        self,
        records: _RecordBatch,
        obs: _Observations,
        infos: dict[str, Any],
        mask: _Mask,
        out: _Observations,
    ) -> None:
        """Process the records of some rows; write their observations and their part of `infos`."""
        outputs, N = self._outputs, self.num_envs
        beta, gamma = infos.get("beta"), infos.get("gamma")
        has_truth = beta is not None and gamma is not None
        truth = (beta, gamma) if has_truth else (np.zeros(N), np.zeros(N))
        summary, inner = np.zeros((N, 3)), np.ascontiguousarray(obs, np.float32)
        observe_args = inner, outputs.inner, outputs.plan, outputs.limits, *truth, out, summary
        self.estimator.take(mask, *records, *observe_args)
        for key, index in outputs.keys:
            if index == NEES and not has_truth:
                continue
            values, present = summary[:, index].copy(), mask.copy()
            if index == NEES:  # the truth of some rows may be missing
                present &= infos.get("_beta", True)
                values[~present] = 0.0
            infos[key], infos[f"_{key}"] = values, present
            if index == BETA:
                self._records.annotate(self._title, values, summary[:, STD], mask)


def _find_records(env: VectorEnv[Any, Any, Any]) -> _SyncRecords | _BatchedRecords:
    """Find the records; TypeError if anything in between may hide ticks from the estimators."""
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
    if isinstance(layer, AsyncVectorEnv):
        raise TypeError(
            "the records in AsyncVectorEnv's worker processes are out of reach; wrap each "
            "environment in its worker with sideslip.estimators.EstimateObservation: "
            "gym.make_vec(id, vectorization_mode='async', wrappers=[functools.partial("
            "EstimateObservation, estimator=...)]), or use vectorization_mode='sync'"
        )
    if isinstance(layer, SyncVectorEnv):
        return _SyncRecords(layer)
    missing = [name for name in BatchedEnv.__annotations__ if not hasattr(layer, name)]
    if missing:
        raise TypeError(
            "EstimateObservation reads the records of a sideslip vector environment; "
            f"{type(layer).__name__} has no {', '.join(missing)}"
        )
    return _BatchedRecords(layer)
