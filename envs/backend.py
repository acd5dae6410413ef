"""One text, several machines: the compiler's decorator and the table of primitives.

The equations of sideslip are plain scalar functions over tuples. `jit` compiles them; `plain`
rebuilds the very same functions for Python floats, NumPy arrays or any other table of primitives.
"""

import functools
import hashlib
import math
import os
import shutil
import types as python_types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.dispatcher import Dispatcher
from numba.extending import intrinsic, overload

_PACKAGE = Path(__file__).resolve().parent.parent
_PREFIX = __name__.removesuffix("envs.backend")
_LAYERS = ("envs", "estimators", "agents", "benchmarks")  # each calls only those before it
_KEPT_CACHES = 12

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])


def source_stamp(layer: str = _LAYERS[-1]) -> str:
    """The hash of all source files a layer's kernels may call, which names their folder.

    numba watches only the file of the function itself: an edit in a callee's module would
    otherwise silently give the numbers of the old text. Calls point one way, so an edit in
    `benchmarks` leaves the kernels of `envs` alone.
    """
    digest = hashlib.sha256()
    for folder in _LAYERS[: _LAYERS.index(layer) + 1]:
        for path in sorted((_PACKAGE / folder).glob("*.py")):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder(layer: str = _LAYERS[-1]) -> str | None:
    """A writable folder for a layer's kernels, or None; older versions' are pruned."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    base = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(home) / "sideslip" / "kernels")
    folder = base / source_stamp(layer)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        newest = sorted(base.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    if "NUMBA_CACHE_DIR" not in os.environ:  # a folder of the user's own is not ours to prune
        for old in newest[_KEPT_CACHES:]:
            shutil.rmtree(old, ignore_errors=True)
    return str(folder)


_kept_folder = functools.cache(_cache_folder)


def jit(function: F) -> F:
    """Compile with numba: IEEE arithmetic in the order written, cached on disk where possible."""
    return _compiled(function)


def inlined(function: F) -> F:
    """The same, and the text goes into its callers: what takes many numbers and is called often.

    A call of a plant's function passes some sixty numbers through memory, which costs as much as
    the function itself.
    """
    return _compiled(function, forceinline=True)


def _compiled(function: F, **more: bool) -> F:
    layer = function.__module__.removeprefix(_PREFIX).partition(".")[0]
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": False, **more}
    if layer == "envs":  # allocates nothing; counting references costs as much as an observation
        options["_nrt"] = False
    folder = (
        None if config.DISABLE_JIT else _kept_folder(layer if layer in _LAYERS else _LAYERS[-1])
    )
    if folder is None:
        return numba.njit(**options)(function)  # type: ignore[no-any-return]
    before, config.CACHE_DIR = config.CACHE_DIR, folder
    try:
        return numba.njit(cache=True, **options)(function)  # type: ignore[no-any-return]
    finally:
        config.CACHE_DIR = before


def minimum(a: Any, b: Any) -> Any:
    """The smaller of two numbers."""
    return a if a < b else b


def maximum(a: Any, b: Any) -> Any:
    """The larger of two numbers."""
    return a if a > b else b


def absolute(a: Any) -> Any:
    """|a|."""
    return math.fabs(a)


def floor(a: Any) -> Any:
    """The largest whole number at or below a, as a float."""
    return math.floor(a) * 1.0


def sqrt(a: Any) -> Any:
    """The square root, correctly rounded."""
    return math.sqrt(a)


def select(condition: Any, a: Any, b: Any) -> Any:
    """a where the condition holds, else b (both are evaluated)."""
    return a if condition else b


def to_float(a: Any) -> Any:
    """An integer as a float."""
    return a * 1.0


def whole(a: Any) -> Any:
    """A whole number that is a float, as an integer."""
    return int(a)


def anywhere(condition: Any) -> Any:
    """Whether a condition holds for any of the vehicles that are computed together."""
    return condition


PRIMITIVES: tuple[Callable[..., Any], ...] = (
    minimum, maximum, absolute, floor, sqrt, select, to_float, whole, anywhere,
)  # fmt: skip
"""What the equations use beside + - * /; each kind of number has its own table of these."""


def _for_numbers(primitive: Callable[..., Any]) -> None:
    """The compiler takes a primitive's own text where its arguments are single numbers."""

    @overload(primitive, strict=False)
    def _of(*args):  # type: ignore[no-untyped-def]
        alone = all(isinstance(each, types.Number | types.Boolean) for each in args)
        return primitive if alone else None


for _each in PRIMITIVES:
    if _each is not floor:
        _for_numbers(_each)


@intrinsic
def _floor(typingctx, a):  # type: ignore[no-untyped-def]  # without the way over an integer
    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        of = ir.FunctionType(args[0].type, [args[0].type])
        function = cgutils.get_or_insert_function(builder.module, of, "llvm.floor.f64")
        return builder.call(function, args)

    return types.float64(types.float64), code


@overload(floor)
def _floor_of(a):  # type: ignore[no-untyped-def]
    return (lambda a: _floor(a)) if isinstance(a, types.Number) else None


@jit
def copied(source: Any, target: Any) -> None:
    """Copy a vector's numbers into another one; a slice's assignment would allocate."""
    for i in range(len(source)):
        target[i] = source[i]


def fixed_tuple(vector: Any, length: int) -> tuple[Any, ...]:
    """The first `length` entries of a vector as a tuple of numbers.

    Of a matrix (length or more, lanes), whose rows are lanes, it is a tuple of these; so in `at`
    and `put`, where an array has one axis more than there are indices.
    """
    return tuple(vector[:length].tolist())


def at(array: Any, *index: int) -> Any:
    """The number of an array at an index."""
    return float(array[index])


def put(array: Any, value: Any, *index: int) -> None:
    """Write a number into an array."""
    array[index] = value


def put_all(array: Any, values: Any, axis: int, *index: int) -> None:
    """Write a tuple of numbers into an array, from an index on along an axis."""
    for k, value in enumerate(values):
        array[tuple(i + k * (a == axis) for a, i in enumerate(index))] = value


def of_lane(array: Any, lane: int, *index: int) -> Any:
    """The number of one of those abreast; of single ones there is but the first."""
    return float(array[index])


def abreast() -> int:
    """How many numbers `ramp` gives and `put_along` writes at once."""
    return 1


def ramp(first: int) -> Any:
    """The whole numbers from `first` on, `abreast` of them."""
    return first


def put_along(array: Any, values: Any, i: int, j: int) -> None:
    """Write numbers into the row i of a matrix from the column j on, `abreast` of them."""
    array[i, j] = values


@intrinsic(prefer_literal=True)
def _entries(typingctx, vector, length):  # type: ignore[no-untyped-def]
    size = getattr(length, "literal_value", None)
    if size is None:
        return None  # numba asks again with the literal

    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind = sig.args[0]
        made = context.make_array(kind)(context, builder, args[0])
        values = []
        for i in range(size):
            index = [context.get_constant(types.intp, i)]
            where = cgutils.get_item_pointer(context, builder, kind, made, index)
            values.append(context.unpack_value(builder, kind.dtype, where))
        return context.make_tuple(builder, sig.return_type, values)

    return types.UniTuple(vector.dtype, size)(vector, length), code


@overload(fixed_tuple, prefer_literal=True)
def _fixed_tuple(vector, length):  # type: ignore[no-untyped-def]  # numba compares signatures
    if not hasattr(length, "literal_value") or vector.ndim != 1:
        return None
    return lambda vector, length: _entries(vector, length)


ARRAYS: dict[str, Callable[..., Any]] = {
    "minimum": np.minimum,
    "maximum": np.maximum,
    "absolute": np.absolute,
    "floor": np.floor,
    "sqrt": np.sqrt,
    "select": np.where,
    "to_float": lambda a: np.multiply(a, 1.0),
    "whole": lambda a: np.asarray(a).astype(np.int64),
    "anywhere": np.any,
}
"""The primitives for NumPy arrays, by the names the equations use."""


def plain(function: F, table: Mapping[str, Callable[..., Any]] | None = None) -> F:
    """The same text without the compiler.

    Parameters: `function`, compiled by `jit` or not; `table`, primitives by name that replace
    ours (`ARRAYS` for NumPy arrays, None for Python floats).
    Returns: a function built from the same code object, its callees replaced likewise.
    """
    rebuilt: F = _rebuild(function, dict(table or {}), {})
    return rebuilt


def _rebuild(function: Any, table: dict[str, Any], done: dict[Any, Any]) -> Any:
    source = function.py_func if isinstance(function, Dispatcher) else function
    if source.__name__ in table and source.__module__ == __name__:
        return table[source.__name__]
    if source in done:
        return done[source]
    names: dict[str, Any] = dict(source.__globals__)
    rebuilt = python_types.FunctionType(
        source.__code__, names, source.__name__, source.__defaults__
    )
    done[source] = rebuilt
    for name in source.__code__.co_names:
        callee = names.get(name)
        ours = isinstance(callee, python_types.FunctionType) and (
            callee.__module__ or ""
        ).startswith(__name__.rpartition(".envs")[0])
        if isinstance(callee, Dispatcher) or ours:
            names[name] = _rebuild(callee, table, done)
    return rebuilt
