# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def"
"""The fused kernel: one env-step of a row in each of CUDA's threads, resets included.

Rows lie along the last axis of what a tick reads and writes, so that neighbouring threads touch
neighbouring numbers.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import cuda, types
from numba.cuda.np.numpy_support import carray

from ..backend.decorators import copied
from ..engine.arrays import Row, Start
from ..engine.batch import ends_of
from ..engine.config import EnvConfig
from ..engine.layout import FLAGS, STATE_WIDTH, Switches
from ..engine.reset import reset_vehicle
from ..engine.step import conclude, drive_on, kind_in, refuse, shares_of
from ..engine.tick import Kind
from ..engine.window import foresee, window_of
from ..record import FAST_WIDTH, PACKET_WIDTH, Array
from ..scenarios.draws import DRAWS_WIDTH
from ..task.info import REPORT
from ..vehicle.dynamics import Motion
from .generator import WORDS, next_key
from .text import SIMULATED, on_device

NAME = "sideslip_step"
"""The kernel's name in its PTX."""

RUNS, OVER, ASKED = range(3)  # of `Memory.over`; ASKED: it is to be reset
MODES = ("Disabled", "NextStep", "SameStep")
_, NEXT_STEP, SAME_STEP = range(3)
DRAWN = DRAWS_WIDTH, DRAWS_WIDTH, len(Motion._fields)  # of a packed start, behind the parameters


class How(NamedTuple):
    """What is the same for all rows and all steps: the compiler takes it for constants."""

    mode: int  # when rows that ended are reset
    n: int  # ticks of a control period
    kind: Kind
    switches: Switches
    width: int  # of the packed parameters, a trace included
    entries: int  # of an observation
    inputs: int  # of an action
    packets: int  # the most of a step
    record: int  # whether records are written to the device's memory


def how_of(config: EnvConfig, mode: str, record: bool) -> How:
    """How an env's rows are stepped."""
    base = config.base
    return How(
        mode=MODES.index(mode),
        n=int(config.control_period),
        kind=kind_in(base.start),
        switches=Switches(*base.start.switches.tolist()),
        width=len(base.start.params),
        entries=len(config.layout),
        inputs=config.action_width,
        packets=config.most_packets,
        record=int(record),
    )


class Memory(NamedTuple):
    """What lies on the device, N rows; `specification` has types and shapes."""

    params: Any
    states: Any
    reports: Any
    over: Any  # RUNS, OVER or ASKED
    generators: Any  # `generator.next_key`
    which: Any  # of a row that is asked for, its place in starts
    starts: Any  # packed one behind the other: parameters, low, high, motion; the first: no options
    switches: Any  # of the starts
    bounds: Any
    actions: Any
    obs: Any
    rewards: Any
    terminated: Any
    truncated: Any
    final_obs: Any  # of rows that end and are reset in the same step
    final_reports: Any
    rows: Any  # of the record
    packets: Any
    counts: Any  # of ticks and of packets


class Local(NamedTuple):
    """A thread's own working arrays, or its part of the record."""

    switches: Any
    window: Any
    rows: Any
    packets: Any


def specification(how: How, real: type, N: int, starts: int) -> Memory:
    """(type, shape) of each array."""
    width, byte, report = how.width + sum(DRAWN), np.uint8, len(REPORT)
    ends, kept = N * (how.mode == SAME_STEP), N * how.record
    return Memory(
        params=(real, (how.width, N)),
        states=(real, (STATE_WIDTH, N)),
        reports=(real, (report, N)),
        over=(byte, (N,)),
        generators=(np.int64, (WORDS, N)),
        which=(np.int64, (N,)),
        starts=(real, (starts, width)),
        switches=(np.int64, (starts, len(FLAGS))),
        bounds=(real, (2, how.entries)),
        actions=(np.float32, (N, how.inputs)),
        obs=(np.float32, (N, how.entries)),
        rewards=(real, (N,)),
        terminated=(byte, (N,)),
        truncated=(byte, (N,)),
        final_obs=(np.float32, (ends, how.entries)),
        final_reports=(real, (report, ends)),
        rows=(real, (how.n, FAST_WIDTH, kept)),
        packets=(real, (how.packets, PACKET_WIDTH, kept)),
        counts=(np.int64, (2, kept)),
    )


def packed_starts(starts: Sequence[Start]) -> tuple[Array, npt.NDArray[np.int64]]:
    """`Memory.starts` and `Memory.switches`."""
    packed = [np.concatenate([each.params, each.low, each.high, each.motion]) for each in starts]
    return np.stack(packed), np.stack([each.switches for each in starts])


def step_row(i: int, resets: bool, how: How, m: Memory, local: Local) -> None:
    """One env-step of row i; or its reset, if `resets` and it is ASKED."""
    row = Row(
        m.params[:, i],
        m.states[:, i],
        local.switches,
        m.obs[i],
        local.rows,
        local.packets,
        m.reports[:, i],
    )
    which, over = 0, int(m.over[i])
    if resets:
        if over != ASKED:
            return
        which = int(m.which[i])
    elif over != RUNS:
        m.rewards[i], m.terminated[i], m.truncated[i] = 0.0, 0, 0
        if how.mode != NEXT_STEP:
            return
    else:
        copied(how.switches, local.switches)
        done = _driven(row, m.actions[i], how, m.bounds, local.window)
        reward, terminated, truncated = ends_of(row.report)
        m.rewards[i], m.terminated[i], m.truncated[i] = reward, int(terminated), int(truncated)
        _count(i, how, m, done, row.report)
        if not (terminated or truncated):
            return
        if how.mode != SAME_STEP:
            m.over[i] = OVER
            return
        copied(row.obs, m.final_obs[i])
        copied(row.report, m.final_reports[:, i])
    _restart(which, row, m.generators[:, i], how, m)
    m.over[i] = RUNS
    _count(i, how, m, 1, row.report)


def _driven(row: Any, action: Any, how: How, bounds: Any, window: Any) -> int:
    """An env-step of a row that runs; returns how many ticks it took."""
    share, turn = shares_of(action)
    if share != share:
        refuse(row)
        for k in range(how.entries):
            row.obs[k] = 0.0
        return 0
    foresee(row.p, row.z, how.n, how.kind.follows, window)
    done = drive_on(row.p, row.z, how.kind, share, turn, how.n, row.rows, row.report, window, True)
    conclude(row, how.n, done, bounds, window)
    return int(done)


def _restart(which: int, row: Any, generator: Any, how: How, m: Memory) -> None:
    """Start a row's next episode, with the next key of its generator."""
    packed, low = m.starts[which], how.width
    high = low + DRAWN[0]
    motion = high + DRAWN[1]
    start = Start(
        packed[:low], packed[low:high], packed[high:motion], m.switches[which], packed[motion:]
    )
    key_low, key_high = next_key(generator)
    reset_vehicle(start, key_low, key_high, m.bounds, row)


def _count(i: int, how: How, m: Memory, done: int, report: Any) -> None:
    if how.record:
        m.counts[0, i], m.counts[1, i] = done, int(report[REPORT.packets])


def kernel_of(how: How, real: type[np.floating[Any]]) -> Any:
    """The kernel's function, for numba-cuda or its simulator; arguments are N, whether rows are
    reset, and the pointers of `Memory`."""
    step, shaped = on_device(step_row, real), _held if SIMULATED else carray
    floats = types.float32 if real is np.float32 else types.float64
    width, entries, inputs, report = how.width, how.entries, how.inputs, len(REPORT)
    packed, flags, record = how.width + sum(DRAWN), len(FLAGS), how.record
    window_shape = (len(window_of(1)), how.n)
    rows_shape, packets_shape = (how.n, FAST_WIDTH), (how.packets, PACKET_WIDTH)
    n, ticks, most, columns = how.n, FAST_WIDTH, how.packets, PACKET_WIDTH
    alone_rows, alone_packets = (*rows_shape, 1), (*packets_shape, 1)

    def fused(
        N, resets, params, states, reports, over, generators, which, starts, switches, bounds,
        actions, obs, rewards, terminated, truncated, final_obs, final_reports, rows, packets,
        counts,
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= N:
            return
        memory = Memory(
            shaped(params, (width, N)),
            shaped(states, (STATE_WIDTH, N)),
            shaped(reports, (report, N)),
            shaped(over, (N,)),
            shaped(generators, (WORDS, N)),
            shaped(which, (N,)),
            shaped(starts, (N, packed)),
            shaped(switches, (N, flags)),
            shaped(bounds, (2, entries)),
            shaped(actions, (N, inputs)),
            shaped(obs, (N, entries)),
            shaped(rewards, (N,)),
            shaped(terminated, (N,)),
            shaped(truncated, (N,)),
            shaped(final_obs, (N, entries)),
            shaped(final_reports, (report, N)),
            shaped(rows, (n, ticks, N)),
            shaped(packets, (most, columns, N)),
            shaped(counts, (2, N)),
        )
        if record:
            own_rows, own_packets = memory.rows[:, :, i], memory.packets[:, :, i]
        else:  # laid out like a part of the record, for one type of both
            own_rows = cuda.local.array(alone_rows, floats)[:, :, 0]
            own_packets = cuda.local.array(alone_packets, floats)[:, :, 0]
        own = Local(
            cuda.local.array(flags, types.int64),
            cuda.local.array(window_shape, floats),
            own_rows,
            own_packets,
        )
        step(i, resets, how, memory, own)

    return fused


def _held(array: Any, shape: Any) -> Any:
    """What a pointer stands for in the simulator."""
    return array.numbers
