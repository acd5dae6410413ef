"""Tensors for the equations' text: torch's table of primitives.

`as_python(function, numbers(torch.float64))` is the plant's own text on tensors with a vehicle in
each place. Both sides of a condition are computed, so nothing ever waits for the device.
"""

import math
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any

from . import require_extra
from .jit import as_python

with require_extra("train", "the device engine needs torch"):
    import torch as torch  # for the other modules of the device engine

DTYPES = {"float64": torch.float64, "float32": torch.float32}


def make_torch_primitives(dtype: torch.dtype) -> dict[str, Callable[..., Any]]:
    """The primitives for tensors whose floats are of `dtype`, by the names the equations use.

    Numbers that are no tensors are computed as Python's. What is not a number is treated as by the
    compiled text: the smaller and the larger of NaN and b are b.
    """

    def select(condition: Any, a: Any, b: Any) -> Any:
        if not isinstance(condition, torch.Tensor):
            return a if condition else b
        if isinstance(a, float) and not isinstance(b, torch.Tensor):
            a = torch.full((), a, dtype=dtype, device=condition.device)  # else: torch's default
        return torch.where(condition, a, b)

    def to_float(a: Any) -> Any:
        return a.to(dtype) if isinstance(a, torch.Tensor) else a * 1.0

    def frexp(a: Any) -> Any:
        if not isinstance(a, torch.Tensor):
            return math.frexp(a)[0], math.frexp(a)[1] * 1.0
        # by the bits, of a normal number: torch.frexp does not compile for AVX-512
        integer, digits, bias = (
            (torch.int64, 52, 1022) if a.dtype == torch.float64 else (torch.int32, 23, 126)
        )
        bits, ones = a.view(integer), (1 << digits) - 1
        mantissa_bits = (bits & ones) | (bias << digits)
        m = mantissa_bits.view(a.dtype)
        return torch.where(a < 0.0, -m, m), to_float(((bits >> digits) & (2 * bias + 3)) - bias)

    def sqrt(a: Any) -> Any:
        if not isinstance(a, torch.Tensor):
            return math.sqrt(a)
        if not a.requires_grad:
            return torch.sqrt(a)
        is_zero = a == 0.0  # where the slope is infinite, and 0 times it no number: here it is 0
        return torch.where(is_zero, 0.0, torch.sqrt(torch.where(is_zero, 1.0, a)))

    def read(array: Any, indices: Any) -> Any:
        return getattr(indices, "_make", tuple)(array[indices[0] : indices[-1] + 1].unbind(0))

    return {
        "minimum": lambda a, b: select(a < b, a, b),
        "maximum": lambda a, b: select(a > b, a, b),
        "absolute": lambda a: torch.abs(a) if isinstance(a, torch.Tensor) else abs(a),
        "floor": lambda a: torch.floor(a) if isinstance(a, torch.Tensor) else math.floor(a) * 1.0,
        "sqrt": sqrt,
        "select": select,
        "to_float": to_float,
        "frexp": frexp,
        "to_int": lambda a: a.to(torch.int64) if isinstance(a, torch.Tensor) else int(a),
        "any_lane": lambda condition: isinstance(condition, torch.Tensor) or condition,
        "read": read,
        "load_element": lambda array, *index: array[index],
    }


def to_torch(dtype: torch.dtype, *functions: Callable[..., Any]) -> list[Any]:
    """The functions' text on tensors whose floats are of `dtype`."""
    table = make_torch_primitives(dtype)
    return [as_python(function, table) for function in functions]


def compile_method(function: Any) -> Any:
    """The bound method by `torch.compile`, whole.

    torch inlines what is short wherever it is used, and so again in that; where each of a chain's
    results is used several times, as in the logarithm's shifts, it would compile for an hour.
    What torch has compiled it counts by code object, and refuses a ninth: each env has its own.
    """
    owner, source = function.__self__, function.__func__
    function_copy = FunctionType(
        source.__code__.replace(),
        source.__globals__,
        source.__name__,
        source.__defaults__,
        source.__closure__,
    )
    method_copy = MethodType(function_copy, owner)
    return torch.compile(method_copy, fullgraph=True, options={"realize_opcount_threshold": 16})
