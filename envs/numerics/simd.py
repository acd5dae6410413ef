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
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.datamodel import models
from numba.core.extending import register_model
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.registry import cpu_target
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

_FEATURES = cpu_target.target_context.codegen().magic_tuple()[2]  # by which kernels are kept, too
LANES = 16 if "+avx512f" in _FEATURES else 8
_DOUBLE, _LONG, _BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(1)


class LaneType(types.Type):
    """The type of `count` numbers of one kind: "float", "int" or "bool"."""

    def __init__(
        self, kind: str, one: Any, single: Any, taken: tuple[Any, ...], count: int = LANES
    ) -> None:
        self.value = ir.VectorType(one, count)
        self.single, self._taken = single, taken
        super().__init__(name=f"lanes({kind})")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Convert a number to equal lanes; integers become floats."""
        return Conversion.safe if isinstance(other, self._taken) else None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """Unify a variable that is a number on one branch and lanes on the other: lanes."""
        return self if isinstance(other, self._taken) else None


FLOATS = LaneType("float", _DOUBLE, types.float64, (types.Number, types.Boolean))
INTS = LaneType("int", _LONG, types.int64, (types.Integer,))
BOOLS = LaneType("bool", _BIT, types.boolean, (types.Boolean,))
FLOATS8 = LaneType("eight", _DOUBLE, types.float64, (types.Number, types.Boolean), 8)


@register_model(LaneType)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: LaneType) -> None:
        super().__init__(dmm, fe_type, fe_type.value)


def splat(builder: Any, value: Any, lane_type: LaneType) -> Any:
    """Make lanes that all equal a machine value."""
    undefined = ir.Constant(lane_type.value, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(_LONG, 0))
    count = lane_type.value.count
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)
    return builder.shuffle_vector(one, undefined, zeros)


@lower_cast(types.Number, FLOATS)
@lower_cast(types.Number, FLOATS8)
@lower_cast(types.Boolean, FLOATS)
@lower_cast(types.Integer, INTS)
@lower_cast(types.Boolean, BOOLS)
def _from_number(context, builder, fromty, toty, value):
    return splat(builder, context.cast(builder, value, fromty, toty.single), toty)


def find_common_type(args: tuple[Any, ...]) -> Any:
    """Find the type of a result of numbers and lanes, single without lanes; None for others."""
    if not all(isinstance(arg, LaneType | types.Number | types.Boolean) for arg in args):
        return None
    if FLOATS8 in args:
        return FLOATS8
    floats = any(arg is FLOATS or isinstance(arg, types.Float) for arg in args)
    ints = any(arg is INTS or isinstance(arg, types.Integer) for arg in args)
    kind = FLOATS if floats else INTS if ints else BOOLS
    return kind if any(isinstance(arg, LaneType) for arg in args) else kind.single


def register_primitive(
    primitive: Callable[..., Any],
    infer: Callable[..., Any],
    lower: Callable[..., Any],
    prefer_literal: bool = False,
) -> None:
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
    kinds: list[Any] = [types.Any] * code.co_argcount
    if code.co_flags & inspect.CO_VARARGS:
        kinds.append(types.VarArg(types.Any))
    lower_builtin(primitive, *kinds)(lower)


def _register_operator(
    op: Callable[..., Any], codes: dict[LaneType, Any], result: LaneType | None = None
) -> None:
    """Teach the compiler `op` for two lanes of each kind in `codes`."""

    @infer_global(op)
    class _OperatorTyping(AbstractTemplate):
        def generic(self, args, kws):
            kind = find_common_type(args)
            if len(args) != 2 or kind not in codes:
                return None
            return signature(result or kind, kind, kind)

    for kind, code in codes.items():

        def lower(context, builder, sig, args, code=code):
            return code(builder, *args)

        lower_builtin(op, kind, kind)(lower)


def compare(sign: str) -> dict[LaneType, Any]:
    """Make the codes of a comparison; one with NaN is false, but `!=` is true."""

    def floats(builder, x, y):
        code = builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered
        return code(sign, x, y)

    return {FLOATS: floats, INTS: lambda builder, x, y: builder.icmp_signed(sign, x, y)}


def _make_codes(
    floats: str | None, ints: str | None = None, bools: str | None = None
) -> dict[LaneType, Any]:
    names = {FLOATS: floats, FLOATS8: floats, INTS: ints, BOOLS: bools}
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
    _register_operator(_op, compare(_sign), result=BOOLS)
