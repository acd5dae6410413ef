"""The arrays of episodes: what kernels read and write of one, and of the N of a batch."""

from typing import Any, NamedTuple

import numpy as np

from ..backend.arrays import integers, matrix, offsets, read, singles
from ..backend.decorators import jit, plain
from ..record import FAST_WIDTH, PACKET_WIDTH, Array
from ..task.info import REPORT
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH
from .window import HEIGHT, columns_of


class Row(NamedTuple):
    """One episode's arrays."""

    p: Any  # (PARAMS_WIDTH,), packed as in `Params`; behind it a recorded trace, if there is one
    z: Any  # (STATE_WIDTH,), packed as in `State`
    switches: Any  # (len(Switches),) int64
    obs: Any  # (k,) float32
    rows: Any  # (n, FAST_WIDTH), the fast rows of the newest record
    packets: Any  # (most, PACKET_WIDTH), its packets
    report: Any  # (len(Report),)


class Sizes(NamedTuple):
    """What a workspace begins with."""

    n: Any  # ticks a step
    entries: Any  # of an observation
    most: Any  # packets of a step


SIZES, _START = offsets(Sizes)


def workspace_of(n: int, bounds: Array, most: int, trace: int = 0) -> Array:
    """The arrays of an episode, one behind the other in one vector: numba takes 0.04 us for every
    array that it is handed. `parts_of` finds them.

    bounds: (2, k), of an observation's entries. trace: the numbers behind the parameters.
    """
    k = bounds.shape[1]
    width = _START + STATE_WIDTH + len(REPORT) + len(FLAGS) + 2 * k - (-k // 2)
    width += n * FAST_WIDTH + most * PACKET_WIDTH + HEIGHT * columns_of(n)
    work = np.zeros(width + PARAMS_WIDTH + trace)
    work[:_START] = n, k, most
    _parts_of(work)[1][:] = bounds
    return work


@jit
def parts_of(work: Any) -> Any:
    """(the episode's Row, the bounds of its observation, its window) that lie in a workspace."""
    sizes = read(work, SIZES)
    n, k, most = int(sizes.n), int(sizes.entries), int(sizes.most)
    report = _START + STATE_WIDTH
    flags = report + len(REPORT)
    bounds = flags + len(FLAGS)
    window = bounds + 2 * k
    rows = window + HEIGHT * columns_of(n)
    packets = rows + n * FAST_WIDTH
    obs = packets + most * PACKET_WIDTH
    row = Row(
        work[obs - (-k // 2) :],
        work[_START:report],
        integers(work, flags, len(FLAGS)),
        singles(work, obs, k),
        matrix(work, rows, n, FAST_WIDTH),
        matrix(work, packets, most, PACKET_WIDTH),
        work[report:flags],
    )
    return row, matrix(work, bounds, 2, k), matrix(work, window, HEIGHT, columns_of(n))


_parts_of = plain(parts_of)
_PARTS = (
    "_row", "_params", "_state", "_switches", "_obs", "rows", "packets", "_report", "_bounds",
    "_window", "_told", "_observation",
)  # fmt: skip


class Packed:
    """An environment of one car, whose arrays are parts of `_work`.

    `rows` and `packets` are the newest record's; `delivered` of the latter are there.
    """

    config: Any
    control_period: int
    _work: Array | None = None

    def _make_room(self, width: int) -> None:
        """A workspace for parameters and a trace behind them, `width` numbers, where they are not
        as many as before."""
        if self._work is None or len(self._params) != width:
            config, trace = self.config, width - PARAMS_WIDTH
            most = config.most_packets
            self._work = workspace_of(self.control_period, config.bounds, most, trace)
            self._lay_out()

    def _lay_out(self) -> None:
        """Name the parts, and the calls that read them in every step."""
        self._row, self._bounds, self._window = _parts_of(self._work)
        self._params, self._state, self._switches, self._obs, *record = self._row
        self.rows, self.packets, self._report = record
        self._told, self._observation = self._report.tolist, self._obs.copy

    def __getstate__(self) -> dict[str, Any]:
        return {name: each for name, each in vars(self).items() if name not in _PARTS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lay_out()

    @property
    def delivered(self) -> int:
        """How many packets the newest record has."""
        return int(self._report[REPORT.packets])


class Rows(NamedTuple):
    """The arrays of N episodes, a row for each."""

    params: Any  # (N, ...), the rest as in `Row`
    states: Any
    switches: Any
    obs: Any
    rows: Any
    packets: Any
    reports: Any
    ticks_done: Any  # (N,), how many of `rows` are there
    delivered: Any  # (N,), how many of `packets` are there
    over: Any  # (N,) of bool: the episode has ended and was not reset yet


class Records(NamedTuple):
    """The records of N episodes."""

    rows: Any
    packets: Any
    ticks_done: Any
    delivered: Any


class Start(NamedTuple):
    """The packed start of an episode; of several, arrays have an axis more, the first."""

    params: Any  # as in `Row`, with what the scenario does not draw
    low: Any  # (len(Draws),), the ranges that it draws from
    high: Any
    switches: Any
    motion: Any  # (len(Motion),), NaN: standing on the road at the drawn speed


@jit
def row_of(rows: Rows, i: int) -> Row:
    """The arrays of an episode of several."""
    return Row(
        rows.params[i],
        rows.states[i],
        rows.switches[i],
        rows.obs[i],
        rows.rows[i],
        rows.packets[i],
        rows.reports[i],
    )


@jit
def start_of(starts: Start, i: int) -> Start:
    """The start of one of several episodes."""
    return Start(
        starts.params[i],
        starts.low[i],
        starts.high[i],
        starts.switches[i],
        starts.motion[i],
    )
