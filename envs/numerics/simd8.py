# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Eight neighbours of a matrix's row at once, and what goes with them in a filter's matrices.

A matrix whose numbers are lanes, one of each of several filters, has an axis more: there the same
functions take the lanes of one place, and `span` says that they go on by one column. Of a symmetric
matrix of lanes only what stands on and above the diagonal counts.

The functions are plain Python on NumPy arrays; below them stands what the compiler makes of each.
Records of such matrices begin on cache lines, which eight numbers fill (`pad_to_cache_line`).
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.np.arrayobj import make_array, populate_array

from .packed import locate_element, make_index_types
from .simd import FLOATS, FLOATS8, LANES

LINE_BYTES = 64  # bytes that a cache fetches at once, eight numbers


def load8(array: Any, *index: int) -> Any:
    """Eight neighbours of a matrix's row or a vector, the first of them at an index."""
    *row, first = index
    return array[(*row, slice(first, first + 8))].copy()


def load8_symmetric(matrix: Any, k: int, j: int) -> Any:
    """`eight` of a symmetric matrix."""
    return load8(matrix, k, j)


def count_upper_rows(matrix: Any, rows: int, j: int) -> int:
    """How many of its rows count in the columns from j on."""
    return rows


def store8(array: Any, values: Any, *index: int) -> None:
    """Write eight neighbours, or one number in the place of each."""
    *row, first = index
    array[(*row, slice(first, first + 8))] = values


def mirror(array: Any, i: int, j: int) -> None:
    """Make a matrix of numbers symmetric: its 8 x 8 block at (i, j) into that at (j, i), i <= j; of
    one on the diagonal what stands above it."""
    block = array[i : i + 8, j : j + 8]
    array[j : j + 8, i : i + 8] = np.where(np.tri(8, k=-1), block.T, block) if i == j else block.T


def prefetch(array: Any, *index: int) -> None:
    """Have the cache line of a number fetched that is soon read; it may lie beyond the array."""


def pad_to_cache_line(fields: Sequence[Any]) -> np.dtype[Any]:
    """A structured dtype of these fields, as long as so many whole cache lines."""
    rest = -np.dtype(list(fields)).itemsize % LINE_BYTES
    return np.dtype([*fields, *([("to_line_end", np.int8, rest)] if rest else [])])


def allocate_aligned(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    """A record array of zeros whose first record begins on a cache line, as its eights then do."""
    size = math.prod(shape) * dtype.itemsize
    buffer = np.zeros(size + LINE_BYTES, np.int8)
    first = -buffer.ctypes.data % LINE_BYTES
    return buffer[first : first + size].view(dtype).reshape(shape).view(np.recarray)


def vector_width(array: Any) -> int:
    """How many columns of a matrix `eight` takes at once; one where they are lanes."""
    return 8


def allocate_scratch(template: Any, rows: int, columns: int) -> Any:
    """A matrix to work in, of constant shape and with any numbers in it, until the function ends.

    template: a matrix of the same kind, of numbers or of lanes. Compiled, it lies on the stack.
    """
    return np.empty((rows, columns))


def _is_row(array, indices):
    """Whether eight neighbours can be read there at once."""
    return _find_kind(array, indices) is FLOATS8


def _find_kind(array, indices):
    """What stands at so many indices: eight neighbours, lanes, or None."""
    if not isinstance(array, types.Array) or array.dtype != types.float64 or array.layout != "C":
        return None
    return {0: FLOATS8, 1: FLOATS}.get(array.ndim - indices)


@infer_global(vector_width)
class _VectorWidth(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp, *args)


@lower_builtin(vector_width, types.Array)
def _lower_vector_width(context, builder, sig, args):
    return context.get_constant(types.intp, 8 if sig.args[0].ndim == 2 else 1)


@infer_global(load8)
class _Load8(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        kind = _find_kind(array, len(index))
        return kind and signature(kind, array, *make_index_types(index))


@lower_builtin(load8, types.Array, types.VarArg(types.Any))
def _lower_load8(context, builder, sig, args):
    pointer = locate_element(context, builder, sig.args[0], args[0], args[1:])
    return builder.load(builder.bitcast(pointer, sig.return_type.value.as_pointer()), align=8)


@infer_global(load8_symmetric)
class _Load8Symmetric(_Load8):
    pass


@lower_builtin(load8_symmetric, types.Array, types.Integer, types.Integer)
def _lower_load8_symmetric(context, builder, sig, args):
    array, k, j = args
    if sig.args[0].ndim == 3:
        above = builder.icmp_signed("<", k, j)
        k, j = builder.select(above, k, j), builder.select(above, j, k)
    return _lower_load8(context, builder, sig, [array, k, j])


@infer_global(count_upper_rows)
class _CountUpperRows(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp, args[0], *make_index_types(args[1:]))


@lower_builtin(count_upper_rows, types.Array, types.Integer, types.Integer)
def _lower_count_upper_rows(context, builder, sig, args):
    _, rows, j = args
    if sig.args[0].ndim == 2:
        return rows
    below = builder.add(j, context.get_constant(types.intp, 1))
    return builder.select(builder.icmp_signed("<", below, rows), below, rows)


@infer_global(store8)
class _Store8(AbstractTemplate):
    def generic(self, args, kws):
        array, _, *index = args
        kind = _find_kind(array, len(index))
        return kind and signature(types.none, array, kind, *make_index_types(index))


@lower_builtin(store8, types.Array, FLOATS8, types.VarArg(types.Any))
@lower_builtin(store8, types.Array, FLOATS, types.VarArg(types.Any))
def _lower_store8(context, builder, sig, args):
    pointer = locate_element(context, builder, sig.args[0], args[0], args[2:])
    builder.store(args[1], builder.bitcast(pointer, sig.args[1].value.as_pointer()), align=8)
    return context.get_dummy_value()


@infer_global(mirror)
class _Mirror(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        return _find_kind(array, 2) and signature(types.none, array, *make_index_types(index))


@lower_builtin(mirror, types.Array, types.intp, types.intp)
def _lower_mirror(context, builder, sig, args):
    array, i, j = args
    if sig.args[0].ndim == 3:
        return context.get_dummy_value()

    def locate_row(first, k, column):
        at_k = builder.add(first, context.get_constant(types.intp, k))
        pointer = locate_element(context, builder, sig.args[0], array, [at_k, column])
        return builder.bitcast(pointer, FLOATS8.value.as_pointer())

    def shuffle(x, y, places):
        indices = ir.Constant(ir.VectorType(ir.IntType(32), 8), places)
        return builder.shuffle_vector(x, y, indices)

    above = [builder.load(locate_row(i, k, j), align=8) for k in range(8)]
    transposed = list(above)
    for s in (1, 2, 4):  # blocks of s by s change places across the diagonal of those of 2 s
        for k in (k for k in range(8) if not k & s):
            x, y = transposed[k], transposed[k + s]
            transposed[k] = shuffle(x, y, [m + 8 - s if m & s else m for m in range(8)])
            transposed[k + s] = shuffle(x, y, [m + 8 if m & s else m + s for m in range(8)])
    diagonal = builder.icmp_signed("==", i, j)
    for k in range(8):
        lower = shuffle(transposed[k], above[k], [m if m < k else m + 8 for m in range(8)])
        builder.store(builder.select(diagonal, lower, transposed[k]), locate_row(j, k, i), align=8)
    return context.get_dummy_value()


@infer_global(prefetch)
class _Prefetch(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        return (
            signature(types.none, array, *make_index_types(index))
            if _is_row(array, len(index))
            else None
        )


@lower_builtin(prefetch, types.Array, types.VarArg(types.Any))
def _lower_prefetch(context, builder, sig, args):
    byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    pointer = locate_element(context, builder, sig.args[0], args[0], args[1:])
    flags = [ir.Constant(flag, value) for value in (1, 3, 1)]  # to be written, to all caches, data
    builder.call(function, [builder.bitcast(pointer, byte), *flags])
    return context.get_dummy_value()


@infer_global(allocate_scratch)
class _AllocateScratch(AbstractTemplate):
    prefer_literal = True

    def generic(self, args, kws):
        like, *shape = args
        if not all(isinstance(size, types.IntegerLiteral) for size in shape):
            return None
        return signature(types.Array(types.float64, like.ndim, "C"), *args)


@lower_builtin(allocate_scratch, types.Array, types.IntegerLiteral, types.IntegerLiteral)
def _lower_allocate_scratch(context, builder, sig, args):
    rows, columns = (item.literal_value for item in sig.args[1:])
    shape = [rows, columns] if sig.args[0].ndim == 2 else [rows, columns, LANES]
    with builder.goto_entry_block():  # numba's own way fills it with zeros first
        pointer = builder.alloca(ir.ArrayType(ir.DoubleType(), math.prod(shape)))
    pointer.align = 64
    made = make_array(sig.return_type)(context, builder)
    strides = [8 * math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    size = [context.get_constant(types.intp, item) for item in (*shape, *strides, 8)]
    data = builder.bitcast(pointer, ir.DoubleType().as_pointer())
    axes = len(shape)
    populate_array(made, data, size[:axes], size[axes:-1], size[-1], None)
    return made._getvalue()
