"""The equations on CasADi's symbols: `as_python` with CasADi's primitives."""

import types
from collections.abc import Callable
from typing import Any, TypeVar

from . import require_extra
from .jit import as_python

with require_extra("mpc", "the plant on symbols needs CasADi"):
    import casadi as ca

F = TypeVar("F", bound=Callable[..., Any])

SYMBOLS: dict[str, Callable[..., Any]] = {
    "minimum": ca.fmin,
    "maximum": ca.fmax,
    "absolute": ca.fabs,
    "floor": ca.floor,
    "sqrt": ca.sqrt,
    "select": ca.if_else,
    "to_float": lambda a: a * 1.0,
    "any_lane": lambda condition: isinstance(condition, ca.SX | ca.MX) or condition,
}
"""The primitives for CasADi's SX and MX, by the names that the equations use."""

_ELEMENTARY: dict[str, Callable[..., Any]] = {
    "sincos": lambda x: (ca.sin(x), ca.cos(x)),
    "atan": ca.atan,
    "atan2": ca.atan2,
    "compute_sine": ca.sin,
}
"""CasADi's own functions, which agree to 1e-15 and have shorter derivatives than polynomials."""

_PACKAGE = __name__.rpartition(".envs")[0]


def to_casadi(function: F) -> F:
    """Rebuild a function for CasADi expressions.

    Args:
        function: Compiled function, without `&` and `|`, which raise TypeError on expressions.

    Returns:
        The rebuilt function.
    """
    rebuilt = as_python(function, SYMBOLS)
    _replace(rebuilt, set())
    return rebuilt


def _replace(function: Any, done: set[int]) -> None:
    """Put `_ELEMENTARY` into a rebuilt function and its callees, which are copies of its own."""
    done.add(id(function))
    names = function.__globals__
    for name in function.__code__.co_names:
        callee = names.get(name)
        if name in _ELEMENTARY:
            names[name] = _ELEMENTARY[name]
        elif (
            isinstance(callee, types.FunctionType)
            and callee.__module__.startswith(_PACKAGE)
            and id(callee) not in done
        ):
            _replace(callee, done)
