# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Loads and stores of eight neighbours of a matrix's row, for the matrices of filters.

In an array (rows, columns) a load moves eight columns. An array (rows, columns, LANES) holds a
matrix of each of eight filters: there it moves one element of all, `vector_width` is 1, and of a
symmetric matrix only the upper triangle counts. The Python bodies serve the first kind alone.

Args:
    array: Matrix or vector, or one of lanes.
    matrix: Symmetric matrix.
    index: Index of the first of eight numbers.
    rows: Number of rows.
    k: Index of a row.
    j: Index of the first of eight columns.
"""

import math
from collections.abc import Sequence

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import signature
from numba.np.arrayobj import make_array, populate_array

from .packed import locate_element
from .primitives import Matrix, Scalar
from .simd import FLOATS, FLOATS8, LANES, register_primitive

_LINE_BYTES = 64  # of a cache line: eight numbers


def load8(array: Matrix, *index: int) -> Scalar:
    """Load eight neighbours of a matrix's row or of a vector."""
    *row, first = index
    return array[(*row, slice(first, first + 8))].copy()


def load8_symmetric(matrix: Matrix, k: int, j: int) -> Scalar:
    """Load eight neighbours of a row of a symmetric matrix."""
    return load8(matrix, k, j)


def count_upper_rows(matrix: Matrix, rows: int, j: int) -> int:
    """Count the rows to process in eight columns: all, or of lanes those above the diagonal."""
    return rows


def store8(array: Matrix, values: Scalar, *index: int) -> None:
    """Store eight numbers, or one number eight times, as neighbours.

    Args:
        array: The matrix or vector.
        values: Eight numbers, or one number.
        index: Index of the first of them.
    """
    *row, first = index
    array[(*row, slice(first, first + 8))] = values


def mirror(array: Matrix, i: int, j: int) -> None:
    """Mirror an 8 x 8 block of a matrix across the diagonal.

    Args:
        array: Matrix whose block is mirrored.
        i: First row of the block.
        j: First column, at least i; where they are equal the upper part is mirrored.
    """
    block = array[i : i + 8, j : j + 8]
    array[j : j + 8, i : i + 8] = np.where(np.tri(8, k=-1), block.T, block) if i == j else block.T


def pad_to_cache_line(fields: Sequence[tuple[object, ...]]) -> np.dtype[np.void]:
    """Pad a structured dtype to whole cache lines.

    Args:
        fields: Its fields, as `numpy.dtype` takes them.
    """
    rest = -np.dtype(list(fields)).itemsize % _LINE_BYTES
    return np.dtype([*fields, *([("to_line_end", np.int8, rest)] if rest else [])])


def allocate_aligned(shape: tuple[int, ...], dtype: np.dtype[np.void]) -> Matrix:
    """Allocate a record array of zeros that begins on a cache line.

    Args:
        shape: Shape of the array.
        dtype: Structured dtype of its records.
    """
    size = math.prod(shape) * dtype.itemsize
    buffer = np.zeros(size + _LINE_BYTES, np.int8)
    first = -buffer.ctypes.data % _LINE_BYTES
    return buffer[first : first + size].view(dtype).reshape(shape).view(np.recarray)


def vector_width(array: Matrix) -> int:
    """Count the columns of a matrix that `load8` reads at once; 1 where they are lanes."""
    return 8


def allocate_scratch(template: Matrix, rows: int, columns: int) -> Matrix:
    """Allocate an uninitialised matrix; where compiled, on the stack until the function ends.

    Args:
        template: Matrix of the same kind, of numbers or of lanes.
        rows: Rows, a constant.
        columns: Columns, a constant.
    """
    return np.empty((rows, columns))


def _find_kind(array, indices):
    """Type of what is loaded at so many indices: eight neighbours, lanes, or None."""
    if not isinstance(array, types.Array) or array.dtype != types.float64 or array.layout != "C":
        return None
    return {0: FLOATS8, 1: FLOATS}.get(array.ndim - indices)


def _lower_vector_width(context, builder, sig, args):
    return context.get_constant(types.intp, 8 if sig.args[0].ndim == 2 else 1)


def _infer_load8(array, *index):
    kind = _find_kind(array, len(index))
    return kind and signature(kind, array, *[types.intp] * len(index))


def _lower_load8(context, builder, sig, args):
    pointer = locate_element(context, builder, sig.args[0], args[0], args[1:])
    return builder.load(builder.bitcast(pointer, sig.return_type.value.as_pointer()), align=8)


def _lower_load8_symmetric(context, builder, sig, args):
    array, k, j = args
    if sig.args[0].ndim == 3:
        above = builder.icmp_signed("<", k, j)
        k, j = builder.select(above, k, j), builder.select(above, j, k)
    return _lower_load8(context, builder, sig, [array, k, j])


def _infer_count_upper_rows(matrix, *index):
    return signature(types.intp, matrix, *[types.intp] * len(index))


def _lower_count_upper_rows(context, builder, sig, args):
    _, rows, j = args
    if sig.args[0].ndim == 2:
        return rows
    below = builder.add(j, context.get_constant(types.intp, 1))
    return builder.select(builder.icmp_signed("<", below, rows), below, rows)


def _infer_store8(array, values, *index):
    kind = _find_kind(array, len(index))
    return kind and signature(types.none, array, kind, *[types.intp] * len(index))


def _lower_store8(context, builder, sig, args):
    pointer = locate_element(context, builder, sig.args[0], args[0], args[2:])
    builder.store(args[1], builder.bitcast(pointer, sig.args[1].value.as_pointer()), align=8)
    return context.get_dummy_value()


def _infer_in_place(array, *index):
    kind = _find_kind(array, len(index))
    return kind and signature(types.none, array, *[types.intp] * len(index))


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


def _infer_scratch(template, *shape):
    is_constant = all(isinstance(size, types.IntegerLiteral) for size in shape)
    made = types.Array(types.float64, template.ndim, "C")
    return signature(made, template, *shape) if is_constant else None


def _lower_scratch(context, builder, sig, args):
    rows, columns = (item.literal_value for item in sig.args[1:])
    shape = [rows, columns] if sig.args[0].ndim == 2 else [rows, columns, LANES]
    with builder.goto_entry_block():  # numba's own way fills it with zeros first
        pointer = builder.alloca(ir.ArrayType(ir.DoubleType(), math.prod(shape)))
    pointer.align = 64
    made, axes = make_array(sig.return_type)(context, builder), len(shape)
    strides = [8 * math.prod(shape[axis + 1 :]) for axis in range(axes)]
    size = [context.get_constant(types.intp, item) for item in (*shape, *strides, 8)]
    data = builder.bitcast(pointer, ir.DoubleType().as_pointer())
    populate_array(made, data, size[:axes], size[axes:-1], size[-1], None)
    return made._getvalue()


register_primitive(vector_width, lambda array: signature(types.intp, array), _lower_vector_width)
register_primitive(load8, _infer_load8, _lower_load8)
register_primitive(load8_symmetric, _infer_load8, _lower_load8_symmetric)
register_primitive(count_upper_rows, _infer_count_upper_rows, _lower_count_upper_rows)
register_primitive(store8, _infer_store8, _lower_store8)
register_primitive(mirror, _infer_in_place, _lower_mirror)
register_primitive(allocate_scratch, _infer_scratch, _lower_scratch, prefer_literal=True)
