# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Eight neighbours of a matrix's row at once, and what goes with them in a filter's matrices.

The functions are plain Python on NumPy arrays; below them stands what the compiler makes of each.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.np.arrayobj import make_array, populate_array

from .arrays import place, whole
from .simd import EIGHT


def eight(array: Any, *index: int) -> Any:
    """Eight neighbours of a matrix's row or a vector, the first of them at an index."""
    *row, first = index
    return array[(*row, slice(first, first + 8))].copy()


def put_eight(array: Any, values: Any, *index: int) -> None:
    """Write eight neighbours, or one number in the place of each."""
    *row, first = index
    array[(*row, slice(first, first + 8))] = values


def mirror(array: Any, i: int, j: int) -> None:
    """Make a matrix symmetric: its 8 x 8 block at (i, j) into that at (j, i), i <= j; of one on the
    diagonal what stands above it."""
    block = array[i : i + 8, j : j + 8]
    array[j : j + 8, i : i + 8] = np.where(np.tri(8, k=-1), block.T, block) if i == j else block.T


def prefetch(array: Any, *index: int) -> None:
    """Have the cache line of a number fetched that is soon read; it may lie beyond the array."""


def scratch(rows: int, columns: int) -> Any:
    """A matrix to work in, of constant shape and with any numbers in it, until the function ends.

    Compiled, it lies on the stack.
    """
    return np.empty((rows, columns))


def _is_row(array, indices):
    """Whether eight neighbours can be read there at once."""
    plain = isinstance(array, types.Array) and array.dtype == types.float64
    return plain and array.layout == "C" and array.ndim == indices


@infer_global(eight)
class _Eight(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        return signature(EIGHT, array, *whole(index)) if _is_row(array, len(index)) else None


@lower_builtin(eight, types.Array, types.VarArg(types.Any))
def _lower_eight(context, builder, sig, args):
    where = place(context, builder, sig.args[0], args[0], args[1:])
    return builder.load(builder.bitcast(where, EIGHT.value.as_pointer()), align=8)


@infer_global(put_eight)
class _PutEight(AbstractTemplate):
    def generic(self, args, kws):
        array, _, *index = args
        if not _is_row(array, len(index)):
            return None
        return signature(types.none, array, EIGHT, *whole(index))


@lower_builtin(put_eight, types.Array, EIGHT, types.VarArg(types.Any))
def _lower_put_eight(context, builder, sig, args):
    where = place(context, builder, sig.args[0], args[0], args[2:])
    builder.store(args[1], builder.bitcast(where, EIGHT.value.as_pointer()), align=8)
    return context.get_dummy_value()


@infer_global(mirror)
class _Mirror(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        return signature(types.none, array, *whole(index)) if _is_row(array, 2) else None


@lower_builtin(mirror, types.Array, types.intp, types.intp)
def _lower_mirror(context, builder, sig, args):
    array, i, j = args

    def row(first, k, column):
        at_k = builder.add(first, context.get_constant(types.intp, k))
        where = place(context, builder, sig.args[0], array, [at_k, column])
        return builder.bitcast(where, EIGHT.value.as_pointer())

    def mixed(x, y, places):
        indices = ir.Constant(ir.VectorType(ir.IntType(32), 8), places)
        return builder.shuffle_vector(x, y, indices)

    above = [builder.load(row(i, k, j), align=8) for k in range(8)]
    turned = list(above)
    for s in (1, 2, 4):  # blocks of s by s change places across the diagonal of those of 2 s
        for k in (k for k in range(8) if not k & s):
            x, y = turned[k], turned[k + s]
            turned[k] = mixed(x, y, [m + 8 - s if m & s else m for m in range(8)])
            turned[k + s] = mixed(x, y, [m + 8 if m & s else m + s for m in range(8)])
    diagonal = builder.icmp_signed("==", i, j)
    for k in range(8):
        lower = mixed(turned[k], above[k], [m if m < k else m + 8 for m in range(8)])
        builder.store(builder.select(diagonal, lower, turned[k]), row(j, k, i), align=8)
    return context.get_dummy_value()


@infer_global(prefetch)
class _Prefetch(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        return signature(types.none, array, *whole(index)) if _is_row(array, len(index)) else None


@lower_builtin(prefetch, types.Array, types.VarArg(types.Any))
def _lower_prefetch(context, builder, sig, args):
    byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    where = place(context, builder, sig.args[0], args[0], args[1:])
    flags = [ir.Constant(flag, each) for each in (1, 3, 1)]  # to be written, to all caches, data
    builder.call(function, [builder.bitcast(where, byte), *flags])
    return context.get_dummy_value()


@infer_global(scratch)
class _Scratch(AbstractTemplate):
    prefer_literal = True

    def generic(self, args, kws):
        if not all(isinstance(each, types.IntegerLiteral) for each in args):
            return None
        return signature(types.Array(types.float64, 2, "C"), *args)


@lower_builtin(scratch, types.IntegerLiteral, types.IntegerLiteral)
def _lower_scratch(context, builder, sig, args):
    rows, columns = (each.literal_value for each in sig.args)
    numbers = ir.ArrayType(ir.DoubleType(), rows * columns)
    where = cgutils.alloca_once(builder, numbers)
    where.align = 64
    made = make_array(sig.return_type)(context, builder)
    size = [context.get_constant(types.intp, each) for each in (rows, columns, 8 * columns, 8)]
    data = builder.bitcast(where, ir.DoubleType().as_pointer())
    populate_array(made, data, size[:2], size[2:], size[3], None)
    return made._getvalue()
