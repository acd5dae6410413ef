# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,call-arg,misc,no-untyped-call,no-untyped-def"
"""The fused CUDA kernel: an env-step of a row in each thread, with resets and PCG64 generators.

The engine's functions become device functions, rebuilt from the code of the other engines with
CUDA's own primitives and literals of one precision. Rows lie along the last axis of what a tick
reads and writes, so that neighbouring threads touch neighbouring numbers. A generator is NumPy's
PCG64 (O'Neill, "PCG", HMC-CS-2014-0905): state, then increment, each of four words of 32 bits,
the lowest first.

Args:
    constants: Constants of the kernel.
    real: Type of floats.
    N: Number of rows.
    starts: Number of starts.
"""

import functools
from collections.abc import Callable
from types import CodeType
from typing import Any, NamedTuple

import numpy as np
from numba import cuda, types
from numba.cuda.np.numpy_support import carray

from ..engine.batch import read_ends
from ..engine.config import EnvConfig
from ..engine.layout import FLAGS, STATE_WIDTH, EpisodeArrays, EpisodeStart, StepVariant, Switches
from ..engine.outputs import finish_step
from ..engine.reset import reset_vehicle
from ..engine.step import clip_action, get_start_variant, integrate_step, reject_action
from ..engine.window import make_window, precompute_window
from ..numerics import require_extra
from ..numerics.jit import as_python, copy_into
from ..numerics.packed import load_element, read, store_element, write
from ..numerics.primitives import Matrix, Vector
from ..record import FAST_WIDTH, PACKET_WIDTH
from ..scenarios.world import DRAWS_WIDTH
from ..task import REPORT
from ..vehicle.dynamics import Motion

with require_extra("cuda", "the CUDA engine needs numba-cuda"):
    import numba_cuda as numba_cuda  # makes sure of it: numba's own `cuda` is an older one

_Function = Callable[..., Any]
Real = type[np.floating[Any]]  # float64 or float32
SIMULATED = bool(cuda.config.ENABLE_CUDASIM)
"""Whether numba simulates CUDA in Python (NUMBA_ENABLE_CUDASIM=1)."""

WORDS = 8
_MASK = 0xFFFFFFFF
_M0, _M1, _M2, _M3 = 0x9FCCF645, 0x4385DF64, 0x1FC65DA4, 0x2360ED05


def _draw_key(words: Vector) -> tuple[int, int]:
    """Draw the generator's next 64 bits as (low, high) of 32; its words (WORDS,) advance."""
    a, b, c, d = int(words[0]), int(words[1]), int(words[2]), int(words[3])
    aa, ab, ba = a * _M0, a * _M1, b * _M0
    ac, bb, ca = a * _M2, b * _M1, c * _M0
    low = (aa & _MASK) + int(words[4])
    second = (low >> 32) + _extract_high(aa) + (ab & _MASK) + (ba & _MASK) + int(words[5])
    third = (second >> 32) + _extract_high(ab) + _extract_high(ba) + int(words[6])
    third = third + (ac & _MASK) + (bb & _MASK) + (ca & _MASK)
    top = (third >> 32) + _extract_high(ac) + _extract_high(bb) + _extract_high(ca) + int(words[7])
    top = top + a * _M3 + b * _M2 + c * _M1 + d * _M0  # what is above its 32 bits is lost
    a, b, c, d = low & _MASK, second & _MASK, third & _MASK, top & _MASK
    words[0], words[1], words[2], words[3] = a, b, c, d
    low, high, turn = a ^ c, b ^ d, d >> 26  # the words' exclusive or, rotated by the leading bits
    if turn >= 32:
        low, high = high, low
    turn = turn & 31
    first = ((low >> turn) | (high << (32 - turn))) & _MASK
    return first, ((high >> turn) | (low << (32 - turn))) & _MASK


def _extract_high(product: int) -> int:
    """Extract the upper 32 of 64 bits."""
    return (product >> 32) & _MASK


NAME = "sideslip_step"
"""The kernel's name in its PTX."""

RUNS, _OVER, ASKED = range(3)  # of `DeviceArrays.over`; ASKED: it is to be reset
MODES = ("Disabled", "NextStep", "SameStep")
_, NEXT_STEP, SAME_STEP = range(3)
_DRAWN = DRAWS_WIDTH, DRAWS_WIDTH, len(Motion._fields)  # of a packed start, behind the parameters


class KernelConstants(NamedTuple):
    """Constants of the compiled kernel, the same for all rows and steps."""

    mode: int  # when rows that ended are reset
    n: int  # ticks of a control period
    kind: StepVariant
    switches: Switches
    width: int  # of the packed parameters, a trace included
    entries: int  # of an observation
    inputs: int  # of an action
    packets: int  # largest number in a step
    record: int  # whether records are written to the device's memory


def make_constants(config: EnvConfig, mode: str, record: bool) -> KernelConstants:
    """Make the kernel's constants.

    Args:
        config: Config of the environment.
        mode: Autoreset mode, of `MODES`.
        record: Whether records are written.
    """
    base = config.base
    return KernelConstants(
        mode=MODES.index(mode), n=int(config.control_period), kind=get_start_variant(base.start),
        switches=Switches(*base.start.switches.tolist()), width=len(base.start.params),
        entries=len(config.layout), inputs=config.action_width, packets=config.max_packets,
        record=int(record),
    )  # fmt: skip


class DeviceArrays(NamedTuple):
    """Arrays on the device, of N rows; `make_specification` has types and shapes."""

    params: Matrix
    states: Matrix
    reports: Matrix
    over: Vector  # RUNS, _OVER or ASKED
    generators: Matrix  # as `_draw_key` reads them
    which: Vector  # index in starts of a row that is asked for
    starts: Matrix  # packed: parameters, low, high, motion behind each other; 0: no options
    switches: Matrix  # of the starts
    bounds: Matrix
    actions: Matrix
    obs: Matrix
    rewards: Vector
    terminated: Vector
    truncated: Vector
    final_obs: Matrix  # of rows that end and are reset in the same step
    final_reports: Matrix
    rows: Matrix  # of the record
    packets: Matrix
    counts: Matrix  # of ticks and of packets


def make_specification(constants: KernelConstants, real: Real, N: int, starts: int) -> DeviceArrays:
    """Make (type, shape) of each array, in place of the arrays."""
    width, byte, report = constants.width + sum(_DRAWN), np.uint8, len(REPORT)
    ends, n_record = N * (constants.mode == SAME_STEP), N * constants.record
    return DeviceArrays(
        params=(real, (constants.width, N)), states=(real, (STATE_WIDTH, N)),
        reports=(real, (report, N)), over=(byte, (N,)), generators=(np.int64, (WORDS, N)),
        which=(np.int64, (N,)), starts=(real, (starts, width)),
        switches=(np.int64, (starts, len(FLAGS))), bounds=(real, (2, constants.entries)),
        actions=(np.float32, (N, constants.inputs)), obs=(np.float32, (N, constants.entries)),
        rewards=(real, (N,)), terminated=(byte, (N,)), truncated=(byte, (N,)),
        final_obs=(np.float32, (ends, constants.entries)), final_reports=(real, (report, ends)),
        rows=(real, (constants.n, FAST_WIDTH, n_record)),
        packets=(real, (constants.packets, PACKET_WIDTH, n_record)),
        counts=(np.int64, (2, n_record)),
    )  # fmt: skip


def _step_row(
    i: int, resets: bool, constants: KernelConstants, m: DeviceArrays, row: EpisodeArrays
) -> None:
    """Step row i by one env-step; or reset it, if `resets` and it is ASKED."""
    start_index, over = 0, int(m.over[i])
    if resets:
        if over != ASKED:
            return
        start_index = int(m.which[i])
    elif over != RUNS:
        m.rewards[i], m.terminated[i], m.truncated[i] = 0.0, 0, 0
        if constants.mode != NEXT_STEP:
            return
    else:
        copy_into(constants.switches, row.switches)
        done = _run_row(row, m.actions[i], constants)
        reward, terminated, truncated = read_ends(row.report)
        m.rewards[i], m.terminated[i], m.truncated[i] = reward, int(terminated), int(truncated)
        _count(i, constants, m, done, row.report)
        if not (terminated or truncated):
            return
        if constants.mode != SAME_STEP:
            m.over[i] = _OVER
            return
        copy_into(row.obs, m.final_obs[i])
        copy_into(row.report, m.final_reports[:, i])
    packed, low = m.starts[start_index], constants.width
    high = low + _DRAWN[0]
    motion = high + _DRAWN[1]
    start = EpisodeStart(
        packed[:low], packed[low:high], packed[high:motion], m.switches[start_index],
        packed[motion:],
    )  # fmt: skip
    key_low, key_high = _draw_key(m.generators[:, i])
    reset_vehicle(start, key_low, key_high, row)
    m.over[i] = RUNS
    _count(i, constants, m, 1, row.report)


def _run_row(row: EpisodeArrays, action: Vector, constants: KernelConstants) -> int:
    """Step a row that runs by one env-step; return the ticks done."""
    shares = clip_action(action)
    if shares[0] != shares[0]:
        reject_action(row)
        for k in range(constants.entries):
            row.obs[k] = 0.0
        return 0
    precompute_window(row, constants.n, constants.kind)
    done = integrate_step(row, constants.kind, shares, constants.n, True)
    finish_step(row, constants.n, done)
    return int(done)


def _count(i: int, constants: KernelConstants, m: DeviceArrays, done: int, report: Vector) -> None:
    """Write the numbers of ticks and packets of row i's record."""
    if constants.record:
        m.counts[0, i], m.counts[1, i] = done, int(report[REPORT.packets])


def _to_cuda(function: Any, real: Real) -> Any:
    """Rebuild a function compiled by `jit`, and its callees; plain Python in the simulator."""

    def finish(rebuilt: Any) -> Any:
        if real is not np.float64:
            _set_precision(rebuilt, real)
        return rebuilt if SIMULATED else _device_jit(rebuilt)

    simulated = _SINGLE if real is np.float32 else None
    return as_python(function, simulated if SIMULATED else _make_table(real), finish)


_device_jit: Any = functools.partial(cuda.jit, device=True, forceinline=True)
_SINGLE: dict[str, _Function] = {
    "to_word": lambda a: int(np.float32(a).view(np.uint32)),
    "from_word": lambda a: np.uint32(a).view(np.float32),
}
"""Primitives of the simulator's float32: a word's 32 bits are those of a float."""


def _set_precision(function: Any, real: Real) -> None:
    """Give the function's literals and global numbers a precision, so that no float64 enters."""
    names, code = function.__globals__, function.__code__
    function.__code__ = code.replace(co_consts=_convert_literals(code.co_consts, real))
    for name in code.co_names:
        if name == "float" or isinstance(names.get(name), float | tuple):
            names[name] = real if name == "float" else _convert_literals(names[name], real)


def _convert_literals(value: Any, real: Real) -> Any:
    """Convert the floats of a value and of nested tuples."""
    if isinstance(value, float):
        return real(value)
    if isinstance(value, tuple) and not isinstance(value, CodeType):
        make = getattr(value, "_make", tuple)  # of a named tuple
        return make([_convert_literals(item, real) for item in value])
    return value


def _make_table(real: Real) -> dict[str, _Function]:
    """Make CUDA's own primitives by the names that the equations use; Python's serve for others."""
    from numba.cuda import libdevice

    single = real is np.float32
    fabs = libdevice.fabsf if single else libdevice.fabs
    floor = libdevice.floorf if single else libdevice.floor
    sqrt = libdevice.fsqrt_rn if single else libdevice.dsqrt_rn
    frexp = libdevice.frexpf if single else libdevice.frexp
    functions = {
        "absolute": lambda a: fabs(a),
        "floor": lambda a: floor(a),
        "sqrt": lambda a: sqrt(a),
        "to_float": lambda a: real(a),
        "frexp": lambda a: (frexp(a)[0], real(frexp(a)[1])),
        "from_word": lambda a: real(a),
    }
    if single:  # a float64 has a word's value, a float32 its bits
        functions["to_word"] = lambda a: int(libdevice.float_as_int(a))
        functions["from_word"] = lambda a: libdevice.int_as_float(np.int32(a))
    return {name: _device_jit(f) for name, f in functions.items()} | _register_access()


@functools.cache
def _register_access() -> dict[str, _Function]:
    """Register numba-cuda's versions of reading and writing packed arrays, once."""
    from numba.cuda.extending import overload

    typings: dict[_Function, _Function] = {
        read: _read, write: _write, load_element: _load_element, store_element: _store_element
    }  # fmt: skip
    for function, typing in typings.items():
        overload(function, jit_options={"forceinline": True})(typing)
    return {function.__name__: function for function in typings}


def _format_column(j: Any) -> str:
    return "" if j is None or isinstance(j, types.Omitted | types.NoneType) else ", j"


def _build_function(text: str, **names: Any) -> Any:
    exec(text, names)  # the text is made here alone
    return names["written"]


def _read(array, where, j=None):
    numbers = "".join(f"array[where[0] + {k}{_format_column(j)}], " for k in range(len(where)))
    made = getattr(where, "instance_class", None)
    body = f"made({numbers})" if made else f"({numbers})"
    return _build_function(f"def written(array, where, j=None): return {body}", made=made)


def _write(array, values, where, j=None):
    lines = [f"    array[where[{k}]{_format_column(j)}] = values[{k}]\n" for k in range(len(where))]
    return _build_function(f"def written(array, values, where, j=None):\n{''.join(lines)}")


def _load_element(array, i, j=None):
    return _build_function(f"def written(array, i, j=None): return array[i{_format_column(j)}]")


def _store_element(array, value, i, j=None):
    text = f"def written(array, value, i, j=None): array[i{_format_column(j)}] = value"
    return _build_function(text)


def make_kernel(constants: KernelConstants, real: Real) -> Any:
    """Make the kernel, a function of N, whether rows are reset, and pointers to `DeviceArrays`."""
    step, make_array = _to_cuda(_step_row, real), carray
    if SIMULATED:
        make_array = lambda pointer, shape: pointer.numbers  # noqa: E731
    floats = types.float32 if real is np.float32 else types.float64
    width, entries, inputs = constants.width, constants.entries, constants.inputs
    packed, flags, record = width + sum(_DRAWN), len(FLAGS), constants.record
    n, max_packets, report = constants.n, constants.packets, len(REPORT)
    window_shape = (len(make_window(1)), n)
    rows_shape, packets_shape = (n, FAST_WIDTH, 1), (max_packets, PACKET_WIDTH, 1)

    def step_kernel(
        N, resets, params, states, reports, over, generators, which, starts, switches, bounds,
        actions, obs, rewards, terminated, truncated, final_obs, final_reports, rows, packets,
        counts,
    ):  # fmt: skip
        i = cuda.grid(1)
        if i >= N:
            return
        memory = DeviceArrays(
            make_array(params, (width, N)), make_array(states, (STATE_WIDTH, N)),
            make_array(reports, (report, N)), make_array(over, (N,)),
            make_array(generators, (WORDS, N)), make_array(which, (N,)),
            make_array(starts, (N, packed)), make_array(switches, (N, flags)),
            make_array(bounds, (2, entries)), make_array(actions, (N, inputs)),
            make_array(obs, (N, entries)), make_array(rewards, (N,)), make_array(terminated, (N,)),
            make_array(truncated, (N,)), make_array(final_obs, (N, entries)),
            make_array(final_reports, (report, N)), make_array(rows, (n, FAST_WIDTH, N)),
            make_array(packets, (max_packets, PACKET_WIDTH, N)), make_array(counts, (2, N)),
        )  # fmt: skip
        if record:
            own_rows, own_packets = memory.rows[:, :, i], memory.packets[:, :, i]
        else:  # laid out like a part of the record, for one type of both
            own_rows = cuda.local.array(rows_shape, floats)[:, :, 0]
            own_packets = cuda.local.array(packets_shape, floats)[:, :, 0]
        own_flags = cuda.local.array(flags, types.int64)
        own_window = cuda.local.array(window_shape, floats)
        row = EpisodeArrays(
            memory.params[:, i], memory.states[:, i], own_flags, memory.obs[i], own_rows,
            own_packets, memory.reports[:, i], memory.bounds, own_window,
        )  # fmt: skip
        step(i, resets, constants, memory, row)

    return step_kernel
