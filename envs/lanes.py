"""Lanes: eight numbers in one SIMD value, for which the compiler takes the equations unchanged.

A numba type whose machine value is LLVM's vector of eight doubles, with the integers and the
truth values that go with it. Numbers mix with lanes as they do with arrays. The arithmetic is
that of single numbers, in the order written and without fused operations: a lane holds the very
bits that the number alone would have.

Without the compiler there is one lane, a plain number.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.extending import intrinsic, overload, register_model
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

from . import backend
from .backend import config

LANES = 1 if config.DISABLE_JIT else 16
_COUNT = 16
_DOUBLE, _LONG, _BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)


class _Lanes(types.Type):
    """Eight of a kind: "float", "int" or "bool"."""

    def __init__(self, kind: str, each: Any) -> None:
        self.kind, self.each = kind, each
        super().__init__(name=f"lanes({kind})")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """A number stands for eight equal ones; integers become floats."""
        scalars = {
            "float": (types.Number, types.Boolean),
            "int": (types.Integer,),
            "bool": (types.Boolean,),
        }
        if isinstance(other, scalars[self.kind]):
            return Conversion.safe
        return None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """A variable that is a number on one way and lanes on the other is lanes."""
        return self if self.can_convert_from(typingctx, other) is not None else None


FLOATS = _Lanes("float", ir.VectorType(_DOUBLE, _COUNT))
INTS = _Lanes("int", ir.VectorType(_LONG, _COUNT))
BOOLS = _Lanes("bool", ir.VectorType(_BIT, _COUNT))


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: _Lanes) -> None:
        super().__init__(dmm, fe_type, fe_type.each)


def _splat(builder: Any, value: Any, of: ir.VectorType) -> Any:
    one = builder.insert_element(ir.Constant(of, ir.Undefined), value, ir.Constant(_LONG, 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), _COUNT), [0] * _COUNT)
    return builder.shuffle_vector(one, ir.Constant(of, ir.Undefined), zeros)


@lower_cast(types.Number, FLOATS)
@lower_cast(types.Boolean, FLOATS)
def _to_floats(context: Any, builder: Any, fromty: Any, toty: Any, value: Any) -> Any:
    return _splat(builder, context.cast(builder, value, fromty, types.float64), FLOATS.each)


@lower_cast(types.Integer, INTS)
def _to_ints(context: Any, builder: Any, fromty: Any, toty: Any, value: Any) -> Any:
    return _splat(builder, context.cast(builder, value, fromty, types.int64), INTS.each)


@lower_cast(types.Boolean, BOOLS)
def _to_bools(context: Any, builder: Any, fromty: Any, toty: Any, value: Any) -> Any:
    return _splat(builder, value, BOOLS.each)


def _common(args: tuple[Any, ...]) -> Any:
    """The kind of lanes that arguments meet in, or None where none of them is lanes."""
    kinds = [each.kind for each in args if isinstance(each, _Lanes)]
    if not kinds or not all(
        isinstance(each, _Lanes | types.Number | types.Boolean) for each in args
    ):
        return None
    if "float" in kinds or any(isinstance(each, types.Float) for each in args):
        return FLOATS
    return INTS if "int" in kinds else BOOLS


def _operator(
    op: Callable[..., Any], codes: dict[_Lanes, Callable[[Any, Any, Any], Any]], gives: Any = None
) -> None:
    """Teach the compiler `op` for two lanes of each kind in `codes`."""

    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            kind = _common(args)
            if len(args) != 2 or kind not in codes:
                return None
            return signature(gives or kind, kind, kind)

    for kind, code in codes.items():

        def lower(context: Any, builder: Any, sig: Any, args: Any, code: Any = code) -> Any:
            return code(builder, *args)

        lower_builtin(op, kind, kind)(lower)


for _op, _float_code, _int_code in (
    (operator.add, "fadd", "add"),
    (operator.sub, "fsub", "sub"),
    (operator.mul, "fmul", "mul"),
):
    _operator(
        _op,
        {
            FLOATS: lambda b, x, y, code=_float_code: getattr(b, code)(x, y),
            INTS: lambda b, x, y, code=_int_code: getattr(b, code)(x, y),
        },
    )
_operator(operator.truediv, {FLOATS: lambda b, x, y: b.fdiv(x, y)})
for _op, _code in (
    (operator.and_, "and_"),
    (operator.or_, "or_"),
    (operator.xor, "xor"),
):
    _operator(
        _op, {kind: lambda b, x, y, code=_code: getattr(b, code)(x, y) for kind in (INTS, BOOLS)}
    )
_operator(operator.lshift, {INTS: lambda b, x, y: b.shl(x, y)})
_operator(operator.rshift, {INTS: lambda b, x, y: b.ashr(x, y)})
for _op, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _operator(
        _op,
        {
            FLOATS: lambda b, x, y, sign=_sign: (
                b.fcmp_unordered(sign, x, y) if sign == "!=" else b.fcmp_ordered(sign, x, y)
            ),
            INTS: lambda b, x, y, sign=_sign: b.icmp_signed(sign, x, y),
        },
        gives=BOOLS,
    )


@intrinsic
def _pick(typingctx, condition, a, b):  # type: ignore[no-untyped-def]
    whole = isinstance(a, types.Integer) and isinstance(b, types.Integer)
    kind = _common((a, b)) or (INTS if whole else FLOATS)

    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(*args)

    return kind(BOOLS, kind, kind), code


def _machine(name: str) -> Any:
    """One of LLVM's own functions of lanes of floats."""
    name = f"llvm.{name}.v{_COUNT}f64"

    @intrinsic
    def call(typingctx, a):  # type: ignore[no-untyped-def]
        def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
            of = ir.FunctionType(FLOATS.each, [FLOATS.each])
            return builder.call(cgutils.get_or_insert_function(builder.module, of, name), args)

        return FLOATS(FLOATS), code

    return call


_floor, _sqrt, _fabs = _machine("floor"), _machine("sqrt"), _machine("fabs")


@intrinsic
def _to_float(typingctx, a):  # type: ignore[no-untyped-def]
    return FLOATS(INTS), lambda context, builder, sig, args: builder.sitofp(args[0], FLOATS.each)


@intrinsic
def _whole(typingctx, a):  # type: ignore[no-untyped-def]
    return INTS(FLOATS), lambda context, builder, sig, args: builder.fptosi(args[0], INTS.each)


@intrinsic
def _any(typingctx, a):  # type: ignore[no-untyped-def]
    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(args[0], ir.IntType(_COUNT))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(BOOLS), code


def _for_lanes(primitive: Callable[..., Any], text: Callable[..., Any]) -> None:
    """The compiler takes `text` for a primitive where any argument is lanes."""

    @overload(primitive, strict=False)
    def _of(*args):  # type: ignore[no-untyped-def]
        return text if any(isinstance(each, _Lanes) for each in args) else None


_for_lanes(backend.minimum, lambda a, b: _pick(a < b, a, b))
_for_lanes(backend.maximum, lambda a, b: _pick(a > b, a, b))
_for_lanes(backend.absolute, lambda a: _fabs(a))
_for_lanes(backend.floor, lambda a: _floor(a))
_for_lanes(backend.sqrt, lambda a: _sqrt(a))
_for_lanes(backend.select, lambda condition, a, b: _pick(condition, a, b))
_for_lanes(backend.to_float, lambda a: _to_float(a))
_for_lanes(backend.whole, lambda a: _whole(a))
_for_lanes(backend.anywhere, lambda condition: _any(condition))


def _pointer(context: Any, builder: Any, of: Any, array: Any, index: Any) -> Any:
    """Where the lanes at an index of a C-contiguous array lie, whose last axis is the lanes'."""
    made = context.make_array(of)(context, builder, array)
    shape = cgutils.unpack_tuple(builder, made.shape)
    place = ir.Constant(_LONG, 0)
    for size, i in zip(shape[:-1], index, strict=True):
        place = builder.add(builder.mul(place, size), i)
    place = builder.mul(place, ir.Constant(_LONG, _COUNT))
    return builder.bitcast(builder.gep(made.data, [place]), FLOATS.each.as_pointer())


def _of_lanes(array: Any, indices: int) -> bool:
    return isinstance(array, types.Array) and array.ndim == indices + 1 and array.layout == "C"


@intrinsic
def _load(typingctx, array, index):  # type: ignore[no-untyped-def]
    whole = types.UniTuple(types.intp, len(index))

    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        index = cgutils.unpack_tuple(builder, args[1])
        return builder.load(_pointer(context, builder, sig.args[0], args[0], index), align=8)

    return FLOATS(array, whole), code


@intrinsic
def _store(typingctx, array, value, index):  # type: ignore[no-untyped-def]
    whole = types.UniTuple(types.intp, len(index))

    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        index = cgutils.unpack_tuple(builder, args[2])
        where = _pointer(context, builder, sig.args[0], args[0], index)
        builder.store(args[1], where, align=8)
        return context.get_dummy_value()

    return types.void(array, FLOATS, whole), code


@intrinsic
def _store_along(typingctx, array, values, i, j):  # type: ignore[no-untyped-def]
    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        made = context.make_array(sig.args[0])(context, builder, args[0])
        columns = cgutils.unpack_tuple(builder, made.shape)[1]
        place = builder.add(builder.mul(args[2], columns), args[3])
        where = builder.bitcast(builder.gep(made.data, [place]), FLOATS.each.as_pointer())
        builder.store(args[1], where, align=8)
        return context.get_dummy_value()

    return types.void(array, FLOATS, types.intp, types.intp), code


@intrinsic
def _ramp(typingctx, first):  # type: ignore[no-untyped-def]
    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        steps = ir.Constant(INTS.each, list(range(_COUNT)))
        return builder.add(_splat(builder, args[0], INTS.each), steps)

    return INTS(types.int64), code


@intrinsic(prefer_literal=True)
def _tuple_of(typingctx, array, length):  # type: ignore[no-untyped-def]
    size = getattr(length, "literal_value", None)
    if size is None:
        return None

    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        values = []
        for i in range(size):
            index = [ir.Constant(_LONG, i)]
            where = _pointer(context, builder, sig.args[0], args[0], index)
            values.append(builder.load(where, align=8))
        return context.make_tuple(builder, sig.return_type, values)

    return types.UniTuple(FLOATS, size)(array, length), code


@overload(backend.fixed_tuple, prefer_literal=True)
def _fixed_tuple(vector, length):  # type: ignore[no-untyped-def]
    if not _of_lanes(vector, 1) or not hasattr(length, "literal_value"):
        return None
    return lambda vector, length: _tuple_of(vector, length)


@overload(backend.at)
def _at(array, *index):  # type: ignore[no-untyped-def]
    if array.ndim == len(index):
        return lambda array, *index: array[index]
    return (lambda array, *index: _load(array, index)) if _of_lanes(array, len(index)) else None


@overload(backend.of_lane)
def _of_lane(array, lane, *index):  # type: ignore[no-untyped-def]
    if array.ndim == len(index):
        return lambda array, lane, *index: array[index]
    if array.ndim == 3:
        return lambda array, lane, *index: array[index[0], index[1], lane]
    return lambda array, lane, *index: array[index[0], lane]


@overload(backend.put)
def _put(array, value, *index):  # type: ignore[no-untyped-def]
    if array.ndim == len(index):

        def put(array, value, *index):  # type: ignore[no-untyped-def]
            array[index] = value

        return put
    if not _of_lanes(array, len(index)):
        return None
    return lambda array, value, *index: _store(array, value, index)


@intrinsic(prefer_literal=True)
def _store_all(typingctx, array, values, axis, index):  # type: ignore[no-untyped-def]
    if not hasattr(axis, "literal_value"):
        return None  # numba asks again with the literal
    lanes = array.ndim == len(index) + 1

    def code(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind, told = sig.args[0], sig.args[1]
        index = cgutils.unpack_tuple(builder, args[3])
        made = context.make_array(kind)(context, builder, args[0])
        for k, value in enumerate(cgutils.unpack_tuple(builder, args[1])):
            here = list(index)
            here[axis.literal_value] = builder.add(here[axis.literal_value], ir.Constant(_LONG, k))
            if lanes:
                value = context.cast(builder, value, told[k], FLOATS)
                where = _pointer(context, builder, kind, args[0], here)
                builder.store(value, where, align=8)
            else:
                value = context.cast(builder, value, told[k], kind.dtype)
                where = cgutils.get_item_pointer(context, builder, kind, made, here)
                context.pack_value(builder, kind.dtype, value, where)
        return context.get_dummy_value()

    whole = types.UniTuple(types.intp, len(index))
    return types.void(array, values, axis, whole), code


@overload(backend.put_all, prefer_literal=True)
def _put_all(array, values, axis, *index):  # type: ignore[no-untyped-def]
    if not hasattr(axis, "literal_value"):
        return None
    return lambda array, values, axis, *index: _store_all(array, values, axis, index)


@overload(backend.abreast)
def _abreast():  # type: ignore[no-untyped-def]
    return lambda: _COUNT


overload(backend.ramp)(lambda first: lambda first: _ramp(first))


@overload(backend.put_along)
def _put_along(array, values, i, j):  # type: ignore[no-untyped-def]
    return lambda array, values, i, j: _store_along(array, values, i, j)
