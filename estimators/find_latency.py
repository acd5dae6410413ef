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
import numpy.typing as npt

from ..envs.record import PACKET, PACKET_WIDTH
from .entry import advance_entry

Array = npt.NDArray[np.float64]

LONGEST = 0.12  # s, of what is looked for
LOOKS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # s from where a stretch begins
STEPS = (0.02, 0.01, 0.005)  # s between the latencies that are compared, ever closer
SURE = 8.0  # of a logarithm of a likelihood ratio


def aligned(rows: Array, lags: dict[int, int]) -> Array:
    """Fast rows (k, FAST_WIDTH) with each late column (ticks by column) at the time when it was
    true; NaN where it has not come yet."""
    found = rows.copy()
    for column, lag in lags.items():
        split = max(len(rows) - lag, 0)
        found[:split, column], found[split:, column] = rows[lag:, column], np.nan
    return found


class Search:
    """A latency of some columns that is looked for. dt: s of a tick.

    `lag`: in force, ticks. `sd`: its standard deviation in ticks, infinite before it is known.
    `done`: whether it needs no more looks.
    """

    def __init__(self, columns: tuple[int, ...], dt: float) -> None:
        self.columns, self.longest = columns, round(LONGEST / dt)
        if self.longest < 2:
            raise ValueError(
                f"a latency that is looked for is at most {LONGEST:g} s, of which rows every "
                f"{dt:g} s tell nothing: say the latency in s"
            )
        self._steps = [max(round(step / dt), 1) for step in STEPS]
        self._looks = [round(look / dt) for look in LOOKS]
        self.lag, self.sd, self.done = 0, np.inf, False

    def begin(self, filters: Any, rows: Array, packets: Array) -> None:
        """A new stretch, from a memory on; rows, packets: those that it has not taken yet."""
        self._start, self._rows, self._packets = filters.copy(), [rows], [packets]
        self._count = len(rows)

    def until_look(self) -> int:
        """Rows until the next look."""
        return min(look for look in self._looks if look > self._count) - self._count

    def take(self, rows: Array, packets: Array) -> None:
        """More rows, no further than the next look, and packets, as the memory takes them."""
        self._rows.append(rows)
        self._packets.append(packets)
        self._count += len(rows)

    def look(self, behind: Any, rows: Array, packets: Array, gains: Any) -> Any:
        """The memory `behind`, or where another latency was found, what it would be with that one.

        rows, packets: those that it has not taken yet, with which a new stretch would begin.
        """
        if self._count in self._looks:
            behind = self._compare(behind, gains)
        if self._count == self._looks[-1] and not self.done:
            self.begin(behind, rows, packets)
        return behind

    def _compare(self, behind: Any, gains: Any) -> Any:
        rows, tried = np.concatenate(self._rows), dict[int, tuple[float, int, Any]]()

        def surprise(lag: int) -> float:
            if lag not in tried:
                tried[lag] = self._filtered(lag, rows, gains)
            return tried[lag][0]

        lag, bend, margin = self._least(surprise)
        least, count, memory = tried[lag]
        scale = max(least / max(count, 1), 1.0)
        sure = margin > 2.0 * SURE * scale and bend > 0.0
        self.done = sure and self._count == self._looks[-1]
        if not sure:
            return behind
        self.sd = float(np.sqrt(2.0 * scale / bend))
        better = self.lag > 0 or surprise(self.lag) - least > 2.0 * SURE * scale
        if lag == self.lag or not better:
            return behind
        self.lag = lag
        return memory

    def _least(self, surprise: Any) -> tuple[int, float, float]:
        """The lag that surprises least, the second derivative there (0: none), and by how much
        less than the best that is far from it."""
        longest, (coarse, *finer) = self.longest, self._steps
        grid = range(0, longest + 1, coarse)
        best, step = min(grid, key=surprise), coarse
        for step in finer:
            near = [lag for lag in (best - step, best, best + step) if 0 <= lag <= longest]
            best = min(near, key=surprise)
        middle = min(max(best, step), longest - step)
        left, here, right = (surprise(middle + i * step) for i in (-1, 0, 1))
        bend = max((left - 2.0 * here + right) / step**2, 0.0)
        if bend > 0.0:
            best = round(middle - (right - left) / (2.0 * step * bend))
            best = min(max(best, 0), longest)
        far = min(surprise(lag) for lag in grid if abs(lag - best) >= coarse)
        return best, bend, far - surprise(best)

    def _filtered(self, lag: int, rows: Array, gains: Any) -> tuple[float, int, Any]:
        """The stretch with a lag: the sum of its packets' NIS, of how many numbers, the memory."""
        filters, count = self._start.copy(), len(rows) - self.longest
        fast = aligned(rows, dict.fromkeys(self.columns, lag))[:count]
        packets = np.concatenate(self._packets)[:, :PACKET_WIDTH]
        here = packets[:, PACKET.arrived] <= filters[0].tick + count
        packets = np.ascontiguousarray(packets[here])
        nis, nothing = np.full(len(packets), np.nan), np.zeros((0, 0))
        record = fast, count, packets, len(packets), 0, nothing, nothing, nis
        advance_entry()(filters, gains, *record)
        used = np.isfinite(nis)
        sensors = packets[used, PACKET.sensor].astype(int)
        return float(nis[used].sum()), int(filters[0].rows[sensors].sum()), filters
