"""The equations on CasADi's symbols: `as_python` with CasADi's primitives."""

from collections.abc import Callable
from typing import Any, TypeVar

from . import require_extra
from .jit import as_python

with require_extra("mpc", "the plant on symbols needs CasADi"):
    import casadi as ca

F = TypeVar("F", bound=Callable[..., Any])

SYMBOLS: dict[str, Callable[..., Any]] = {
    "minimum": ca.fmin, "maximum": ca.fmax, "absolute": ca.fabs, "floor": ca.floor,
    "sqrt": ca.sqrt, "select": ca.if_else, "to_float": lambda a: a * 1.0,
    "any_lane": lambda condition: isinstance(condition, ca.SX | ca.MX) or condition,
    # its own functions agree with our polynomials to 1e-15 and have shorter derivatives
    "sincos": lambda x: (ca.sin(x), ca.cos(x)),
    "atan": ca.atan, "atan2": ca.atan2, "compute_sine": ca.sin,
}  # fmt: skip
"""The primitives for CasADi's SX and MX, by the names that the equations use."""


def to_casadi(function: F) -> F:
    """Rebuild a function for CasADi expressions.

    Args:
        function: Compiled function, without `&` and `|`, which raise TypeError on expressions.
    """
    return as_python(function, SYMBOLS)
