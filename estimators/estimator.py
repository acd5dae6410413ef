"""A filter at work: the compiled memory of a Kalman filter or observer as a Python object."""

import itertools
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ..envs.numerics.jit import compile_call
from ..envs.record import FAST, FAST_WIDTH, PACKET, PACKET_WIDTH, Array, Log, Record
from ..envs.sensors.link import SlowSensor
from ..envs.sensors.slow import SLOW_NAMES
from .core.filter import (
    NO_OUTPUTS,
    FilterOutputs,
    StepRecord,
    advance,
    reset_filters,
    write_estimate,
)
from .core.memory import FILTER, FilterLayers, FilterMemory, SkipCounters
from .core.update import is_healthy
from .design import periodic
from .design.options import STATES, FilterConfig
from .design.periodic import MARGINAL, Schedule, allocate_gains, count_ticks, spectral_radius
from .protocol import Estimates, UnobservableWarning

CHECKED_SPEEDS = (3.0, 7.0, 14.0)  # m/s, where a filter without a fixed speed is checked


@cache
def compile_advance() -> Callable[..., int]:
    """Return `core.filter.advance` as a plain call with the same positional arguments."""
    filters, gains, matrix = np.zeros(1, FILTER), np.zeros((1, 1, 1)), np.zeros((1, 1))
    record, outputs = StepRecord(matrix, 0, matrix, 0), FilterOutputs(matrix, matrix, matrix[0])
    return compile_call(advance, filters, gains, record, 0, outputs)


@cache
def _compile_write_estimate() -> Callable[..., bool]:
    filters, gains, matrix = np.zeros(1, FILTER), np.zeros((1, 1, 1)), np.zeros((1, 1))
    return compile_call(write_estimate, filters, gains, matrix[0], matrix)


class Estimator:
    """A filter at work; built by `make_estimator`.

    Args:
        config: Parsed options of the filter.
        dt: Tick (s).
        filters: Memory of the filter, dtype `FILTER`, shape (layers,).
        schedules: Schedules of the samples; the last one has the gains in use.

    Attributes:
        name: Name of the filter.
        names: Names of its n states; `units` has their units.
        gains: Tables of gains, shape (cells, rows, columns), as compiled code takes them.
        unobservable: Directions that its sensors cannot see.
        spectral_radius: Spectral radius of its error over a cycle.
        compiled: Whether compiled code may run it by `filters` and `gains` alone.
    """

    compiled = True

    def __init__(
        self, config: FilterConfig, dt: float, filters: Any, schedules: tuple[Schedule, ...]
    ) -> None:
        self.config, self.name, self.dt = config, config.name, dt
        self.names = config.states
        self.units = tuple(STATES[state].unit for state in self.names)
        self.sensors = dict(config.sensors)
        self.filters, self._schedules = filters, schedules
        self.gains = allocate_gains(self._f, schedules[-1])
        self.spectral_radius = 0.0
        self.unobservable: tuple[str, ...] = ()
        self.reset()

    @property
    def _f(self) -> FilterMemory:
        return self.filters[0]

    @property
    def needs(self) -> tuple[str, ...]:
        """The fast columns that a record must have."""
        columns = {int(c) for f in self.filters for c in f.u_column[: f.inputs, 0]}
        columns |= {int(c) for f in self.filters for c in f.y_column[: f.fasts, 0]}
        # a log without them had no yaw moment and a straight road
        columns -= {FAST.torque_left, FAST.torque_right, FAST.curvature}
        if any(f.velocity > 0.0 for f in self.filters):
            columns.add(FAST.gyro)
        if self._f.measured and (self._f.planar > 0 or self._f.velocity > 0.0):
            columns.add(FAST.wheel_left)
        return tuple(FAST._fields[column] for column in sorted(columns))

    def check(self, filters: FilterLayers) -> None:
        """Check that the filter converges, ValueError if not, and warn of what it cannot see.

        Args:
            filters: Its memory, or that of the same filter with its first slow sensor alone.
        """
        first = 0
        for f in filters:
            names = self.names[first : first + int(f.n)]
            speeds = CHECKED_SPEEDS if f.measured else (float(f.speed),)
            for speed, schedule in itertools.product(speeds, self._schedules):
                M = self._design_table(f, schedule, speed)[1]
                radius = spectral_radius(M)
                self.spectral_radius = max(radius, self.spectral_radius)
                if abs(radius - 1.0) <= MARGINAL and not self.unobservable:
                    self.unobservable = periodic.find_unobservable(M, names)
            first += int(f.n)
        if self.unobservable:
            text = f"{self.name} cannot see: {'; '.join(self.unobservable)}"
            warnings.warn(text, UnobservableWarning, stacklevel=3)

    def _design_table(self, f: FilterMemory, schedule: Schedule, v: float) -> tuple[Array, Array]:
        """Compute the table of gains at a speed and the error's map; ValueError if that grows."""
        try:
            table, M = periodic.design_and_map(f, schedule, v, self.config)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None
        radius = spectral_radius(M)
        if radius > 1.0 + MARGINAL and not self.config.allow_unstable:
            raise ValueError(
                f"{self.name}: its error grows by a factor of {radius:.6g} over a cycle of the "
                f"schedule at {v:g} m/s (allow_unstable=True builds it all the same)"
            )
        return table, M

    def design_missing(self) -> None:
        """Compute the table of gains that compiled code has just asked for."""
        self._design_cell(int(self._f.missing_cell))

    def _design_cell(self, cell: int) -> None:
        f = self._f
        speed = float(f.low + cell * f.spacing) if f.measured else float(f.speed)
        self.gains[cell] = self._design_table(f, self._schedules[-1], speed)[0]

    def reset(self, sensors: Mapping[str, SlowSensor] | None = None, first: int = 0) -> None:
        """Set the filter back to its prior.

        Args:
            sensors: Slow sensors by name; ValueError if more than a phase is new; None keeps all.
            first: Tick of the next fast row.
        """
        for name, sensor in self.sensors.items():
            new = sensor if sensors is None else sensors.get(name)
            if new is None or replace(new, phase=0.0) != replace(sensor, phase=0.0):
                built = f"{self.name} was built for the {name} {sensor}"
                raise ValueError(f"{built}, the reset has {new}")
            label = f"{self.name}: the {name}'s phase"
            phase = count_ticks(new.phase or 0.0, self.dt, label)
            for f in self.filters:
                f.phase[SLOW_NAMES.index(name)] = f.origin = phase
        reset_filters(self.filters, first)
        self._begin()

    def _begin(self) -> None:
        """Reset what a subclass has beside `filters`."""

    def step(self, fast: Array, packets: Array) -> None:
        """Process fast rows and packets, which follow the last ones taken.

        Args:
            fast: Fast rows, shape (k, FAST_WIDTH).
            packets: Packets ordered as in a `Record`, shape (count, PACKET_WIDTH).
        """
        fast, packets = (np.ascontiguousarray(array, np.float64) for array in (fast, packets))
        tables = ("fast rows", fast, FAST_WIDTH), ("packets", packets, PACKET_WIDTH)
        for label, array, width in tables:
            if array.shape[1:] != (width,):
                raise ValueError(f"{label} have shape (k, {width}), got {array.shape}")
        self.take(StepRecord(fast, len(fast), packets, len(packets)))

    def take(self, record: StepRecord, outputs: FilterOutputs = NO_OUTPUTS) -> None:
        """Process rows and packets as `step` does, without any checks.

        Args:
            record: Rows and packets, C-contiguous float64.
            outputs: Arrays to fill.
        """
        done = compile_advance()(self.filters, self.gains, record, 0, outputs)
        while done < record.rows:
            self.design_missing()
            done = compile_advance()(self.filters, self.gains, record, done, outputs)

    def predict(self, fast_row: npt.ArrayLike) -> None:
        """Process one fast row: from the last tick to this one, with the gyro.

        Args:
            fast_row: Fast row of this tick, shape (FAST_WIDTH,).
        """
        self.step(np.asarray(fast_row)[None], np.zeros((0, PACKET_WIDTH)))

    def update(self, packet: npt.ArrayLike) -> None:
        """Process one packet that has arrived, after the fast row of this tick.

        Args:
            packet: Packet, shape (PACKET_WIDTH,).
        """
        self.step(np.zeros((0, FAST_WIDTH)), np.asarray(packet)[None])

    def run(self, source: Log | Record) -> Estimates:
        """Reset, then filter a whole record; errors as in `prepare_record`.

        Args:
            source: Record, or a log that has one.
        """
        return self.run_with_health(source, math.inf)[0]

    def run_with_health(
        self, source: Log | Record, seconds: float
    ) -> tuple[Estimates, npt.NDArray[np.bool_]]:
        """Run as `run` does; return also at every row whether it is healthy at the next look.

        Args:
            source: Record, or a log that has one.
            seconds: Time between two looks (s), the last one at the end.
        """
        record = self.prepare_record(source)
        fast, packets = (np.ascontiguousarray(a, np.float64) for a in (record.fast, record.packets))
        X, S = np.empty((2, len(fast), len(self.names)))
        healthy, nis = np.empty(len(fast), np.bool_), np.full(len(packets), np.nan)
        block = max(round(min(seconds, len(fast) * self.dt) / self.dt), 1)
        starts = np.arange(0, len(fast), block)
        places = np.searchsorted(packets[:, PACKET.arrived], record.first + starts[1:])
        for start, first, last in zip(starts, [0, *places], [*places, len(packets)], strict=True):
            now, due = slice(start, start + block), slice(first, last)
            part = StepRecord(fast[now], len(fast[now]), packets[due], len(packets[due]))
            self.take(part, FilterOutputs(X[now], S[now], nis[due]))
            healthy[now] = self.is_healthy
        time = np.asarray(record.ticks * record.dt, np.float64)
        return Estimates(time, X, S, self.names, nis), healthy

    def prepare_record(self, source: Log | Record) -> Record:
        """Reset for a record and return it; ValueError where rows, tick or columns do not fit.

        Args:
            source: Record, or a log that has one.
        """
        record = source.record if isinstance(source, Log) else source
        if len(record.fast) == 0:
            raise ValueError(f"{self.name}: the record is empty")
        if abs(record.dt - self.dt) > 1e-9:
            built = f"{self.name} was built for ticks of {self.dt:g} s"
            raise ValueError(f"{built}, the record has {record.dt:g} s")
        for column in self.needs:
            if column not in record.present:
                raise ValueError(f"{self.name} needs the column {column!r}, the log has none")
        self.reset(source.slow if isinstance(source, Log) else None, record.first)
        return record

    def get_state(self) -> Any:
        """Return a snapshot, from which `set_state` restores every bit."""
        return self.filters.copy()

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this estimator or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        self.filters[:] = snapshot

    @property
    def x(self) -> Array:
        """The present states, shape (n,)."""
        return self._read_estimate(0)[0]

    @property
    def P(self) -> Array:
        """Their present covariance, shape (n, n); with periodic gains that of the settled cycle."""
        return self._read_estimate(len(self.names))[1]

    def _read_estimate(self, width: int) -> tuple[Array, Array]:
        """Read the states (n,) and their covariance (width, width): width is n, or 0 for none."""
        x, P = np.empty(len(self.names)), np.zeros((width, width))
        while not _compile_write_estimate()(self.filters, self.gains, x, P):
            self._design_cell(int(self._f.cell))
        return x, P

    @property
    def tick(self) -> int:
        """Tick of the last fast row; one before the first if there was none yet."""
        return int(self._f.tick)

    @property
    def counts(self) -> dict[str, int]:
        """All counters of what was skipped, by the names of `core.memory.SkipCounters`."""
        return dict(zip(SkipCounters._fields, map(int, self._f.counts), strict=True))

    @property
    def is_healthy(self) -> bool:
        """Whether innovations are about as large as expected; False for a filter that is lost.

        Filters whose noise is fixed (`noise_time=0`) keep no account of it and say True.
        """
        return bool(is_healthy(self._f))

    @property
    def nis(self) -> float:
        """NIS of the last packet; NaN where it was not used, or the gains are precomputed."""
        return float(self._f.nis)

    def __repr__(self) -> str:
        return f"<{self.name}: {', '.join(self.names)} at tick {self.tick}>"
