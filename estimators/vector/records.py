"""Where a batch of estimators finds the records of a vector env's cars."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv

from ...envs.record import FAST_WIDTH, PACKET_WIDTH
from ...envs.sensors.link import SlowSensor
from ...envs.task.observation import Entry
from ...envs.vehicle.vehicle import Vehicle
from ..wrappers.arguments import Setup, setup_of
from ..wrappers.estimate import base_of

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]


class Records(NamedTuple):
    """The records of N cars' newest step."""

    fast: Array  # (N, k, FAST_WIDTH)
    rows: Whole  # (N,), how many of them are there
    packets: Array  # (N, capacity, PACKET_WIDTH)
    counts: Whole  # (N,)


class Batched(Protocol):
    """What a vector env that steps all cars at once offers.

    slow_sensors, nominal and held_speed: of each car, (N,). The final_... ones are a row's record
    as it stood before its newest reset; they are read in the step that ended its episode.
    """

    rows: Array
    ticks_done: Whole
    packets: Array
    delivered: Whole
    final_rows: Array
    final_ticks_done: Whole
    final_packets: Array
    final_delivered: Whole
    slow_sensors: Sequence[Mapping[str, SlowSensor]]
    nominal: Sequence[Vehicle]
    held_speed: Sequence[float | None]
    layout: tuple[Entry, ...]
    dt: float


class BatchedRecords:
    """The records of a `Batched` env."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.layout: tuple[Entry, ...] = env.layout
        self.dt: float = env.dt

    def newest(self) -> Records:
        """Of the newest step, or of tick 0 where a car was reset."""
        env = self._env
        return _contiguous(env.rows, env.ticks_done, env.packets, env.delivered)

    def final(self, ended: npt.NDArray[np.bool_]) -> Records:
        """Of the last step of the episodes that ended in this step."""
        env = self._env
        return _contiguous(
            env.final_rows, env.final_ticks_done, env.final_packets, env.final_delivered
        )

    def setups(self, rows: Sequence[int]) -> list[Setup]:
        """What the env offers to the estimators of some rows."""
        env = self._env
        return [Setup(env.nominal[i], env.slow_sensors[i], env.held_speed[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: npt.NDArray[np.bool_]) -> None:
        """Estimates of some rows to draw beside the truth, by an env that draws."""
        if hasattr(self._env, "annotate"):
            self._env.annotate(label, beta, std, rows)


class SyncRecords:
    """The records of the environments in a `SyncVectorEnv`, copied into one array each."""

    def __init__(self, env: SyncVectorEnv[Any, Any]) -> None:
        self._bases = [base_of(each) for each in env.envs]
        layouts = [each.get_wrapper_attr("layout") for each in env.envs]
        for i, layout in enumerate(layouts):
            if layout != layouts[0]:
                raise ValueError(f"environment {i} of the vector env has another layout than 0")
        self.layout: tuple[Entry, ...] = layouts[0]
        self.dt: float = self._bases[0].dt
        N = len(self._bases)
        ticks = max(len(base.rows) for base in self._bases)
        capacity = max(len(base.packets) for base in self._bases)
        self._records = Records(
            np.zeros((N, ticks, FAST_WIDTH)),
            np.zeros(N, np.int64),
            np.zeros((N, capacity, PACKET_WIDTH)),
            np.zeros(N, np.int64),
        )

    def newest(self) -> Records:
        """Of the newest step, or of tick 0 where a car was reset."""
        fast, rows, packets, counts = self._records
        for i, base in enumerate(self._bases):
            n, m = base.ticks_done, base.delivered
            fast[i, :n], packets[i, :m] = base.rows[:n], base.packets[:m]
            rows[i], counts[i] = n, m
        return self._records

    def final(self, ended: npt.NDArray[np.bool_]) -> Records:
        """Of the last step of the episodes that ended in this step."""
        fast, rows, packets, counts = self._records
        for i in np.flatnonzero(ended):
            base = self._bases[i]
            n, m = base.final_ticks_done, base.final_delivered
            fast[i, :n], packets[i, :m] = base.final_rows[:n], base.final_packets[:m]
            rows[i], counts[i] = n, m
        return self._records

    def setups(self, rows: Sequence[int]) -> list[Setup]:
        """What the environments of some rows offer to their estimators."""
        return [setup_of(self._bases[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: npt.NDArray[np.bool_]) -> None:
        """Estimates of some rows to draw beside the truth."""
        for i in np.flatnonzero(rows):
            self._bases[i].annotate(label, float(beta[i]), float(std[i]))


def true_vehicles(base: Any, rows: Sequence[int]) -> list[Vehicle]:
    """The true vehicles that some rows of a bare vector env drive in this episode.

    Raises TypeError where they are out of reach.
    """
    if isinstance(base, SyncVectorEnv):
        return [base.envs[i].unwrapped.vehicle for i in rows]  # type: ignore[attr-defined]
    if not hasattr(base, "vehicle"):
        raise TypeError(f"{type(base).__name__} does not offer which vehicles its rows drive")
    return [base.vehicle[i] for i in rows]


def true_states(base: Any) -> Array:
    """The `TrueState` of every row of a bare vector env now; TypeError where out of reach."""
    if isinstance(base, SyncVectorEnv):
        return np.array([env.unwrapped.true_state for env in base.envs])  # type: ignore[attr-defined]
    if not hasattr(base, "true_state"):
        raise TypeError(f"{type(base).__name__} does not offer the true states of its rows")
    return np.asarray(base.true_state)


def _contiguous(fast: Any, rows: Any, packets: Any, counts: Any) -> Records:
    """Arrays as compiled code takes them, copied only where they are not."""
    return Records(
        np.ascontiguousarray(fast, np.float64),
        np.ascontiguousarray(rows, np.int64),
        np.ascontiguousarray(packets, np.float64),
        np.ascontiguousarray(counts, np.int64),
    )


def records_of(env: VectorEnv[Any, Any, Any]) -> SyncRecords | BatchedRecords:
    """The records of a bare vector env.

    Raises TypeError for workers, whose records are out of reach, and where there are no records.
    """
    if isinstance(env, AsyncVectorEnv):
        raise TypeError(
            "the records in AsyncVectorEnv's worker processes are out of reach; wrap each "
            "environment in its worker with sideslip.estimators.EstimateObservation: "
            "gym.make_vec(id, vectorization_mode='async', wrappers=[functools.partial("
            "EstimateObservation, estimator=...)]), or use vectorization_mode='sync'"
        )
    if isinstance(env, SyncVectorEnv):
        return SyncRecords(env)
    missing = [name for name in Batched.__annotations__ if not hasattr(env, name)]
    if missing:
        raise TypeError(
            "EstimateObservation reads the records of a sideslip vector environment; "
            f"{type(env).__name__} has no {', '.join(missing)}"
        )
    return BatchedRecords(env)


def state_of(env: Any) -> Any:
    """The snapshot of a vector env, wrapped or not; TypeError where it makes none."""
    if not hasattr(env, "get_state"):
        raise TypeError(
            f"{type(env).__name__} makes no snapshots; the vector env that gym.make_vec builds "
            "without a vectorization_mode does"
        )
    return env.get_state()
