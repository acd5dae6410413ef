"""The equations on torch's tensors, with a vehicle in each place.

Both sides of a condition are computed, so nothing waits for the device.
"""

import math
from collections.abc import Callable
from types import FunctionType, MethodType, SimpleNamespace
from typing import Any

from . import require_extra
from .jit import as_python

with require_extra("train", "the device engine needs torch"):
    import torch as torch  # for the modules of the gradient engine

DTYPES = {"float64": torch.float64, "float32": torch.float32}


def _make_primitives(dtype: torch.dtype) -> dict[str, Callable[..., Any]]:
    """Primitives by name, for tensors and Python's numbers; of NaN and b either extreme is b."""

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
        is_double = a.dtype == torch.float64
        integer, digits, bias = (torch.int64, 52, 1022) if is_double else (torch.int32, 23, 126)
        bits, ones = a.view(integer), (1 << digits) - 1
        m = ((bits & ones) | (bias << digits)).view(a.dtype)
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


def to_torch(dtype: torch.dtype, *functions: Callable[..., Any]) -> SimpleNamespace:
    """Rebuild functions for tensors, each under its name.

    Args:
        dtype: Type of the tensors' floats.
        functions: Functions compiled by `jit`.
    """
    table = _make_primitives(dtype)
    return SimpleNamespace(**{f.__name__: as_python(f, table) for f in functions})


def compile_method(function: Any) -> Any:
    """Compile a bound method by `torch.compile`, as one graph.

    torch inlines short results wherever they are used: without the threshold a chain whose results
    are used several times, as the logarithm's shifts, would compile for an hour. It refuses a ninth
    compilation of a code object, so each method gets a copy.

    Args:
        function: Bound method to compile.
    """
    source = function.__func__
    code, names = source.__code__.replace(), source.__globals__
    copy = FunctionType(code, names, source.__name__, source.__defaults__, source.__closure__)
    method = MethodType(copy, function.__self__)
    return torch.compile(method, fullgraph=True, options={"realize_opcount_threshold": 16})


class GradientGate:
    """Gate of gradients: they pass to rows that are `open` (N,), finite ones alone, else zeros."""

    open: torch.Tensor

    def __call__(self, value: torch.Tensor) -> torch.Tensor:
        """Gate a value (..., N); `open` may be set until the gradients come."""
        if not (torch.is_grad_enabled() and value.requires_grad):
            return value
        gated = value.view_as(value)
        gated.register_hook(self._filter_gradient)  # type: ignore[no-untyped-call]
        return gated

    def _filter_gradient(self, slope: torch.Tensor) -> torch.Tensor:
        return torch.where(self.open & torch.isfinite(slope), slope, 0.0)
