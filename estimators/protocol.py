"""The protocol of an estimator, a user's own one behind it, and the estimates of a record."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..envs.record import PACKET, Array, Log, Record
from ..envs.sensors.link import SlowSensor
from .design.options import FOREIGN_STATE, STATES


class UnobservableWarning(UserWarning):
    """A filter has a direction that its sensors cannot see."""


@dataclass(frozen=True)
class Estimates:
    """A filter's states at every row of a record."""

    time: Array  # s, shape (K,)
    x: Array  # states, shape (K, n)
    std: Array  # their standard deviations, shape (K, n)
    names: tuple[str, ...]  # of the n states
    nis: Array  # normalised innovation squared of each packet, shape (packets,); NaN without use

    def __getitem__(self, name: str) -> Array:
        """Return one state by name, shape (K,)."""
        return self.x[:, self.names.index(name)]


class EstimatorLike(Protocol):
    """A filter that `EstimateObservation` can run: one of `make_estimator`, or a user's own.

    Nothing is inherited from: a class with these five members will do. After `reset` and after
    every `step`, `x` and `P` are the estimate at the tick of the last fast row.
    """

    @property
    def names(self) -> Sequence[str]:
        """Names of the n states; "beta" and "gamma" are the sideslip angle and the yaw rate.

        States with a name of `design.options.STATES` are in that unit; others have the unit "-".
        """

    @property
    def x(self) -> npt.ArrayLike:
        """The estimate, shape (n,); NaN, which is passed on, means that the filter failed."""

    @property
    def P(self) -> npt.ArrayLike:
        """Its covariance, shape (n, n); a diagonal one where only standard deviations are known."""

    def reset(self, sensors: Mapping[str, SlowSensor], first: int, /) -> None:
        """Set the estimator back for a new episode.

        Args:
            sensors: Clock and link of each slow sensor in this episode, "camera" and "gps".
            first: Tick of the first fast row.
        """

    def step(self, rows: Array, packets: Array, /) -> None:
        """Process what the car's wires carried since the last call, in SI units; arrays are copies.

        Args:
            rows: Fast rows of k ticks in order, columns of `envs.record.Fast`, shape (k,
                FAST_WIDTH). Row j holds the inputs that acted from the tick before it to its own. k
                is 1 at the reset and 0 where the env refused an action.
            packets: Packets of slow sensors in these ticks, columns of `envs.record.Packet`,
                ordered by arrival, shape (count, PACKET_WIDTH). A packet that arrived at a tick
                follows that tick's row; its values are of the tick at which it was captured.
        """


EstimatorFactory = Callable[..., EstimatorLike]
"""What builds an estimator, a class or a function, called with keywords alone: `vehicle`, a
`Vehicle` as the filter believes it to be; `sensors`, the slow ones by name; `dt`, s of a tick;
`speed`, m/s where it is held and None where it is to be measured; and the user's options."""


class ForeignEstimator:
    """A user's estimator behind the names that it shares with `Estimator`, its states checked.

    Args:
        inner: User's object; TypeError without a member, ValueError if names are no distinct words.
        name: Name for messages.
        dt: Tick (s).
        sensors: Slow sensors of this episode by name.
    """

    unobservable: tuple[str, ...] = ()

    def __init__(
        self, inner: EstimatorLike, name: str, dt: float, sensors: Mapping[str, SlowSensor]
    ) -> None:
        if missing := [word for word in ("names", "reset", "step") if not hasattr(inner, word)]:
            text = f"{name} is no estimator: {type(inner).__name__} has no {', '.join(missing)}"
            raise TypeError(f"{text}; see sideslip.estimators.EstimatorLike")
        self.inner, self.name, self.dt, self.sensors = inner, name, dt, dict(sensors)
        self.names = () if isinstance(inner.names, str) else tuple(inner.names)
        are_words = all(isinstance(word, str) and word for word in self.names)
        if not (self.names and are_words and len(set(self.names)) == len(self.names)):
            raise ValueError(f"{name}: names are distinct words, one a state, got {inner.names!r}")
        self.units = tuple(STATES.get(state, FOREIGN_STATE).unit for state in self.names)

    def reset(self, sensors: Mapping[str, SlowSensor] | None = None, first: int = 0) -> None:
        """Reset as `EstimatorLike.reset` does.

        Args:
            sensors: Slow sensors by name; None keeps those of the last episode.
            first: Tick of the first fast row.
        """
        self.sensors = self.sensors if sensors is None else dict(sensors)
        self.inner.reset(self.sensors, first)

    def step(self, rows: Array, packets: Array) -> None:
        """Process copies of fast rows and packets as `EstimatorLike.step` does.

        Args:
            rows: Fast rows, shape (k, FAST_WIDTH).
            packets: Packets, shape (count, PACKET_WIDTH).
        """
        self.inner.step(np.array(rows, np.float64), np.array(packets, np.float64))

    @property
    def x(self) -> Array:
        """States now, shape (n,); another shape raises ValueError, no numbers TypeError."""
        return self._read_member("x", (len(self.names),))

    @property
    def P(self) -> Array:
        """Their present covariance, shape (n, n); errors as those of `x`."""
        return self._read_member("P", (len(self.names),) * 2)

    def _read_member(self, member: str, shape: tuple[int, ...]) -> Array:
        try:
            value = np.array(getattr(self.inner, member), np.float64)
        except (AttributeError, TypeError, ValueError) as error:
            raise TypeError(f"{self.name}: {member} is no array of numbers: {error}") from error
        if value.shape != shape:
            text = f"{self.name}: {member} has shape {shape} for the states {', '.join(self.names)}"
            raise ValueError(f"{text}, got {value.shape}")
        return value

    def run(self, source: Log | Record) -> Estimates:
        """Reset, then filter a whole record tick by tick, as `Estimator.run` does; NIS is NaN.

        Args:
            source: Record, or a log that has one; ValueError if it is empty or has another tick.
        """
        record = source.record if isinstance(source, Log) else source
        if len(record.fast) == 0 or abs(record.dt - self.dt) > 1e-9:
            built = f"{self.name} was built for ticks of {self.dt:g} s"
            raise ValueError(f"{built}, the record has {len(record.fast)} of {record.dt:g} s")
        self.reset(source.slow if isinstance(source, Log) else None, record.first)
        ends = np.searchsorted(record.packets[:, PACKET.arrived], record.ticks, "right").tolist()
        x, std = np.empty((2, len(record.fast), len(self.names)))
        for k, (start, end) in enumerate(zip([0, *ends], ends, strict=False)):
            self.step(record.fast[k : k + 1], record.packets[start:end])
            x[k], std[k] = self.x, compute_std(self.P)
        nis = np.full(len(record.packets), np.nan)
        return Estimates(np.asarray(record.ticks * record.dt, np.float64), x, std, self.names, nis)

    def get_state(self) -> EstimatorLike:
        """Return a deep copy of the user's object for `set_state`."""
        return copy.deepcopy(self.inner)

    def set_state(self, snapshot: EstimatorLike) -> None:
        """Replace `inner` by a copy of a snapshot.

        Args:
            snapshot: Result of `get_state`.
        """
        self.inner = copy.deepcopy(snapshot)

    def __repr__(self) -> str:
        return f"<{self.name}: {', '.join(self.names)}>"


def get_label(source: object) -> str:
    """Return the name of an estimator, or of its factory or class, for messages.

    Args:
        source: Name, factory or estimator.
    """
    if isinstance(source, str):
        return source
    name = getattr(source, "name", None)
    label = name if isinstance(name, str) else getattr(source, "__qualname__", None)
    return str(label or type(source).__name__)


def compute_std(P: Array) -> Array:
    """Compute the standard deviations (..., n) of covariances; NaN stays.

    Args:
        P: Covariances, shape (..., n, n).
    """
    variances: Array = np.einsum("...ii->...i", P)
    return np.sqrt(np.maximum(variances, 0.0))
