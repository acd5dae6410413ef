# numba's own types say too little about itself:
# mypy: disable-error-code="no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Packed arrays: where the numbers of NamedTuples lie in them, and how they are read and written.

A single car's numbers lie in a vector or matrix; those of several cars in SIMD lanes have one axis
more, the last, and the same functions read and write lanes there. Lanes that are written to a
C-contiguous matrix of single numbers go along its row. The compiler is taught them as plain loads
and stores.
"""

from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.np.arrayobj import load_item, make_array, populate_array, store_item

from .simd import FLOATS, INTS, LANES, splat

T = TypeVar("T")


def make_offsets(kind: type[T], start: int = 0) -> tuple[T, int]:
    """Where the numbers of a NamedTuple lie in a packed vector: (its indices, the end).

    Its parts lie one behind the other from `start` on, and each is its own index, so that
    `vector[make_offsets.part.field]` is a number by name. A field is a number, another NamedTuple,
    `Annotated[tuple[part, ...], count]`, so many parts alike, or `Annotated[Any, count]`, so many
    numbers of which the first one's index is enough.
    """
    if hasattr(kind, "_fields"):
        parts = list(get_type_hints(kind, include_extras=True).values())
        make: Any = kind._make  # type: ignore[attr-defined]
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


def read(array: Any, where: T, *index: int) -> T:
    """The numbers of a part of a packed array as a tuple like `where`, its offsets.

    They lie along the first axis, next to each other; `index` is their place on the others.
    """
    first, numbers = where[0], len(where)  # type: ignore[index,arg-type]
    values = array[(slice(first, first + numbers), *index)].tolist()
    make: Any = getattr(where, "_make", tuple)
    return make(values)  # type: ignore[no-any-return]


def write(array: Any, values: Any, where: Any, *index: int) -> None:
    """Write a tuple of numbers to offsets `where`; the rest as in `read`."""
    for place, value in zip(where, values, strict=True):
        array[(place, *index)] = value


def load_element(array: Any, *index: int) -> Any:
    """The number at an index."""
    item: Any = array[index]
    return item.item()


def store_element(array: Any, value: Any, *index: int) -> None:
    """Write a number."""
    array[index] = value


def as_matrix(array: Any, first: int, rows: int, columns: int) -> Any:
    """The numbers of a vector from `first` on as a matrix, without a copy."""
    return array[first : first + rows * columns].reshape(rows, columns)


def as_int64(array: Any, first: int, count: int) -> Any:
    """The place of so many numbers of a vector from `first` on as int64, without a copy."""
    return array[first : first + count].view(np.int64)


def as_float32(array: Any, first: int, count: int) -> Any:
    """The same as float32, two to a number."""
    return array[first : first - (-count // 2)].view(np.float32)[:count]


def lane_width(array: Any) -> int:
    """How many columns of a matrix `along` reads at once; one where they are lanes already."""
    return 1


def load_lanes(array: Any, where: T, first: int) -> T:
    """`read` of a matrix's columns from `first` on, in lanes."""
    return read(array, where, first)


def count_lanes() -> int:
    """How many numbers `ramp` makes at once."""
    return 1


def iota(first: int) -> Any:
    """The whole numbers from `first` on, `lane_count` of them, in lanes."""
    return first


def locate_element(context, builder, kind, array, index):
    """Where the number, or the lanes, at an index of an array lie."""
    made = make_array(kind)(context, builder, array)
    shape = cgutils.unpack_tuple(builder, made.shape)
    strides = cgutils.unpack_tuple(builder, made.strides)
    zeros = [context.get_constant(types.intp, 0)] * (kind.ndim - len(index))
    pointer = cgutils.get_item_pointer2(
        context, builder, made.data, shape, strides, kind.layout, [*index, *zeros]
    )
    if zeros:
        pointer = builder.bitcast(pointer, FLOATS.value.as_pointer())
    return pointer


def _read(context, builder, kind, array, index):
    pointer = locate_element(context, builder, kind, array, index)
    if kind.ndim > len(index):
        return builder.load(pointer, align=8)
    return load_item(context, builder, kind, pointer)


def _write(context, builder, kind, array, index, value, value_type):
    pointer = locate_element(context, builder, kind, array, index)
    if kind.ndim > len(index):
        builder.store(context.cast(builder, value, value_type, FLOATS), pointer, align=8)
    elif value_type == FLOATS and kind.ndim == 2 and kind.layout == "C":
        builder.store(value, builder.bitcast(pointer, FLOATS.value.as_pointer()), align=8)
    else:
        store_item(
            context, builder, kind, context.cast(builder, value, value_type, kind.dtype), pointer
        )


def _find_kind(array, indices):
    """What an array holds at so many indices: numbers, lanes, or None."""
    if not isinstance(array, types.Array):
        return None
    if array.ndim == indices:
        return array.dtype
    lanes = array.ndim == indices + 1 and array.layout == "C" and array.dtype == types.float64
    return FLOATS if lanes else None


def make_index_types(index):
    """The types of an index."""
    return [types.intp] * len(index)


@infer_global(read)
class _Read(AbstractTemplate):
    def generic(self, args, kws):
        array, where, *index = args
        kind = _find_kind(array, 1 + len(index))
        if kind is None or not isinstance(where, types.BaseTuple):
            return None
        numbers = [kind] * len(where)
        made = types.BaseTuple.from_types(numbers, getattr(where, "instance_class", None))
        return signature(made, array, where, *make_index_types(index))


@lower_builtin(read, types.Array, types.BaseTuple, types.VarArg(types.Any))
def _lower_read(context, builder, sig, args):
    places = cgutils.unpack_tuple(builder, args[1])
    entries = [_read(context, builder, sig.args[0], args[0], [i, *args[2:]]) for i in places]
    return context.make_tuple(builder, sig.return_type, entries)


@infer_global(load_element)
class _LoadElement(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        kind = _find_kind(array, len(index))
        return kind and signature(kind, array, *make_index_types(index))


@lower_builtin(load_element, types.Array, types.VarArg(types.Any))
def _lower_load_element(context, builder, sig, args):
    return _read(context, builder, sig.args[0], args[0], args[1:])


@infer_global(store_element)
class _StoreElement(AbstractTemplate):
    def generic(self, args, kws):
        array, value, *index = args
        if _find_kind(array, len(index)) is None:
            return None
        return signature(types.none, array, value, *make_index_types(index))


@lower_builtin(store_element, types.Array, types.Any, types.VarArg(types.Any))
def _lower_store_element(context, builder, sig, args):
    _write(context, builder, sig.args[0], args[0], args[2:], args[1], sig.args[1])
    return context.get_dummy_value()


@infer_global(write)
class _Write(AbstractTemplate):
    def generic(self, args, kws):
        array, values, where, *index = args
        tuples = isinstance(values, types.BaseTuple) and isinstance(where, types.BaseTuple)
        if not tuples or len(values) != len(where) or _find_kind(array, 1 + len(index)) is None:
            return None
        return signature(types.none, array, values, where, *make_index_types(index))


@lower_builtin(write, types.Array, types.BaseTuple, types.BaseTuple, types.VarArg(types.Any))
def _lower_write(context, builder, sig, args):
    kind, of = sig.args[0], sig.args[1]
    values, places = (cgutils.unpack_tuple(builder, packed) for packed in args[1:3])
    for k, (i, value) in enumerate(zip(places, values, strict=True)):
        _write(context, builder, kind, args[0], [i, *args[3:]], value, of[k])
    return context.get_dummy_value()


def _register_view(primitive: Any, dtype: Any) -> None:
    """Teach the compiler a view of a vector's numbers, of a kind and a shape."""
    axes = primitive.__code__.co_argcount - 2
    kind = types.Array(dtype, axes, "C")

    @infer_global(primitive)
    class _ViewTyping(AbstractTemplate):
        def generic(self, args, kws):
            vector = types.Array(types.float64, 1, "C")
            return (
                signature(kind, vector, *make_index_types(args[1:])) if args[0] == vector else None
            )

    def lower(context, builder, sig, args):
        size = context.get_constant(types.intp, dtype.bitwidth // 8)
        made = make_array(kind)(context, builder)
        pointer = builder.bitcast(
            locate_element(context, builder, sig.args[0], args[0], [args[1]]), made.data.type
        )
        strides = [builder.mul(size, size_of_axis) for size_of_axis in args[3:]] + [size]
        populate_array(made, pointer, args[2:], strides, size, None)
        return made._getvalue()

    lower_builtin(primitive, types.Array, *[types.Integer] * (axes + 1))(lower)


_register_view(as_matrix, types.float64)
_register_view(as_int64, types.int64)
_register_view(as_float32, types.float32)


@infer_global(lane_width)
class _LaneWidth(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp, *args)


@lower_builtin(lane_width, types.Array)
def _lower_lane_width(context, builder, sig, args):
    return context.get_constant(types.intp, LANES if sig.args[0].ndim == 2 else 1)


@infer_global(load_lanes)
class _LoadLanes(AbstractTemplate):
    def generic(self, args, kws):
        made = types.BaseTuple.from_types([FLOATS] * len(args[1]), args[1].instance_class)
        return signature(made, *args[:2], types.intp)


@lower_builtin(load_lanes, types.Array, types.BaseTuple, types.Integer)
def _lower_load_lanes(context, builder, sig, args):
    places = [[i, args[2]] for i in cgutils.unpack_tuple(builder, args[1])]
    firsts = [locate_element(context, builder, sig.args[0], args[0], index) for index in places]
    lanes = [builder.bitcast(first, FLOATS.value.as_pointer()) for first in firsts]
    entries = [builder.load(pointer, align=8) for pointer in lanes]
    return context.make_tuple(builder, sig.return_type, entries)


@infer_global(count_lanes)
class _CountLanes(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp)


@lower_builtin(count_lanes)
def _lower_count_lanes(context, builder, sig, args):
    return context.get_constant(types.intp, LANES)


@infer_global(iota)
class _Iota(AbstractTemplate):
    def generic(self, args, kws):
        return signature(INTS, types.int64)


@lower_builtin(iota, types.int64)
def _lower_iota(context, builder, sig, args):
    return builder.add(splat(builder, args[0], INTS), ir.Constant(INTS.value, list(range(LANES))))
