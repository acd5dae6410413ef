"""The latency of a fast channel, found while driving.

A gyro that is late turns the predicted heading later than the camera or the GPS sees it turn: so
the latency is the one with which the filter's packets surprise it least. The record is filtered
with several latencies, each from where the stretch began, and a parabola through the sums of the
packets' normalised innovations squared has the latency and its variance. The innovations of the
gyro itself are left out: tyres that build up their force late look like a gyro that is late.

A log that cannot tell is left alone: an estimate counts where every latency that is far from it is
less likely by a factor of e^8, and so is the one in force.
"""

from typing import Any

import numpy as np

from ..envs.record import PACKET, PACKET_WIDTH, Array
from .entry import compile_advance

MAX_SEARCHED_LATENCY = 0.12  # s, of what is looked for
LOOK_TIMES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # s from where a stretch begins
STEPS = (0.02, 0.01, 0.005)  # s between the latencies that are compared, ever closer
MIN_LOG_RATIO = 8.0  # of a logarithm of a likelihood ratio


def align_rows(rows: Array, lags: dict[int, int]) -> Array:
    """Shift each late column of fast rows to the time when it was true.

    Args:
        rows: Fast rows, shape (k, FAST_WIDTH).
        lags: Latency (ticks) by column.

    Returns:
        Aligned rows, shape (k, FAST_WIDTH); NaN where a value has not come yet.
    """
    result = rows.copy()
    for column, lag in lags.items():
        split = max(len(rows) - lag, 0)
        result[:split, column], result[split:, column] = rows[lag:, column], np.nan
    return result


class LatencySearch:
    """Search for the latency of some columns.

    Args:
        columns: Columns of the fast row that are late together.
        dt: Tick (s).

    Attributes:
        lag: Latency in force (ticks).
        sd: Its standard deviation (ticks), infinite before it is known.
        done: Whether it needs no more looks.

    Raises:
        ValueError: The tick is too long to find a latency.
    """

    def __init__(self, columns: tuple[int, ...], dt: float) -> None:
        self.columns, self.max_lag = columns, round(MAX_SEARCHED_LATENCY / dt)
        if self.max_lag < 2:
            raise ValueError(
                f"a latency that is looked for is at most {MAX_SEARCHED_LATENCY:g} s, of "
                f"which rows every {dt:g} s tell nothing: say the latency in s"
            )
        self._steps = [max(round(step / dt), 1) for step in STEPS]
        self._looks = [round(look / dt) for look in LOOK_TIMES]
        self.lag, self.sd, self.done = 0, np.inf, False

    def begin(self, filters: Any, rows: Array, packets: Array) -> None:
        """Begin a new stretch at a filter's memory.

        Args:
            filters: Memory of the filter, shape (layers,).
            rows: Fast rows that it has not taken yet, shape (k, FAST_WIDTH).
            packets: Packets that it has not taken yet, one a row.
        """
        self._start, self._rows, self._packets = filters.copy(), [rows], [packets]
        self._count = len(rows)

    def count_until_look(self) -> int:
        """Return the number of rows until the next look."""
        return min(look for look in self._looks if look > self._count) - self._count

    def take(self, rows: Array, packets: Array) -> None:
        """Store rows, no further than the next look, and packets, as the memory takes them.

        Args:
            rows: Fast rows, shape (k, FAST_WIDTH).
            packets: Packets, one a row.
        """
        self._rows.append(rows)
        self._packets.append(packets)
        self._count += len(rows)

    def look(self, delayed_filters: Any, rows: Array, packets: Array, gains: Any) -> Any:
        """Compare latencies where a look is due.

        Args:
            delayed_filters: Memory of the filter, shape (layers,).
            rows: Fast rows that it has not taken yet; a new stretch begins with them.
            packets: Packets that it has not taken yet.
            gains: Tables of gains, shape (cells, rows, columns).

        Returns:
            `delayed_filters`, or the memory for another latency that was found.
        """
        if self._count in self._looks:
            delayed_filters = self._compare(delayed_filters, gains)
        if self._count == self._looks[-1] and not self.done:
            self.begin(delayed_filters, rows, packets)
        return delayed_filters

    def _compare(self, delayed_filters: Any, gains: Any) -> Any:
        rows, results = np.concatenate(self._rows), dict[int, tuple[float, int, Any]]()

        def sum_nis(lag: int) -> float:
            if lag not in results:
                results[lag] = self._filter_stretch(lag, rows, gains)
            return results[lag][0]

        lag, curvature, margin = self._minimise_nis(sum_nis)
        min_nis, count, memory = results[lag]
        scale = max(min_nis / max(count, 1), 1.0)
        is_significant = margin > 2.0 * MIN_LOG_RATIO * scale and curvature > 0.0
        self.done = is_significant and self._count == self._looks[-1]
        if not is_significant:
            return delayed_filters
        self.sd = float(np.sqrt(2.0 * scale / curvature))
        is_better = self.lag > 0 or sum_nis(self.lag) - min_nis > 2.0 * MIN_LOG_RATIO * scale
        if lag == self.lag or not is_better:
            return delayed_filters
        self.lag = lag
        return memory

    def _minimise_nis(self, sum_nis: Any) -> tuple[int, float, float]:
        """Find the lag of least NIS, the second derivative there (0: none), and its margin.

        The margin is to the best lag that is far from it.
        """
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

    def _filter_stretch(self, lag: int, rows: Array, gains: Any) -> tuple[float, int, Any]:
        """Filter the stretch with a lag: sum of its packets' NIS, count of numbers, memory."""
        filters, count = self._start.copy(), len(rows) - self.max_lag
        fast = align_rows(rows, dict.fromkeys(self.columns, lag))[:count]
        packets = np.concatenate(self._packets)[:, :PACKET_WIDTH]
        is_past = packets[:, PACKET.arrived] <= filters[0].tick + count
        packets = np.ascontiguousarray(packets[is_past])
        nis, empty = np.full(len(packets), np.nan), np.zeros((0, 0))
        record = fast, count, packets, len(packets), 0, empty, empty, nis
        compile_advance()(filters, gains, *record)
        is_used = np.isfinite(nis)
        sensors = packets[is_used, PACKET.sensor].astype(int)
        return float(nis[is_used].sum()), int(filters[0].rows[sensors].sum()), filters
