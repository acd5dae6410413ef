"""Records of a vector env's cars, as a batch of estimators reads them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium.vector import SyncVectorEnv

from ...envs.record import FAST_WIDTH, PACKET_WIDTH, Array
from ...envs.sensors.link import SlowSensor
from ...envs.task import ObservationEntry
from ...envs.vehicle.parameters import Vehicle
from ..wrappers.estimate import EstimatorSpec, find_base_env, make_spec

IntArray = npt.NDArray[np.int64]


class RecordBatch(NamedTuple):
    """The records of N cars' newest step."""

    fast: Array  # (N, k, FAST_WIDTH)
    rows: IntArray  # (N,), how many of them are there
    packets: Array  # (N, capacity, PACKET_WIDTH)
    counts: IntArray  # (N,)


class BatchedEnv(Protocol):
    """The members of a vector env that steps all cars at once.

    The final_... ones are a row's record before its newest reset. They are read in the step that
    ended its episode.
    """

    rows: Array  # fast rows, (N, k, FAST_WIDTH)
    ticks_done: IntArray  # number of fast rows of each car, (N,)
    packets: Array  # (N, capacity, PACKET_WIDTH)
    delivered: IntArray  # number of packets of each car, (N,)
    final_rows: Array
    final_ticks_done: IntArray
    final_packets: Array
    final_delivered: IntArray
    slow_sensors: Sequence[Mapping[str, SlowSensor]]  # of each car, by name
    nominal: Sequence[Vehicle]  # of each car
    held_speed: Sequence[float | None]  # m/s, of each car where it is held
    layout: tuple[ObservationEntry, ...]  # of a row's observation
    dt: float  # tick (s)


class BatchedRecords:
    """The records of a `BatchedEnv`.

    Args:
        env: The vector environment.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self.layout: tuple[ObservationEntry, ...] = env.layout
        self.dt: float = env.dt

    def read_latest(self) -> RecordBatch:
        """Return the records of the newest step, or of tick 0 where a car was reset."""
        env = self._env
        return _make_contiguous(env.rows, env.ticks_done, env.packets, env.delivered)

    def read_final(self, ended: npt.NDArray[np.bool_]) -> RecordBatch:
        """Return the records of the last step of the episodes that ended in this step.

        Args:
            ended: Rows whose episode ended, shape (N,).

        Returns:
            Records of all rows, valid in those that ended.
        """
        env = self._env
        return _make_contiguous(
            env.final_rows, env.final_ticks_done, env.final_packets, env.final_delivered
        )

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators.

        Args:
            rows: Indices of the rows.

        Returns:
            Nominal vehicle, slow sensors and held speed of each.
        """
        env = self._env
        return [EstimatorSpec(env.nominal[i], env.slow_sensors[i], env.held_speed[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: npt.NDArray[np.bool_]) -> None:
        """Pass estimates of some rows to an env that draws, beside the truth.

        Args:
            label: Title of the estimates.
            beta: Estimated sideslip angles (rad), shape (N,).
            std: Their standard deviations (rad), shape (N,).
            rows: Rows to draw, shape (N,).
        """
        if hasattr(self._env, "annotate"):
            self._env.annotate(label, beta, std, rows)


class SyncRecords:
    """The records of the environments in a `SyncVectorEnv`, copied into one array each.

    Args:
        env: The vector environment.

    Raises:
        ValueError: Its environments have different layouts.
    """

    def __init__(self, env: SyncVectorEnv[Any, Any]) -> None:
        self._bases = [find_base_env(sub_env) for sub_env in env.envs]
        layouts = [sub_env.get_wrapper_attr("layout") for sub_env in env.envs]
        for i, layout in enumerate(layouts):
            if layout != layouts[0]:
                raise ValueError(f"environment {i} of the vector env has another layout than 0")
        self.layout: tuple[ObservationEntry, ...] = layouts[0]
        self.dt: float = self._bases[0].dt
        N = len(self._bases)
        fast = np.zeros((N, max(len(base.rows) for base in self._bases), FAST_WIDTH))
        packets = np.zeros((N, max(len(base.packets) for base in self._bases), PACKET_WIDTH))
        self._records = RecordBatch(fast, np.zeros(N, np.int64), packets, np.zeros(N, np.int64))

    def read_latest(self) -> RecordBatch:
        """Return the records of the newest step as `BatchedRecords.read_latest` does."""
        return self._copy(range(len(self._bases)), "")

    def read_final(self, ended: npt.NDArray[np.bool_]) -> RecordBatch:
        """Return the last records of ended episodes as `BatchedRecords.read_final` does."""
        return self._copy(np.flatnonzero(ended).tolist(), "final_")

    def _copy(self, indices: Iterable[int], prefix: str) -> RecordBatch:
        """Copy the records of some environments, those before a reset with "final_"."""
        fast, rows, packets, counts = self._records
        for i in indices:
            names = ("rows", "ticks_done", "packets", "delivered")
            ticks, n, arrived, m = (getattr(self._bases[i], prefix + name) for name in names)
            fast[i, :n], packets[i, :m] = ticks[:n], arrived[:m]
            rows[i], counts[i] = n, m
        return self._records

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators as `BatchedRecords.make_specs` does."""
        return [make_spec(self._bases[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, rows: npt.NDArray[np.bool_]) -> None:
        """Pass estimates to the envs that draw as `BatchedRecords.annotate` does."""
        for i in np.flatnonzero(rows):
            self._bases[i].annotate(label, float(beta[i]), float(std[i]))


def get_true_vehicles(base: Any, rows: Sequence[int]) -> list[Vehicle]:
    """Return the true vehicles of some rows in this episode.

    Args:
        base: Vector environment without wrappers.
        rows: Indices of the rows.

    Returns:
        Vehicle of each of these rows.

    Raises:
        TypeError: The vehicles are out of reach.
    """
    if isinstance(base, SyncVectorEnv):
        return [base.envs[i].unwrapped.vehicle for i in rows]  # type: ignore[attr-defined]
    if not hasattr(base, "vehicle"):
        raise TypeError(f"{type(base).__name__} does not offer which vehicles its rows drive")
    return [base.vehicle[i] for i in rows]


def _make_contiguous(fast: Any, rows: Any, packets: Any, counts: Any) -> RecordBatch:
    """Make arrays as compiled code takes them, copied only where they are not."""
    fast, packets = (np.ascontiguousarray(a, np.float64) for a in (fast, packets))
    rows, counts = (np.ascontiguousarray(a, np.int64) for a in (rows, counts))
    return RecordBatch(fast, rows, packets, counts)


def get_env_state(env: Any) -> Any:
    """Return the snapshot of a vector env.

    Args:
        env: Vector environment, wrapped or not.

    Returns:
        The snapshot.

    Raises:
        TypeError: The vector env makes none.
    """
    if not hasattr(env, "get_state"):
        raise TypeError(
            f"{type(env).__name__} makes no snapshots; the vector env that gym.make_vec builds "
            "without a vectorization_mode does"
        )
    return env.get_state()
