# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""SIMD lanes: numba types whose machine value is LLVM's vector of doubles, integers or bools.

The equations compile for them unchanged, in the order written and without fused operations: a lane
has the bits that its number alone would have. Single numbers mix with lanes as with arrays. There
are sixteen with AVX-512 (two registers, a third faster than one) and eight elsewhere. `FLOATS8`,
eight neighbours of a matrix's row, serves the small matrices of a single filter.
"""

import inspect
import operator
from collections.abc import Callable

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.extending import register_model
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.registry import cpu_target
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, Signature, infer_global, signature

from . import primitives

_FEATURES = cpu_target.target_context.codegen().magic_tuple()[2]  # by which kernels are kept, too
LANES = 16 if "+avx512f" in _FEATURES else 8
_DOUBLE, _LONG, _BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)


class _LaneType(types.Type):
    """The type of `count` numbers of one kind, to which a number of some kinds is converted."""

    def __init__(
        self, kind: str, one: ir.Type, single: types.Type, *taken: type, count: int = LANES
    ) -> None:
        self.value, self.single, self._taken = ir.VectorType(one, count), single, taken
        super().__init__(name=f"lanes({kind})")

    def can_convert_from(self, typingctx, other):
        """Convert a number to equal lanes; integers become floats."""
        return Conversion.safe if isinstance(other, self._taken) else None

    def unify(self, typingctx, other):
        """Unify a variable that is a number on one branch and lanes on the other: lanes."""
        return self if isinstance(other, self._taken) else None


FLOATS = _LaneType("float", _DOUBLE, types.float64, types.Number, types.Boolean)
INTS = _LaneType("int", _LONG, types.int64, types.Integer)
_BOOLS = _LaneType("bool", _BIT, types.boolean, types.Boolean)
FLOATS8 = _LaneType("eight", _DOUBLE, types.float64, types.Number, types.Boolean, count=8)


_Codes = dict[_LaneType, Callable[..., ir.Value]]  # machine code by the kind of both operands


@register_model(_LaneType)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, fe_type.value)


@lower_cast(types.Number, FLOATS)
@lower_cast(types.Number, FLOATS8)
@lower_cast(types.Boolean, FLOATS)
@lower_cast(types.Integer, INTS)
@lower_cast(types.Boolean, _BOOLS)
def _from_number(context, builder, fromty, toty, value):
    """Make lanes that all equal a number."""
    number = context.cast(builder, value, fromty, toty.single)
    undefined, count = ir.Constant(toty.value, ir.Undefined), toty.value.count
    one = builder.insert_element(undefined, number, ir.Constant(_LONG, 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)
    return builder.shuffle_vector(one, undefined, zeros)


def _find_common_type(*args: types.Type) -> types.Type | None:
    """Find the type of a result of numbers and lanes, single without lanes; None for others."""
    if not all(isinstance(arg, _LaneType | types.Number | types.Boolean) for arg in args):
        return None
    if FLOATS8 in args:
        return FLOATS8
    floats = any(arg is FLOATS or isinstance(arg, types.Float) for arg in args)
    ints = any(arg is INTS or isinstance(arg, types.Integer) for arg in args)
    kind = FLOATS if floats else INTS if ints else _BOOLS
    return kind if any(isinstance(arg, _LaneType) for arg in args) else kind.single


def register_primitive(
    primitive: Callable[..., object], infer: Callable[..., Signature | None],
    lower: Callable[..., ir.Value], prefer_literal: bool = False,
) -> None:  # fmt: skip
    """Teach the compiler a primitive.

    Args:
        primitive: The function, as Python runs it.
        infer: From a call's argument types to its signature; None for types that it does not take.
        lower: From (context, builder, signature, arguments) to the machine value.
        prefer_literal: Whether the types of constants are literals.
    """

    class _PrimitiveTyping(AbstractTemplate):
        def generic(self, args, kws):
            return infer(*args)

    _PrimitiveTyping.prefer_literal = prefer_literal
    infer_global(primitive)(_PrimitiveTyping)
    code = primitive.__code__
    kinds: list[types.Type] = [types.Any] * code.co_argcount
    if code.co_flags & inspect.CO_VARARGS:
        kinds.append(types.VarArg(types.Any))
    lower_builtin(primitive, *kinds)(lower)


def _register_operator(
    op: Callable[..., object], codes: _Codes, result: _LaneType | None = None
) -> None:
    """Teach the compiler `op` for two lanes of each kind in `codes`."""

    @infer_global(op)
    class _OperatorTyping(AbstractTemplate):
        def generic(self, args, kws):
            kind = _find_common_type(*args)
            is_known = len(args) == 2 and kind in codes
            return signature(result or kind, kind, kind) if is_known else None

    for kind, code in codes.items():

        def lower(context, builder, sig, args, code=code):
            return code(builder, *args)

        lower_builtin(op, kind, kind)(lower)


def _compare(sign: str) -> _Codes:
    """Make the codes of a comparison; one with NaN is false, but `!=` is true."""

    def floats(builder, x, y):
        code = builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered
        return code(sign, x, y)

    return {FLOATS: floats, INTS: lambda builder, x, y: builder.icmp_signed(sign, x, y)}


def _make_codes(floats: str | None, ints: str | None = None, bools: str | None = None) -> _Codes:
    names = {FLOATS: floats, FLOATS8: floats, INTS: ints, _BOOLS: bools}
    return {
        kind: lambda builder, x, y, name=name: getattr(builder, name)(x, y)
        for kind, name in names.items()
        if name is not None
    }


_register_operator(operator.add, _make_codes("fadd", "add"))
_register_operator(operator.sub, _make_codes("fsub", "sub"))
_register_operator(operator.mul, _make_codes("fmul", "mul"))
_register_operator(operator.truediv, _make_codes("fdiv"))
_register_operator(operator.and_, _make_codes(None, "and_", "and_"))
_register_operator(operator.or_, _make_codes(None, "or_", "or_"))
_register_operator(operator.xor, _make_codes(None, "xor", "xor"))
_register_operator(operator.lshift, _make_codes(None, "shl"))
_register_operator(operator.rshift, _make_codes(None, "ashr"))
for _op, _sign in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="),
    (operator.eq, "=="), (operator.ne, "!="),
):  # fmt: skip
    _register_operator(_op, _compare(_sign), result=_BOOLS)

_LANE_TYPES: dict[types.Type, types.Type] = {kind.single: kind for kind in (FLOATS, INTS, _BOOLS)}


def _infer_binary(a, b):
    kind = _find_common_type(a, b)
    return kind and signature(kind, kind, kind)


def _infer_float(a):
    kind = _find_common_type(a)
    floats = FLOATS if isinstance(kind, _LaneType) else types.float64
    return kind and signature(floats, floats)


def _infer_frexp(a):
    unary = _infer_float(a)
    return unary and signature(types.UniTuple(unary.return_type, 2), *unary.args)


def _infer_select(condition, a, b):
    kind, condition_type = _find_common_type(a, b), _BOOLS if condition is _BOOLS else types.boolean
    if kind is None or not isinstance(condition, types.Boolean | _LaneType):
        return None
    if condition_type is _BOOLS:
        kind = _LANE_TYPES.get(kind, kind)
    return signature(kind, condition_type, kind, kind)


def _make_intrinsic(name: str) -> Callable[..., ir.Value]:
    """Make the call of LLVM's function of a float or of lanes of them."""

    def lower(context, builder, sig, args):
        operand_type = args[0].type
        suffix = f"v{LANES}f64" if isinstance(operand_type, ir.VectorType) else "f64"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(operand_type, [operand_type]), f"llvm.{name}.{suffix}"
        )
        return builder.call(function, args)

    return lower


def _make_selection(sign: str) -> Callable[..., ir.Value]:
    """Make the selection of a where `a sign b` holds, else b."""
    codes = _compare(sign)

    def lower(context, builder, sig, args):
        kind = FLOATS if sig.args[0] in (FLOATS, types.float64) else INTS
        return builder.select(codes[kind](builder, *args), *args)

    return lower


def _register_conversion(primitive: Callable[..., object], lanes: _LaneType) -> None:
    """Teach the compiler a conversion to numbers or lanes of another kind."""

    def infer(a):
        kind = _find_common_type(a)
        return kind and signature(lanes if isinstance(kind, _LaneType) else lanes.single, kind)

    def lower(context, builder, sig, args):
        if sig.args[0] == sig.return_type:
            return args[0]
        convert = builder.sitofp if lanes is FLOATS else builder.fptosi
        return convert(args[0], context.get_value_type(sig.return_type))

    register_primitive(primitive, infer, lower)


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
    if sig.args[0] is not _BOOLS:
        return args[0]
    bits = builder.bitcast(args[0], ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


register_primitive(primitives.minimum, _infer_binary, _make_selection("<"))
register_primitive(primitives.maximum, _infer_binary, _make_selection(">"))
register_primitive(primitives.absolute, _infer_float, _make_intrinsic("fabs"))
register_primitive(primitives.floor, _infer_float, _make_intrinsic("floor"))
register_primitive(primitives.sqrt, _infer_float, _make_intrinsic("sqrt"))
register_primitive(primitives.select, _infer_select, lambda _, b, __, args: b.select(*args))
register_primitive(primitives.frexp, _infer_frexp, _lower_frexp)
for _primitive in (primitives.to_float, primitives.from_word):
    _register_conversion(_primitive, FLOATS)
for _primitive in (primitives.to_int, primitives.to_word):
    _register_conversion(_primitive, INTS)
register_primitive(
    primitives.any_lane,
    lambda a: signature(types.boolean, _BOOLS if a is _BOOLS else types.boolean),
    _lower_any_lane,
)
