"""An estimator some of whose fast channels are late: by a known time, or by one that it finds."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..envs.record import FAST_WIDTH, PACKET, PACKET_WIDTH
from ..envs.sensors.link import SlowSensor
from .core.memory import FILTER
from .design.config import FilterConfig
from .design.options import FIND, columns_of
from .design.schedule import Schedule, whole_ticks
from .entry import advance_entry, receive_entry
from .estimator import EMPTY, NO_NIS, Array, Estimator
from .find_latency import Search, aligned
from .protocol import deviations

_HISTORY: int = FILTER.fields["predicted"][1]  # type: ignore[index]  # where a memory's window begins, in bytes
_PLACE = PACKET_WIDTH  # column behind a packet's: its place in the call


class LateEstimator(Estimator):
    """A filter with the option `latency`; built by `make_estimator`.

    `behind`, a memory, is the filter at the time t - L of the latest channel, with every channel at
    the time when it was true. The estimate at t is a copy of it that goes on to t with what is
    known by then: the inputs, channels that are less late, the packets. So it is the conditional
    mean of a linear system, as without latencies. A step costs L / dt ticks more.

    `latency`: s by channel in force; `latency_sd`: s, of the one that is looked for, infinite
    while it is not known and the channel is taken as punctual.
    """

    compiled = False

    def __init__(
        self, config: FilterConfig, dt: float, filters: Any, schedules: tuple[Schedule, ...]
    ) -> None:
        self._known, self._found = dict[int, int](), ""
        for channel, late in config.latency.items():
            if late == FIND:
                self._found, late = channel, 0.0
            lag = whole_ticks(float(late), dt, f"{config.name}: a latency of {channel}")
            self._known |= dict.fromkeys(columns_of(channel), lag)
        super().__init__(config, dt, filters, schedules)

    def reset(self, sensors: Mapping[str, SlowSensor] | None = None, first: int = 0) -> None:
        """As `Estimator.reset`; a latency is looked for anew."""
        super().reset(sensors, first)
        self.behind = self.filters.copy()
        self._rows, self._waiting = np.zeros((0, FAST_WIDTH)), np.zeros((0, _PLACE + 1))
        self._search = Search(columns_of(self._found), self.dt) if self._found else None
        if self._search:
            self._search.begin(self.behind, self._rows, self._waiting)

    @property
    def _lags(self) -> dict[int, int]:
        """Ticks by column."""
        found = self._search
        return self._known | (dict.fromkeys(found.columns, found.lag) if found else {})

    @property
    def _longest(self) -> int:
        """Ticks by which `behind` is behind."""
        search = self._search
        return max(*self._lags.values(), search.longest if search and not search.done else 0)

    def _receive(self, packet: Array) -> None:
        self.take(np.zeros((0, FAST_WIDTH)), 0, packet[None], 1)

    def _step(self, fast: Array, packets: Array, count: int) -> None:
        self.take(fast, len(fast), packets, count)

    def take(
        self,
        fast: Array,
        rows: int,
        packets: Array,
        count: int,
        X: Array = EMPTY,
        S: Array = EMPTY,
        nis: Array = NO_NIS,
    ) -> None:
        """As `Estimator.take`; a packet that `behind` uses in a later call has no NIS."""
        left: Array = np.column_stack((packets[:count], np.arange(float(count))))
        self._waiting[:, _PLACE] = -1.0
        tick, start = self.tick, 0
        while start < rows or len(left):
            stop = min(start + 1, rows) if len(X) else rows
            if self._search and not self._search.done:
                stop = min(stop, start + self._search.until_look())
            here = ~(left[:, PACKET.arrived] > tick + stop) | (stop == rows)
            self._move(fast[start:stop], left[here], tick + stop, nis)
            left = left[~here]
            if len(X) and stop > start:
                self._go_ahead()
                X[start] = self.x
                S[start] = deviations(self.P)
            start = stop
        if not len(X):
            self._go_ahead()
        self.filters["counts"] = self.behind["counts"]

    def _move(self, fast: Array, packets: Array, now: int, nis: Array) -> None:
        """Take rows up to the tick `now`, and packets: `behind` what is due there."""
        rows = np.concatenate((self._rows, fast))
        due = max(len(rows) - self._longest, 0)
        came = np.concatenate((self._waiting, packets))
        arrived = came[:, PACKET.arrived]
        later = (arrived > now - len(rows) + due) & (arrived <= now)  # others are to be counted
        self._rows, self._waiting = rows[due:], came[later]
        self._pass_on(aligned(rows, self._lags)[:due], came[~later], nis)
        if self._search and not self._search.done:
            self._search.take(fast, packets)
            self.behind[:] = self._search.look(self.behind, self._rows, self._waiting, self.gains)

    def _pass_on(self, fast: Array, handed: Array, nis: Array) -> None:
        """Rows and packets to `behind`."""
        packets, own = np.ascontiguousarray(handed[:, :_PLACE]), np.full(len(handed), np.nan)
        if len(fast):
            record = fast, len(fast), packets, len(packets), 0, EMPTY, EMPTY, own
            advance_entry()(self.behind, self.gains, *record)
        else:
            for packet in packets:
                receive_entry()(self.behind, self.gains, packet)
        if len(nis):
            new = handed[:, _PLACE] >= 0.0
            nis[handed[new, _PLACE].astype(int)] = own[new]

    def _go_ahead(self) -> None:
        """From `behind` to now, with what has come."""
        now, then = (
            each.view(np.uint8).reshape(len(each), -1) for each in (self.filters, self.behind)
        )
        short = self.config.delay == "clone" and not self._f.store_predictions
        used = _HISTORY if short else None
        now[:, :used] = then[:, :used]
        if len(self._rows):
            rows = aligned(self._rows, self._lags)
            packets = np.ascontiguousarray(self._waiting[:, :_PLACE])
            record = rows, len(rows), packets, len(packets), 0, EMPTY, EMPTY, NO_NIS
            advance_entry()(self.filters, self.gains, *record)

    @property
    def latency(self) -> dict[str, float]:
        """Seconds by channel, as they are in force."""
        return {each: self._lags[columns_of(each)[0]] * self.dt for each in self.config.latency}

    @property
    def latency_sd(self) -> float:
        """Seconds, of the latency that is looked for; 0 where all are known."""
        return float(self._search.sd) * self.dt if self._search else 0.0

    def get_state(self) -> Any:
        """As `Estimator.get_state`."""
        state = self.filters, self.behind, self._rows, self._waiting, self._search
        return copy.deepcopy(state)

    def set_state(self, snapshot: Any) -> None:
        """As `Estimator.set_state`."""
        filters, behind, self._rows, self._waiting, self._search = copy.deepcopy(snapshot)
        self.filters[:], self.behind[:] = filters, behind
