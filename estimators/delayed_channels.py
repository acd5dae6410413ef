"""Filters of late fast channels: by a known latency, or by one identified while driving.

A gyro that is late turns the predicted heading later than the camera or the GPS sees it turn. So
its latency is the one at which the slow packets' normalised innovations squared (NIS) are least.
The gyro's own innovations are left out: tyres that build up their force late look like a late gyro.
"""

import copy
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from ..envs.record import FAST_WIDTH, PACKET, PACKET_WIDTH, Array
from .core.filter import NO_OUTPUTS, FilterOutputs, StepRecord
from .core.memory import FILTER, FilterLayers
from .design.options import FAST_CHANNELS, FIND
from .design.periodic import count_ticks
from .estimator import Estimator, compile_advance
from .protocol import compute_std

_MAX_SEARCHED_LATENCY = 0.12  # s
_LOOK_TIMES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # s from where a stretch begins
_STEPS = (0.02, 0.01, 0.005)  # s between the latencies that are compared, ever closer
_MIN_LOG_RATIO = 8.0  # by which the logarithm of an accepted latency's likelihood is greater
_HISTORY_OFFSET: int = FILTER.fields["predicted"][1]  # type: ignore[index]  # where a memory's window begins, in bytes
_INDEX_COLUMN = PACKET_WIDTH  # column behind a packet's: its place in the call


def _align_rows(rows: Array, lags: dict[int, int]) -> Array:
    """Shift late columns of fast rows to when they were true, by lags (ticks); NaN at the end."""
    result = rows.copy()
    for column, lag in lags.items():
        split = max(len(rows) - lag, 0)
        result[:split, column], result[split:, column] = rows[lag:, column], np.nan
    return result


def _advance(filters: FilterLayers, gains: Array, fast: Array, packets: Array) -> Array:
    """Advance a filter by rows and packets; return the packets' NIS."""
    packets = np.ascontiguousarray(packets[:, :PACKET_WIDTH])
    record, nis = StepRecord(fast, len(fast), packets, len(packets)), np.full(len(packets), np.nan)
    compile_advance()(filters, gains, record, 0, NO_OUTPUTS._replace(nis=nis))
    return nis


class _LatencySearch:
    """Search for the latency of `columns` of a fast row: least NIS, its variance by a parabola."""

    def __init__(self, columns: tuple[int, ...], dt: float) -> None:
        self.columns, self.max_lag = columns, round(_MAX_SEARCHED_LATENCY / dt)
        if self.max_lag < 2:
            raise ValueError(
                f"a latency that is looked for is at most {_MAX_SEARCHED_LATENCY:g} s, of "
                f"which rows every {dt:g} s tell nothing: say the latency in s"
            )
        self._steps = [max(round(step / dt), 1) for step in _STEPS]
        self._looks = [round(look / dt) for look in _LOOK_TIMES]
        # latency in force and its standard deviation (ticks), whether no more looks are needed
        self.lag, self.sd, self.done = 0, np.inf, False

    def begin(self, filters: FilterLayers, rows: Array, packets: Array) -> None:
        """Begin a new stretch at a filter's memory, with what that has not taken yet."""
        self._start, self._rows, self._packets = filters.copy(), [rows], [packets]
        self._count = len(rows)

    @property
    def rows_until_look(self) -> int:
        """Number of rows until the next look."""
        return min(look for look in self._looks if look > self._count) - self._count

    def take(self, rows: Array, packets: Array) -> None:
        """Store rows, no further than the next look, and packets, as the memory takes them."""
        self._rows.append(rows)
        self._packets.append(packets)
        self._count += len(rows)

    def look(
        self, delayed_filters: FilterLayers, rows: Array, packets: Array, gains: Array
    ) -> FilterLayers:
        """Compare latencies where a look is due; return the memory for the latency in force."""
        if self._count in self._looks:
            delayed_filters = self._compare(delayed_filters, gains)
        if self._count == self._looks[-1] and not self.done:
            self.begin(delayed_filters, rows, packets)
        return delayed_filters

    def _compare(self, delayed_filters: FilterLayers, gains: Array) -> FilterLayers:
        rows = np.concatenate(self._rows)
        stretch = cache(partial(self._run_stretch, rows=rows, gains=gains))  # by lag
        lag, curvature, margin = self._minimise_nis(lambda lag: stretch(lag)[0])
        min_nis, count, memory = stretch(lag)
        scale = max(min_nis / max(count, 1), 1.0)
        limit = 2.0 * _MIN_LOG_RATIO * scale
        is_sharp, is_better = margin > limit, stretch(self.lag)[0] - min_nis > limit
        self.done = is_sharp and curvature > 0.0 and self._count == self._looks[-1]
        # the first step away from a latency that is surely wrong need not be to a sharp optimum
        if not curvature > 0.0 or not (is_sharp or (self.lag == 0 and is_better)):
            return delayed_filters
        self.sd = float(np.sqrt(2.0 * scale / curvature))
        if lag == self.lag or not (self.lag > 0 or is_better):
            return delayed_filters
        self.lag = lag
        return memory

    def _minimise_nis(self, sum_nis: Callable[[int], float]) -> tuple[int, float, float]:
        """Find the lag of least NIS, the second derivative there and the margin to distant lags."""
        max_lag, (coarse, *finer) = self.max_lag, self._steps
        grid = range(0, max_lag + 1, coarse)
        best, step = min(grid, key=sum_nis), coarse
        for step in finer:
            candidates = [lag for lag in (best - step, best, best + step) if 0 <= lag <= max_lag]
            best = min(candidates, key=sum_nis)
        middle_lag = min(max(best, step), max_lag - step)
        left, centre, right = (sum_nis(middle_lag + i * step) for i in (-1, 0, 1))
        curvature = max((left - 2.0 * centre + right) / step**2, 0.0)
        if curvature > 0.0:
            best = round(middle_lag - (right - left) / (2.0 * step * curvature))
            best = min(max(best, 0), max_lag)
        distant_nis = min(sum_nis(lag) for lag in grid if abs(lag - best) >= coarse)
        return best, curvature, distant_nis - sum_nis(best)

    def _run_stretch(self, lag: int, rows: Array, gains: Array) -> tuple[float, int, FilterLayers]:
        """Filter the stretch with a lag: sum of its packets' NIS, count of numbers, memory."""
        filters, count = self._start.copy(), len(rows) - self.max_lag
        fast = _align_rows(rows, dict.fromkeys(self.columns, lag))[:count]
        packets = np.concatenate(self._packets)
        packets = packets[packets[:, PACKET.arrived] <= filters[0].tick + count]
        nis = _advance(filters, gains, fast, packets)
        is_used = np.isfinite(nis)
        sensors = packets[is_used, PACKET.sensor].astype(int)
        return float(nis[is_used].sum()), int(filters[0].rows[sensors].sum()), filters


class LateEstimator(Estimator):
    """A filter with the option `latency`; arguments and methods are those of `Estimator`.

    `delayed_filters` is the filter at the time t - L of the latest channel, with every channel at
    the time when it was true. The estimate at t is a copy, propagated to t with all that has come.
    So it is the conditional mean of a linear system. A step costs L / dt ticks more.
    """

    compiled = False

    def _begin(self) -> None:
        """Reset the delayed filter; the search for a latency begins anew."""
        self.delayed_filters = self.filters.copy()
        self._rows, self._waiting = np.zeros((0, FAST_WIDTH)), np.zeros((0, _INDEX_COLUMN + 1))
        self._fixed_lags = dict[int, int]()
        self._search: _LatencySearch | None = None
        for channel, late in self.config.latency.items():
            if late == FIND:
                self._search = _LatencySearch(FAST_CHANNELS[channel], self.dt)
                self._search.begin(self.delayed_filters, self._rows, self._waiting)
                late = 0.0
            lag = count_ticks(float(late), self.dt, f"{self.name}: a latency of {channel}")
            self._fixed_lags |= dict.fromkeys(FAST_CHANNELS[channel], lag)

    @property
    def _lags(self) -> dict[int, int]:
        """Ticks by column."""
        search = self._search
        return self._fixed_lags | (dict.fromkeys(search.columns, search.lag) if search else {})

    def take(self, record: StepRecord, outputs: FilterOutputs = NO_OUTPUTS) -> None:
        """Process rows and packets; one that `delayed_filters` uses in a later call has no NIS.

        Args:
            record: Rows and packets.
            outputs: Arrays to fill.
        """
        (fast, rows, packets, count), (X, S, nis) = record, outputs
        remaining: Array = np.column_stack((packets[:count], np.arange(float(count))))
        self._waiting[:, _INDEX_COLUMN] = -1.0
        tick, start = self.tick, 0
        while start < rows or len(remaining):
            stop = min(start + 1, rows) if len(X) else rows
            if self._search and not self._search.done:
                stop = min(stop, start + self._search.rows_until_look)
            is_due = ~(remaining[:, PACKET.arrived] > tick + stop) | (stop == rows)
            self._update_delayed(fast[start:stop], remaining[is_due], tick + stop, nis)
            remaining = remaining[~is_due]
            if len(X) and stop > start:
                self._predict_current()
                X[start] = self.x
                S[start] = compute_std(self.P)
            start = stop
        if not len(X):
            self._predict_current()
        self.filters["counts"] = self.delayed_filters["counts"]

    def _update_delayed(self, fast: Array, packets: Array, now: int, nis: Array) -> None:
        """Process rows up to the tick `now`, and packets; `delayed_filters` takes what is due."""
        rows = np.concatenate((self._rows, fast))
        search = self._search if self._search and not self._search.done else None
        max_lag = max(*self._lags.values(), search.max_lag if search else 0)
        n_due = max(len(rows) - max_lag, 0)
        pending = np.concatenate((self._waiting, packets))
        arrived = pending[:, PACKET.arrived]
        # others are to be counted
        is_later = (arrived > now - len(rows) + n_due) & (arrived <= now)
        self._rows, self._waiting = rows[n_due:], pending[is_later]
        due, fast_due = pending[~is_later], _align_rows(rows, self._lags)[:n_due]
        due_nis = _advance(self.delayed_filters, self.gains, fast_due, due)
        if len(nis):
            is_new = due[:, _INDEX_COLUMN] >= 0.0
            nis[due[is_new, _INDEX_COLUMN].astype(int)] = due_nis[is_new]
        if search:
            search.take(fast, packets)
            record = self.delayed_filters, self._rows, self._waiting, self.gains
            self.delayed_filters[:] = search.look(*record)

    def _predict_current(self) -> None:
        """Propagate a copy of `delayed_filters` to the present tick, with what has come."""
        layers = self.filters, self.delayed_filters
        current, delayed = (f.view(np.uint8).reshape(len(f), -1) for f in layers)
        skip_history = self.config.delay == "clone" and self._f.stored == 0
        end = _HISTORY_OFFSET if skip_history else None
        current[:, :end] = delayed[:, :end]
        rows = _align_rows(self._rows, self._lags)
        _advance(self.filters, self.gains, rows, self._waiting)

    @property
    def latency(self) -> dict[str, float]:
        """Latency in force (s) by channel."""
        channels = self.config.latency
        return {channel: self._lags[FAST_CHANNELS[channel][0]] * self.dt for channel in channels}

    @property
    def latency_sd(self) -> float:
        """Standard deviation (s) of the unknown latency: infinite until found, 0 if none is."""
        return float(self._search.sd) * self.dt if self._search else 0.0

    def get_state(self) -> Any:
        """Return a snapshot as `Estimator.get_state` does."""
        state = self.filters, self.delayed_filters, self._rows, self._waiting, self._search
        return copy.deepcopy(state)

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot as `Estimator.set_state` does.

        Args:
            snapshot: Result of `get_state`.
        """
        filters, delayed_filters, self._rows, self._waiting, self._search = copy.deepcopy(snapshot)
        self.filters[:], self.delayed_filters[:] = filters, delayed_filters
