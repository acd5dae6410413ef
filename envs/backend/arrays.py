# numba's own types say too little about itself:
# mypy: disable-error-code="no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Numbers and tuples of them in packed arrays, for single cars and for cars abreast.

A single car's numbers lie in a vector or matrix; those of cars abreast have one axis more, the
last, and the same functions read and write lanes there. The compiler is taught them as plain loads
and stores.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.np.arrayobj import load_item, make_array, store_item

from .simd import FLOATS, INTS, LANES, splat


def fixed_tuple(vector: Any, length: int) -> tuple[Any, ...]:
    """The first `length` entries of a vector as a tuple of numbers; `length` is a literal."""
    return tuple(vector[:length].tolist())


def at(array: Any, *index: int) -> Any:
    """The number at an index."""
    return float(array[index])


def of_lane(array: Any, lane: int, *index: int) -> Any:
    """The number of one of the cars abreast; of a single car there is but the first."""
    return float(array[index])


def put(array: Any, value: Any, *index: int) -> None:
    """Write a number."""
    array[index] = value


def put_all(array: Any, values: Any, axis: int, *index: int) -> None:
    """Write a tuple of numbers from an index on along an axis, which is a literal."""
    for k, value in enumerate(values):
        array[tuple(i + k * (a == axis) for a, i in enumerate(index))] = value


def abreast() -> int:
    """How many numbers `ramp` gives and `put_along` writes at once."""
    return 1


def ramp(first: int) -> Any:
    """The whole numbers from `first` on, `abreast` of them."""
    return first


def put_along(array: Any, values: Any, i: int, j: int) -> None:
    """Write `abreast` numbers into the row i of a C-contiguous matrix from the column j on."""
    array[i, j] = values


def _place(context, builder, kind, array, index):
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
    where = _place(context, builder, kind, array, index)
    if kind.ndim > len(index):
        return builder.load(where, align=8)
    return load_item(context, builder, kind, where)


def _write(context, builder, kind, array, index, value, of):
    where = _place(context, builder, kind, array, index)
    if kind.ndim > len(index):
        builder.store(context.cast(builder, value, of, FLOATS), where, align=8)
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


def _whole(index):
    return [types.intp] * len(index)


@infer_global(fixed_tuple)
class _FixedTuple(AbstractTemplate):
    prefer_literal = True

    def generic(self, args, kws):
        vector, length = args
        kind = _kind_of(vector, 1)
        if kind is None or not isinstance(length, types.IntegerLiteral):
            return None  # without the literal numba asks again
        return signature(types.UniTuple(kind, length.literal_value), vector, length)


@lower_builtin(fixed_tuple, types.Array, types.IntegerLiteral)
def _lower_fixed_tuple(context, builder, sig, args):
    """As many loads. numba's `to_fixed_tuple` is a loop over copies of the tuple."""
    index = [context.get_constant(types.intp, i) for i in range(sig.return_type.count)]
    entries = [_read(context, builder, sig.args[0], args[0], [i]) for i in index]
    return context.make_tuple(builder, sig.return_type, entries)


@infer_global(at)
class _At(AbstractTemplate):
    def generic(self, args, kws):
        array, *index = args
        kind = _kind_of(array, len(index))
        return kind and signature(kind, array, *_whole(index))


@lower_builtin(at, types.Array, types.VarArg(types.Any))
def _lower_at(context, builder, sig, args):
    return _read(context, builder, sig.args[0], args[0], args[1:])


@infer_global(of_lane)
class _OfLane(AbstractTemplate):
    def generic(self, args, kws):
        array, _, *index = args
        kind = _kind_of(array, len(index))
        return kind and signature(array.dtype, array, types.intp, *_whole(index))


@lower_builtin(of_lane, types.Array, types.Any, types.VarArg(types.Any))
def _lower_of_lane(context, builder, sig, args):
    kind, (array, lane, *index) = sig.args[0], args
    index = [*index, lane][: kind.ndim]
    return load_item(context, builder, kind, _place(context, builder, kind, array, index))


@infer_global(put)
class _Put(AbstractTemplate):
    def generic(self, args, kws):
        array, value, *index = args
        if _kind_of(array, len(index)) is None:
            return None
        return signature(types.none, array, value, *_whole(index))


@lower_builtin(put, types.Array, types.Any, types.VarArg(types.Any))
def _lower_put(context, builder, sig, args):
    _write(context, builder, sig.args[0], args[0], args[2:], args[1], sig.args[1])
    return context.get_dummy_value()


@infer_global(put_all)
class _PutAll(AbstractTemplate):
    prefer_literal = True

    def generic(self, args, kws):
        array, values, axis, *index = args
        known = isinstance(values, types.BaseTuple) and isinstance(axis, types.IntegerLiteral)
        if not known or _kind_of(array, len(index)) is None:
            return None
        return signature(types.none, array, values, axis, *_whole(index))


@lower_builtin(put_all, types.Array, types.BaseTuple, types.IntegerLiteral, types.VarArg(types.Any))
def _lower_put_all(context, builder, sig, args):
    kind, values, axis = sig.args[0], sig.args[1], sig.args[2].literal_value
    for k, value in enumerate(cgutils.unpack_tuple(builder, args[1])):
        index = list(args[3:])
        index[axis] = builder.add(index[axis], context.get_constant(types.intp, k))
        _write(context, builder, kind, args[0], index, value, values[k])
    return context.get_dummy_value()


@infer_global(abreast)
class _Abreast(AbstractTemplate):
    def generic(self, args, kws):
        return signature(types.intp)


@lower_builtin(abreast)
def _lower_abreast(context, builder, sig, args):
    return context.get_constant(types.intp, LANES)


@infer_global(ramp)
class _Ramp(AbstractTemplate):
    def generic(self, args, kws):
        return signature(INTS, types.int64)


@lower_builtin(ramp, types.int64)
def _lower_ramp(context, builder, sig, args):
    return builder.add(splat(builder, args[0], INTS), ir.Constant(INTS.value, list(range(LANES))))


@infer_global(put_along)
class _PutAlong(AbstractTemplate):
    def generic(self, args, kws):
        array, _, _, _ = args
        matrix = isinstance(array, types.Array) and array.ndim == 2 and array.layout == "C"
        return signature(types.none, array, FLOATS, types.intp, types.intp) if matrix else None


@lower_builtin(put_along, types.Array, FLOATS, types.intp, types.intp)
def _lower_put_along(context, builder, sig, args):
    array, values, i, j = args
    where = _place(context, builder, sig.args[0], array, [i, j])
    builder.store(values, builder.bitcast(where, FLOATS.value.as_pointer()), align=8)
    return context.get_dummy_value()
