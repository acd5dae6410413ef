# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,no-untyped-def,misc,untyped-decorator"
"""Lanes: many numbers in one SIMD value, for which the compiler takes the equations unchanged.

A numba type whose machine value is LLVM's vector of doubles, with the integers and the truth values
that go with it. Single numbers mix with lanes as they do with arrays. The arithmetic is that of
single numbers, in the order written and without fused operations: a lane holds the very bits that
the number alone would have, however many they are. With AVX-512 there are sixteen, two registers:
while one waits for a result the other is computed, a third faster than eight. Elsewhere there are
eight: sixteen would be four registers of sixteen, and most numbers would go through memory.

Eight neighbours of a matrix's row are a type of their own, `EIGHT`: with it the sums of one
filter's small matrices are taken for eight columns at once, in the order of each column alone.
"""

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


class Lanes(types.Type):
    """As many of a kind: "float", "int" or "bool"."""

    def __init__(
        self, kind: str, one: Any, single: Any, taken: tuple[Any, ...], count: int = LANES
    ) -> None:
        self.value = ir.VectorType(one, count)
        self.single, self._taken = single, taken
        super().__init__(name=f"lanes({kind})")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """A number stands for equal lanes; integers become floats."""
        return Conversion.safe if isinstance(other, self._taken) else None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """A variable that is a number on one way and lanes on the other is lanes."""
        return self if isinstance(other, self._taken) else None


FLOATS = Lanes("float", _DOUBLE, types.float64, (types.Number, types.Boolean))
INTS = Lanes("int", _LONG, types.int64, (types.Integer,))
BOOLS = Lanes("bool", _BIT, types.boolean, (types.Boolean,))
EIGHT = Lanes("eight", _DOUBLE, types.float64, (types.Number, types.Boolean), 8)


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, fe_type.value)


def splat(builder: Any, value: Any, of: Lanes) -> Any:
    """Lanes that are all equal to a machine value."""
    none = ir.Constant(of.value, ir.Undefined)
    one = builder.insert_element(none, value, ir.Constant(_LONG, 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), of.value.count), [0] * of.value.count)
    return builder.shuffle_vector(one, none, zeros)


@lower_cast(types.Number, FLOATS)
@lower_cast(types.Number, EIGHT)
@lower_cast(types.Boolean, FLOATS)
@lower_cast(types.Integer, INTS)
@lower_cast(types.Boolean, BOOLS)
def _from_number(context, builder, fromty, toty, value):
    return splat(builder, context.cast(builder, value, fromty, toty.single), toty)


def meet(args: tuple[Any, ...]) -> Any:
    """The kind that numbers and lanes meet in, single if none of them is lanes; None for others."""
    if not all(isinstance(each, Lanes | types.Number | types.Boolean) for each in args):
        return None
    if EIGHT in args:
        return EIGHT
    floats = any(each is FLOATS or isinstance(each, types.Float) for each in args)
    ints = any(each is INTS or isinstance(each, types.Integer) for each in args)
    kind = FLOATS if floats else INTS if ints else BOOLS
    return kind if any(isinstance(each, Lanes) for each in args) else kind.single


def _operator(op: Callable[..., Any], codes: dict[Lanes, Any], gives: Lanes | None = None) -> None:
    """Teach the compiler `op` for two lanes of each kind in `codes`."""

    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            kind = meet(args)
            if len(args) != 2 or kind not in codes:
                return None
            return signature(gives or kind, kind, kind)

    for kind, code in codes.items():

        def lower(context, builder, sig, args, code=code):
            return code(builder, *args)

        lower_builtin(op, kind, kind)(lower)


def compare(sign: str) -> dict[Lanes, Any]:
    """The codes of a comparison; one with NaN is false, but `!=` is true."""

    def floats(builder, x, y):
        code = builder.fcmp_unordered if sign == "!=" else builder.fcmp_ordered
        return code(sign, x, y)

    return {FLOATS: floats, INTS: lambda builder, x, y: builder.icmp_signed(sign, x, y)}


def _of(floats: str | None, ints: str | None = None, bools: str | None = None) -> dict[Lanes, Any]:
    names = {FLOATS: floats, EIGHT: floats, INTS: ints, BOOLS: bools}
    return {
        kind: lambda builder, x, y, name=name: getattr(builder, name)(x, y)
        for kind, name in names.items()
        if name is not None
    }


_operator(operator.add, _of("fadd", "add"))
_operator(operator.sub, _of("fsub", "sub"))
_operator(operator.mul, _of("fmul", "mul"))
_operator(operator.truediv, _of("fdiv"))
_operator(operator.and_, _of(None, "and_", "and_"))
_operator(operator.or_, _of(None, "or_", "or_"))
_operator(operator.xor, _of(None, "xor", "xor"))
_operator(operator.lshift, _of(None, "shl"))
_operator(operator.rshift, _of(None, "ashr"))
for _op, _sign in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="),
    (operator.eq, "=="), (operator.ne, "!="),
):  # fmt: skip
    _operator(_op, compare(_sign), gives=BOOLS)
