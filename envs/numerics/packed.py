# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Packed arrays: the offsets of a NamedTuple's numbers in an array, and their loads and stores.

A single car's numbers lie in a vector or matrix; those of several cars in SIMD lanes have one axis
more, the last, and the same functions read and write lanes there. Lanes that are written to a
C-contiguous matrix of single numbers go along its row.

The matrices of filters are moved by eight columns at a time. An array (rows, columns, LANES) holds
a matrix of each of eight filters: there `load8` moves one element of all, `vector_width` is 1, and
of a symmetric matrix only the upper triangle counts. Python's bodies serve single matrices alone.

Args:
    array: Vector, matrix or an array of lanes, with one axis more.
    where: Offsets of numbers, a NamedTuple or a tuple.
    index: Place on the array's axes, those behind `where`'s in `read` and `write`; of eight numbers
        that of the first.
    value: Number to store.
    values: Numbers to store, a tuple like `where`; in `store8` eight, or one for all of them.
    first: First of the `lane_width(array)` columns.
    matrix: Symmetric matrix.
    rows: Number of rows.
    k: Index of a row.
    j: Index of the first of eight columns.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import signature
from numba.np.arrayobj import load_item, make_array, populate_array, store_item

from .primitives import Matrix, Scalar, Vector
from .simd import FLOATS, FLOATS8, INTS, LANES, register_primitive

T = TypeVar("T")
_LINE_BYTES = 64  # of a cache line: eight numbers


def make_offsets(kind: type[T], start: int = 0) -> tuple[T, int]:
    """Make (offsets, end) of a NamedTuple in a packed `vector`, as in `vector[offsets.part.field]`.

    Args:
        kind: The NamedTuple. A field is a number, another NamedTuple, `count` equal parts as
            `Annotated[tuple[part, ...], count]`, or `count` numbers as `Annotated[Vector, count]`,
            of which only the first one's offset is stored.
        start: Offset of the first number.
    """
    if hasattr(kind, "_fields"):
        parts = list(get_type_hints(kind, include_extras=True).values())
        make: Any = kind._make
    elif get_origin(kind) is Annotated:
        (alike, count), make = get_args(kind), tuple
        if get_origin(alike) is not tuple:
            return start, start + count  # type: ignore[return-value]
        parts = [get_args(alike)[0]] * count
    else:
        return start, start + 1  # type: ignore[return-value]
    indices = []
    for part in parts:
        part_indices, start = make_offsets(part, start)
        indices.append(part_indices)
    return make(indices), start


def read(array: Vector, where: T, *index: int) -> T:
    """Read neighbours along the first axis of a packed array, in a tuple like `where`."""
    first, numbers = where[0], len(where)  # type: ignore[index,arg-type]
    values = array[(slice(first, first + numbers), *index)].tolist()
    make: Any = getattr(where, "_make", tuple)
    return make(values)  # type: ignore[no-any-return]


def write(array: Vector, values: tuple[Scalar, ...], where: tuple[int, ...], *index: int) -> None:
    """Write numbers along the first axis of a packed array."""
    for place, value in zip(where, values, strict=True):
        array[(place, *index)] = value


def load_element(array: Vector, *index: int) -> Scalar:
    """Load a number of an array."""
    return array[index].item()


def store_element(array: Vector, value: Scalar, *index: int) -> None:
    """Store a number in an array."""
    array[index] = value


def lane_width(array: Matrix) -> int:
    """Count the columns of a matrix that `load_lanes` reads at once; 1 where they are lanes."""
    return 1


def load_lanes(array: Matrix, where: T, first: int) -> T:
    """Read neighbouring columns of a matrix into lanes, in a tuple like `where`."""
    return read(array, where, first)


def count_lanes() -> int:
    """Count the numbers that `iota` makes at once."""
    return 1


def iota(first: int) -> Scalar:
    """Make lanes of `count_lanes()` consecutive whole numbers."""
    return first


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
    """Store eight numbers, or one number eight times, as neighbours."""
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


def _locate_element(context, builder, kind, array, index):
    """Pointer to an array's number, or to lanes where the index leaves out the last axis."""
    made = make_array(kind)(context, builder, array)
    shape = cgutils.unpack_tuple(builder, made.shape)
    strides = cgutils.unpack_tuple(builder, made.strides)
    zeros = [context.get_constant(types.intp, 0)] * (kind.ndim - len(index))
    axes = shape, strides, kind.layout, [*index, *zeros]
    pointer = cgutils.get_item_pointer2(context, builder, made.data, *axes)
    return builder.bitcast(pointer, FLOATS.value.as_pointer()) if zeros else pointer


def _read(context, builder, kind, array, index):
    pointer = _locate_element(context, builder, kind, array, index)
    if kind.ndim > len(index):
        return builder.load(pointer, align=8)
    return load_item(context, builder, kind, pointer)


def _write(context, builder, kind, array, index, value, value_type):
    pointer = _locate_element(context, builder, kind, array, index)
    if kind.ndim > len(index):
        builder.store(context.cast(builder, value, value_type, FLOATS), pointer, align=8)
    elif value_type == FLOATS and kind.ndim == 2 and kind.layout == "C":
        builder.store(value, builder.bitcast(pointer, FLOATS.value.as_pointer()), align=8)
    else:
        number = context.cast(builder, value, value_type, kind.dtype)
        store_item(context, builder, kind, number, pointer)


def _find_kind(array, indices):
    """Type of an array's entry at so many indices: a number, lanes, or None."""
    if not isinstance(array, types.Array):
        return None
    if array.ndim == indices:
        return array.dtype
    lanes = array.ndim == indices + 1 and array.layout == "C" and array.dtype == types.float64
    return FLOATS if lanes else None


def _infer_read(array, where, *index):
    kind = _find_kind(array, 1 + len(index))
    if kind is None or not isinstance(where, types.BaseTuple):
        return None
    numbers = [kind] * len(where)
    made = types.BaseTuple.from_types(numbers, getattr(where, "instance_class", None))
    return signature(made, array, where, *[types.intp] * len(index))


def _lower_read(context, builder, sig, args):
    places = cgutils.unpack_tuple(builder, args[1])
    entries = [_read(context, builder, sig.args[0], args[0], [i, *args[2:]]) for i in places]
    return context.make_tuple(builder, sig.return_type, entries)


def _infer_load_element(array, *index):
    kind = _find_kind(array, len(index))
    return kind and signature(kind, array, *[types.intp] * len(index))


def _lower_load_element(context, builder, sig, args):
    return _read(context, builder, sig.args[0], args[0], args[1:])


def _infer_store_element(array, value, *index):
    kind = _find_kind(array, len(index))
    return kind and signature(types.none, array, value, *[types.intp] * len(index))


def _lower_store_element(context, builder, sig, args):
    _write(context, builder, sig.args[0], args[0], args[2:], args[1], sig.args[1])
    return context.get_dummy_value()


def _infer_write(array, values, where, *index):
    tuples = isinstance(values, types.BaseTuple) and isinstance(where, types.BaseTuple)
    if not tuples or len(values) != len(where) or _find_kind(array, 1 + len(index)) is None:
        return None
    return signature(types.none, array, values, where, *[types.intp] * len(index))


def _lower_write(context, builder, sig, args):
    kind, of = sig.args[0], sig.args[1]
    values, places = (cgutils.unpack_tuple(builder, packed) for packed in args[1:3])
    for k, (i, value) in enumerate(zip(places, values, strict=True)):
        _write(context, builder, kind, args[0], [i, *args[3:]], value, of[k])
    return context.get_dummy_value()


def _lower_lane_width(context, builder, sig, args):
    return context.get_constant(types.intp, LANES if sig.args[0].ndim == 2 else 1)


def _infer_load_lanes(array, where, first):
    made = types.BaseTuple.from_types([FLOATS] * len(where), where.instance_class)
    return signature(made, array, where, types.intp)


def _lower_load_lanes(context, builder, sig, args):
    entries = []
    for i in cgutils.unpack_tuple(builder, args[1]):
        first = _locate_element(context, builder, sig.args[0], args[0], [i, args[2]])
        entries.append(builder.load(builder.bitcast(first, FLOATS.value.as_pointer()), align=8))
    return context.make_tuple(builder, sig.return_type, entries)


def _lower_count_lanes(context, builder, sig, args):
    return context.get_constant(types.intp, LANES)


def _lower_iota(context, builder, sig, args):
    first = context.cast(builder, args[0], types.int64, INTS)
    return builder.add(first, ir.Constant(INTS.value, list(range(LANES))))


def _lower_vector_width(context, builder, sig, args):
    return context.get_constant(types.intp, 8 if sig.args[0].ndim == 2 else 1)


def _find_kind8(array, indices):
    """Type of what is loaded at so many indices: eight neighbours, lanes, or None."""
    if not isinstance(array, types.Array) or array.dtype != types.float64 or array.layout != "C":
        return None
    return {0: FLOATS8, 1: FLOATS}.get(array.ndim - indices)


def _infer_load8(array, *index):
    kind = _find_kind8(array, len(index))
    return kind and signature(kind, array, *[types.intp] * len(index))


def _lower_load8(context, builder, sig, args):
    pointer = _locate_element(context, builder, sig.args[0], args[0], args[1:])
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
    kind = _find_kind8(array, len(index))
    return kind and signature(types.none, array, kind, *[types.intp] * len(index))


def _lower_store8(context, builder, sig, args):
    pointer = _locate_element(context, builder, sig.args[0], args[0], args[2:])
    builder.store(args[1], builder.bitcast(pointer, sig.args[1].value.as_pointer()), align=8)
    return context.get_dummy_value()


def _infer_in_place(array, *index):
    kind = _find_kind8(array, len(index))
    return kind and signature(types.none, array, *[types.intp] * len(index))


def _lower_mirror(context, builder, sig, args):
    array, i, j = args
    if sig.args[0].ndim == 3:
        return context.get_dummy_value()

    def locate_row(first, k, column):
        at_k = builder.add(first, context.get_constant(types.intp, k))
        pointer = _locate_element(context, builder, sig.args[0], array, [at_k, column])
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


register_primitive(read, _infer_read, _lower_read)
register_primitive(write, _infer_write, _lower_write)
register_primitive(load_element, _infer_load_element, _lower_load_element)
register_primitive(store_element, _infer_store_element, _lower_store_element)
register_primitive(lane_width, lambda array: signature(types.intp, array), _lower_lane_width)
register_primitive(load_lanes, _infer_load_lanes, _lower_load_lanes)
register_primitive(count_lanes, lambda: signature(types.intp), _lower_count_lanes)
register_primitive(iota, lambda first: signature(INTS, types.int64), _lower_iota)
register_primitive(vector_width, lambda array: signature(types.intp, array), _lower_vector_width)
register_primitive(load8, _infer_load8, _lower_load8)
register_primitive(load8_symmetric, _infer_load8, _lower_load8_symmetric)
register_primitive(count_upper_rows, _infer_count_upper_rows, _lower_count_upper_rows)
register_primitive(store8, _infer_store8, _lower_store8)
register_primitive(mirror, _infer_in_place, _lower_mirror)
register_primitive(allocate_scratch, _infer_scratch, _lower_scratch, prefer_literal=True)
