"""EstimateObservation for vector environments: all rows' estimators in one compiled call."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.task.observation import Entry, space_of
from ...envs.vehicle.vehicles import VehicleSource
from ..wrappers.arguments import Arguments, Setup, Source
from ..wrappers.estimate import EstimateObservation as Single
from ..wrappers.outputs import BETA, NEES, STD, outputs_of, titled
from ..wrappers.truth import as_built, set_stiffness
from .make import batch_of
from .records import BatchedRecords, Records, SyncRecords, records_of, state_of, true_vehicles
from .spec import vector_spec

Observations = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Step = tuple[Observations, Any, Any, Any, dict[str, Any]]


class EstimateObservation(
    VectorWrapper[Observations, Any, Observations, Any, Any], RecordConstructorArgs
):
    """Runs an estimator on each car's record and appends its states to the observations.

    `sideslip.estimators.EstimateObservation` of all rows, with the same arguments: every row gets
    the bits that the single wrapper would give it. It must be the innermost wrapper; others of its
    class may be stacked, each with its own `name`. It works on `SyncVectorEnv` and on a vector env
    that offers what `records.Batched` lists. A factory is called once for each row, and again
    where a row's car changes; one object cannot serve them all.

    A row whose episode ended starts a new one with a fresh filter: in the next step, or within
    the step that ended it, where the old filter first takes the last record into `final_obs`. As
    the environments do, `infos` has arrays (N,) of `beta_hat`, `beta_std` and `nees` with masks.

    `layout` describes a row; `estimator` is the `BatchEstimator` at work. `spec` names the single
    wrapper: `gym.make_vec(spec)` builds environments that are wrapped one by one.

    Raises TypeError if it is not the innermost wrapper, the records are out of reach or the
    estimator is an object; ValueError for an unknown output, where names would stand twice, or
    without autoreset.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        estimator: Source | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: VehicleSource | None = None,
        options: Mapping[str, Any] | None = None,
        name: str | None = None,
        **misplaced: Any,
    ) -> None:
        self._records = _records_below(env)
        clocks = self._records.setups([0])[0].sensors
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
        setups = self._setups(range(env.num_envs))
        self._built = setups[0].vehicle
        dt = self._records.dt
        self.estimator = batch_of(arguments.source, setups, dt, arguments.options)
        inner = () if replace else getattr(env, "layout", self._records.layout)
        states = self.estimator.names
        self._outputs = outputs_of(arguments.label, states, outputs, std, name, inner)
        self._title = titled(arguments.label, name)
        self.layout: tuple[Entry, ...] = self._outputs.layout
        self.single_observation_space = space_of(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._out = np.zeros((env.num_envs, len(self.layout)), np.float32)
        self._ended: Mask | None = None  # rows that the next step resets; None: all are to be reset

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # as in VectorWrapper
        """The env's with the single wrapper; JSON-able, None where the env has none."""
        return vector_spec(self.env.spec, Single, self._saved_kwargs)

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
        try:
            obs, infos = self.env.reset(seed=seed, options=options)
        except (TypeError, ValueError):
            self._keep(before)
            raise
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
            self._keep(before)
            raise
        ended = np.logical_or(terminated, truncated)
        if not self._same_step:
            self._restart(before)
        elif ended.any():
            self._finish(infos, ended)
            self._restart(ended)
        everyone = np.ones(self.num_envs, np.bool_)
        self._observe(self._records.newest(), obs, infos, everyone, self._out)
        self._ended = ended
        return self._out.copy(), rewards, terminated, truncated, infos

    def _keep(self, before: Mask | None) -> None:
        """After what the inner env refused: a `Batched` one does before it moves any row."""
        if isinstance(self._records, BatchedRecords):
            self._ended = before

    def get_state(self) -> dict[str, Any]:
        """A snapshot of env and estimators that `set_state` continues from, bit for bit.

        Raises TypeError where the vector env makes none.
        """
        return {
            "env": state_of(self.env),
            "estimator": self.estimator.get_state(),
            "out": self._out.copy(),
            "ended": None if self._ended is None else self._ended.copy(),
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Go back to a snapshot of this env or of one built with the same arguments."""
        env: Any = self.env
        env.set_state(snapshot["env"])
        self._configure(range(self.num_envs))
        self.estimator.set_state(snapshot["estimator"])
        self._out[:], ended = snapshot["out"], snapshot["ended"]
        self._ended = None if ended is None else ended.copy()

    def _setups(self, rows: Sequence[int]) -> list[Setup]:
        """What the estimators of some rows are built for."""
        setups = self._records.setups(rows)
        if self._arguments.truth:
            cars = true_vehicles(self.unwrapped, rows)
            return [each._replace(vehicle=car) for each, car in zip(setups, cars, strict=True)]
        if self._arguments.vehicle is None:
            return setups
        return [each._replace(vehicle=self._arguments.vehicle) for each in setups]

    def _configure(self, rows: Sequence[int]) -> None:
        """Fit the estimators of some rows to the cars of their present episodes."""
        setups = self._setups(rows)
        if not self._arguments.truth:
            self.estimator.configure(rows, setups)
            return
        first = self.estimator[0]
        cars = [as_built(first, self._built, each.vehicle) for each in setups]
        built = zip(setups, cars, strict=True)
        self.estimator.configure(rows, [each._replace(vehicle=car) for each, car in built])
        for i, each in zip(rows, setups, strict=True):
            set_stiffness(self.estimator[i], each.vehicle)

    def _restart(self, mask: Mask) -> None:
        """Reset the estimators of some rows with the clocks of their new episodes."""
        rows = np.flatnonzero(mask).tolist()
        if rows:
            self._configure(rows)
            self.estimator.reset(mask)

    def _finish(self, infos: dict[str, Any], ended: Mask) -> None:
        """Take the last record of the rows that ended into their `final_obs` and `final_info`."""
        inner, out = self._outputs.inner, np.zeros_like(self._out)
        obs = np.zeros((self.num_envs, inner), np.float32)
        if inner > 0:
            obs[ended] = np.stack(infos["final_obs"][ended])
        self._observe(self._records.final(ended), obs, infos["final_info"], ended, out)
        for i in np.flatnonzero(ended):
            infos["final_obs"][i] = out[i].copy()

    def _observe(
        self,
        records: Records,
        obs: Observations,
        infos: dict[str, Any],
        mask: Mask,
        out: Observations,
    ) -> None:
        """Take the records of some rows; write their observations and their part of `infos`."""
        outputs, N = self._outputs, self.num_envs
        beta, gamma = infos.get("beta"), infos.get("gamma")
        known = beta is not None and gamma is not None
        truth = (beta, gamma) if known else (np.zeros(N), np.zeros(N))
        summary, inner = np.zeros((N, 3)), np.ascontiguousarray(obs, np.float32)
        what = inner, outputs.inner, outputs.plan, outputs.limits, *truth, out, summary
        self.estimator.take(mask, *records, *what)
        for key, place in outputs.keys:
            if place == NEES and not known:
                continue
            values, present = summary[:, place].copy(), mask.copy()
            if place == NEES:  # the truth of some rows may be missing
                present &= infos.get("_beta", True)
                values[~present] = 0.0
            infos[key], infos[f"_{key}"] = values, present
            if place == BETA:
                self._records.annotate(self._title, values, summary[:, STD], mask)


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
