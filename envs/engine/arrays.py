"""The arrays of episodes: what kernels read and write of one, and of the N of a batch."""

from typing import Any, NamedTuple

from ..backend.decorators import jit


class Row(NamedTuple):
    """One episode's arrays."""

    p: Any  # (PARAMS_WIDTH,), packed as in `Params`; behind it a recorded trace, if there is one
    z: Any  # (STATE_WIDTH,), packed as in `State`
    switches: Any  # (len(Switches),) int64
    obs: Any  # (k,) float32
    rows: Any  # (n, FAST_WIDTH), the fast rows of the newest record
    packets: Any  # (most, PACKET_WIDTH), its packets
    report: Any  # (len(Report),)


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
