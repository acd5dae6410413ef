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


def offsets(kind: type[T], start: int = 0) -> tuple[T, int]:
    """Where the numbers of a NamedTuple lie in a packed vector: (its indices, the end).

    Its parts lie one behind the other from `start` on, and each is its own index, so that
    `vector[offsets.part.field]` is a number by name. A field is a number, another NamedTuple,
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
    where = []
    for part in parts:
        found, start = offsets(part, start)
        where.append(found)
    return make(where), start


def read(array: Any, where: T, *index: int) -> T:
    """The numbers of a part of a packed array as a tuple like `where`, its offsets.

    They lie along the first axis, next to each other; `index` is their place on the others.
    """
    first, numbers = where[0], len(where)  # type: ignore[index,arg-type]
    found = array[(slice(first, first + numbers), *index)].tolist()
    make: Any = getattr(where, "_make", tuple)
    return make(found)  # type: ignore[no-any-return]


def write(array: Any, values: Any, where: Any, *index: int) -> None:
    """Write a tuple of numbers to offsets `where`; the rest as in `read`."""
    for place, value in zip(where, values, strict=True):
        array[(place, *index)] = value


def at(array: Any, *index: int) -> Any:
    """The number at an index."""
    found: Any = array[index]
    return found.item()


def put(array: Any, value: Any, *index: int) -> None:
    """Write a number."""
    array[index] = value


def matrix(array: Any, first: int, rows: int, columns: int) -> Any:
    """The numbers of a vector from `first` on as a matrix, without a copy."""
    return array[first : first + rows * columns].reshape(rows, columns)


def integers(array: Any, first: int, count: int) -> Any:
    """The place of so many numbers of a vector from `first` on as int64, without a copy."""
    return array[first : first + count].view(np.int64)


def singles(array: Any, first: int, count: int) -> Any:
    """The same as float32, two to a number."""
    return array[first : first - (-count // 2)].view(np.float32)[:count]


def abreast(array: Any) -> int:
    """How many columns of a matrix `along` reads at once; one where they are lanes already."""
    return 1


def along(array: Any, where: T, first: int) -> T:
    """`read` of a matrix's columns from `first` on, in lanes."""
    return read(array, where, first)


def lane_count() -> int:
    """How many numbers `ramp` makes at once."""
    return 1


def ramp(first: int) -> Any:
    """The whole numbers from `first` on, `lane_count` of them, in lanes."""
    return first


def place(context, builder, kind, array, index):
    """Where the number, or the lanes, at an index of an array lie."""
    made = make_array(kind)(context, builder, array)
    shape = cgutils.unpack_tuple(builder, made.shape)
    strides = cgutils.unpack_tuple(builder, made.strides)
    zero = [context.get_constant(types.intp, 0)] * (kind.ndim - len(index))
    where = cgutils.get_item_pointer2(
        context, builder, made.data, shape, strides, kind.layout, [*index, *zero]
    )
    if zero:
        where = builder.bitcast(where, FLOATS.value.as_pointer())
    return where


def _read(context, builder, kind, array, index):
    where = place(context, builder, kind, array, index)
    if kind.ndim > len(index):
        return builder.load(where, align=8)
    return load_item(context, builder, kind, where)


def _write(context, builder, kind, array, index, value, of):
    where = place(context, builder, kind, array, index)
    if kind.ndim > len(index):
        builder.store(context.cast(builder, value, of, FLOATS), where, align=8)
    elif of == FLOATS and kind.ndim == 2 and kind.layout == "C":
        builder.store(value, builder.bitcast(where, FLOATS.value.as_pointer()), align=8)
    else:
        store_item(context, builder, kind, context.cast(builder, value, of, kind.dtype), where)


def _kind_of(array, indices):
    """What an array holds at so many indices: numbers, lanes, or None."""
    if not isinstance(array, types.Array):
        return None
    if array.ndim == indices:
        return array.dtype
    lanes = array.ndim == indices + 1 and array.layout == "C" and array.dtype == types.float64
    return FLOATS if lanes else None


def whole(index):
    """The types of an index."""
    return [types.intp] * len(index)


@infer_global(read)
class _Read(AbstractTemplate):
    def generic(self, args, kws):
        array, where, *index = args
        kind = _kind_of(array, 1 + len(index))
        if kind is None or not isinstance(where, types.BaseTuple):
            return None
        numbers = [kind] * len(where)
        made = types.BaseTuple.from_types(numbers, getattr(where, "instance_class", None))
        return signature(made, array, where, *whole(index))


@lower_builtin(read, types.Array, types.BaseTuple, types.VarArg(types.Any))
def _lower_read(context, builder, sig, args):
    places = cgutils.unpack_tuple(builder, args[1])
    entries = [_read(context, builder, sig.args[0], args[0], [i, *args[2:]]) for i in places]
    return context.make_tuple(builder, sig.return_type, entries)


@infer_global(at)
class _At(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        kind = _kind_of(array, len(index))
        return kind and signature(kind, array, *whole(index))


@lower_builtin(at, types.Array, types.VarArg(types.Any))
def _lower_at(context, builder, sig, args):
    return _read(context, builder, sig.args[0], args[0], args[1:])


@infer_global(put)
class _Put(AbstractTemplate):
    def generic(self, args, kws):
        array, value, *index = args
        if _kind_of(array, len(index)) is None:
            return None
        return signature(types.none, array, value, *whole(index))


@lower_builtin(put, types.Array, types.Any, types.VarArg(types.Any))
def _lower_put(context, builder, sig, args):
    _write(context, builder, sig.args[0], args[0], args[2:], args[1], sig.args[1])
    return context.get_dummy_value()


@infer_global(write)
class _Write(AbstractTemplate):
    def generic(self, args, kws):
        array, values, where, *index = args
        tuples = isinstance(values, types.BaseTuple) and isinstance(where, types.BaseTuple)
        if not tuples or len(values) != len(where) or _kind_of(array, 1 + len(index)) is None:
            return None
        return signature(types.none, array, values, where, *whole(index))


@lower_builtin(write, types.Array, types.BaseTuple, types.BaseTuple, types.VarArg(types.Any))
def _lower_write(context, builder, sig, args):
    kind, of = sig.args[0], sig.args[1]
    values, places = (cgutils.unpack_tuple(builder, each) for each in args[1:3])
    for k, (i, value) in enumerate(zip(places, values, strict=True)):
        _write(context, builder, kind, args[0], [i, *args[3:]], value, of[k])
    return context.get_dummy_value()


def _teach_view(primitive: Any, of: Any) -> None:
    """Teach the compiler a view of a vector's numbers, of a kind and a shape."""
    axes = primitive.__code__.co_argcount - 2
    kind = types.Array(of, axes, "C")

    @infer_global(primitive)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            vector = types.Array(types.float64, 1, "C")
            return signature(kind, vector, *whole(args[1:])) if args[0] == vector else None

    def lower(context, builder, sig, args):
        size = context.get_constant(types.intp, of.bitwidth // 8)
        made = make_array(kind)(context, builder)
        pointer = builder.bitcast(
            place(context, builder, sig.args[0], args[0], [args[1]]), made.data.type
        )
        strides = [builder.mul(size, each) for each in args[3:]] + [size]
        populate_array(made, pointer, args[2:], strides, size, None)
        return made._getvalue()

    lower_builtin(primitive, types.Array, *[types.Integer] * (axes + 1))(lower)


_teach_view(matrix, types.float64)
_teach_view(integers, types.int64)
_teach_view(singles, types.float32)


@infer_global(abreast)
class _Abreast(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp, *args)


@lower_builtin(abreast, types.Array)
def _lower_abreast(context, builder, sig, args):
    return context.get_constant(types.intp, LANES if sig.args[0].ndim == 2 else 1)


@infer_global(along)
class _Along(AbstractTemplate):
    def generic(self, args, kws):
        made = types.BaseTuple.from_types([FLOATS] * len(args[1]), args[1].instance_class)
        return signature(made, *args[:2], types.intp)


@lower_builtin(along, types.Array, types.BaseTuple, types.Integer)
def _lower_along(context, builder, sig, args):
    places = [[i, args[2]] for i in cgutils.unpack_tuple(builder, args[1])]
    firsts = [place(context, builder, sig.args[0], args[0], index) for index in places]
    lanes = [builder.bitcast(first, FLOATS.value.as_pointer()) for first in firsts]
    entries = [builder.load(each, align=8) for each in lanes]
    return context.make_tuple(builder, sig.return_type, entries)


@infer_global(lane_count)
class _LaneCount(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp)


@lower_builtin(lane_count)
def _lower_lane_count(context, builder, sig, args):
    return context.get_constant(types.intp, LANES)


@infer_global(ramp)
class _Ramp(AbstractTemplate):
    def generic(self, args, kws):
        return signature(INTS, types.int64)


@lower_builtin(ramp, types.int64)
def _lower_ramp(context, builder, sig, args):
    return builder.add(splat(builder, args[0], INTS), ir.Constant(INTS.value, list(range(LANES))))
