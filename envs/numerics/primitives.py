# numba's own types say too little about itself:
# mypy: disable-error-code="no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""The primitives: the functions that the equations use beside + - * /.

Each kind of number has a table of them by name. The functions here serve Python floats; compiled,
single numbers and lanes take the same instructions.
"""

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import signature

from .simd import (
    BOOLS,
    FLOATS,
    INTS,
    LANES,
    LaneType,
    compare,
    find_common_type,
    register_primitive,
)

Scalar: TypeAlias = Any
"""One number a car: a float, lanes of a SIMD register, an array, a tensor or a symbol."""
Vector: TypeAlias = Any
"""Numbers in one axis, of any of these kinds."""
Matrix: TypeAlias = Any
"""Numbers in two axes or more."""


def minimum(a: Scalar, b: Scalar) -> Scalar:
    """The smaller of two numbers."""
    return a if a < b else b


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """The larger of two numbers."""
    return a if a > b else b


def absolute(a: Scalar) -> Scalar:
    """Compute |a|."""
    return math.fabs(a)


def floor(a: Scalar) -> Scalar:
    """The largest whole number at or below a, as a float."""
    return math.floor(a) * 1.0


def sqrt(a: Scalar) -> Scalar:
    """The square root, correctly rounded."""
    return math.sqrt(a)


def select(condition: Scalar, a: Scalar, b: Scalar) -> Scalar:
    """a where the condition holds, else b (both are evaluated)."""
    return a if condition else b


def to_float(a: Scalar) -> Scalar:
    """Convert an integer to a float."""
    return a * 1.0


def frexp(a: Scalar) -> Scalar:
    """Split a positive number into (m, e), a = m 2^e with 0.5 <= m < 1, both floats."""
    m, e = math.frexp(a)
    return m, e * 1.0


def to_int(a: Scalar) -> Scalar:
    """Convert a float that is a whole number to an integer."""
    return int(a)


def to_word(a: Any) -> Any:
    """Convert a float to a 32-bit word: its value, or its bits where floats have 32 bits."""
    return int(a)


def from_word(a: Any) -> Any:
    """Convert a 32-bit word to the float that stands for it."""
    return a * 1.0


def any_lane(condition: Scalar) -> Scalar:
    """Check whether a condition holds for any of the cars in the lanes."""
    return condition


ARRAYS: dict[str, Callable[..., Any]] = {
    "minimum": np.minimum,
    "maximum": np.maximum,
    "absolute": np.absolute,
    "floor": np.floor,
    "sqrt": np.sqrt,
    "select": np.where,
    "to_float": lambda a: np.multiply(a, 1.0),
    "frexp": lambda a: np.multiply(np.frexp(a), 1.0),
    "to_int": lambda a: np.asarray(a).astype(np.int64),
    "any_lane": np.any,
}
"""The primitives for NumPy arrays, by the names the equations use."""

_LANE_TYPES = {types.float64: FLOATS, types.int64: INTS, types.boolean: BOOLS}


def _infer_binary(a, b):
    kind = find_common_type((a, b))
    return kind and signature(kind, kind, kind)


def _infer_float(a):
    kind = find_common_type((a,))
    if kind is None:
        return None
    kind = FLOATS if isinstance(kind, LaneType) else types.float64
    return signature(kind, kind)


def _infer_frexp(a):
    unary = _infer_float(a)
    return unary and signature(types.UniTuple(unary.return_type, 2), *unary.args)


def _infer_select(condition, a, b):
    kind, condition_type = find_common_type((a, b)), BOOLS if condition is BOOLS else types.boolean
    if kind is None or not isinstance(condition, types.Boolean | LaneType):
        return None
    if condition_type is BOOLS:
        kind = _LANE_TYPES.get(kind, kind)
    return signature(kind, condition_type, kind, kind)


def _make_conversion(to: types.Type, to_lanes: LaneType) -> Callable[..., Any]:
    def infer(a):
        kind = find_common_type((a,))
        return kind and signature(to_lanes if isinstance(kind, LaneType) else to, kind)

    return infer


def _make_intrinsic(name: str) -> Callable[..., Any]:
    """Make the call of LLVM's function of a float or of lanes of them."""

    def lower(context, builder, sig, args):
        operand_type = args[0].type
        suffix = f"v{LANES}f64" if isinstance(operand_type, ir.VectorType) else "f64"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(operand_type, [operand_type]), f"llvm.{name}.{suffix}"
        )
        return builder.call(function, args)

    return lower


def _make_selection(sign: str) -> Callable[..., Any]:
    """Make the selection of a where `a sign b` holds, else b."""
    codes = compare(sign)

    def lower(context, builder, sig, args):
        kind = FLOATS if sig.args[0] in (FLOATS, types.float64) else INTS
        return builder.select(codes[kind](builder, *args), *args)

    return lower


def _lower_select(context, builder, sig, args):
    return builder.select(*args)


def _lower_to_float(context, builder, sig, args):
    if sig.args[0] in (FLOATS, types.float64):
        return args[0]
    to = FLOATS.value if sig.return_type is FLOATS else ir.DoubleType()
    return builder.sitofp(args[0], to)


def _lower_to_int(context, builder, sig, args):
    if sig.args[0] in (INTS, types.int64):
        return args[0]
    to = INTS.value if sig.return_type is INTS else ir.IntType(64)
    return builder.fptosi(args[0], to)


def _lower_frexp(context, builder, sig, args):
    """(m, e) of a normal number: its fraction with the exponent of 0.5, and its exponent."""
    kind, operand_type = sig.args[0], args[0].type
    ints = INTS.value if kind is FLOATS else ir.IntType(64)

    def make_constant(value):
        return ir.Constant(ints, [value] * LANES if kind is FLOATS else value)

    bits = builder.bitcast(args[0], ints)
    digits = builder.and_(bits, make_constant((1 << 52) - 1))
    fraction = builder.or_(digits, make_constant(1022 << 52))
    exponent = builder.sub(builder.lshr(bits, make_constant(52)), make_constant(1022))
    m, e = builder.bitcast(fraction, operand_type), builder.sitofp(exponent, operand_type)
    return cgutils.pack_array(builder, [m, e])


def _lower_any_lane(context, builder, sig, args):
    if sig.args[0] is not BOOLS:
        return args[0]
    bits = builder.bitcast(args[0], ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


register_primitive(minimum, _infer_binary, _make_selection("<"))
register_primitive(maximum, _infer_binary, _make_selection(">"))
register_primitive(absolute, _infer_float, _make_intrinsic("fabs"))
register_primitive(floor, _infer_float, _make_intrinsic("floor"))
register_primitive(sqrt, _infer_float, _make_intrinsic("sqrt"))
register_primitive(select, _infer_select, _lower_select)
register_primitive(to_float, _make_conversion(types.float64, FLOATS), _lower_to_float)
register_primitive(frexp, _infer_frexp, _lower_frexp)
register_primitive(to_int, _make_conversion(types.int64, INTS), _lower_to_int)
register_primitive(to_word, _make_conversion(types.int64, INTS), _lower_to_int)
register_primitive(from_word, _make_conversion(types.float64, FLOATS), _lower_to_float)
register_primitive(
    any_lane,
    lambda a: signature(types.boolean, BOOLS if a is BOOLS else types.boolean),
    _lower_any_lane,
)
