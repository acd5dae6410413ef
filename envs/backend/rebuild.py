"""The text of a compiled function, rebuilt for another kind of numbers."""

import types
from collections.abc import Callable, Mapping
from typing import Any

from numba.extending import is_jitted

from .arrays import read
from .decorators import F
from .primitives import minimum

_TABLED = {read.__module__, minimum.__module__}  # what a table may replace


def _same(function: Any) -> Any:
    return function


def plain(
    function: F,
    table: Mapping[str, Callable[..., Any]] | None = None,
    finish: Callable[[Any], Any] = _same,
) -> F:
    """The same text without the compiler.

    Parameters: `function`, compiled by `jit` or not; `table`, primitives by name that replace
    ours (`ARRAYS` for NumPy arrays, None for Python floats); `finish`, what each rebuilt function
    becomes (another compiler's).
    Returns: a function built from the same code object, its callees replaced likewise.
    """
    rebuilt: F = _rebuild(function, dict(table or {}), finish, {})
    return rebuilt


def _rebuild(function: Any, table: dict[str, Any], finish: Any, done: dict[Any, Any]) -> Any:
    source = function.py_func if is_jitted(function) else function
    if source.__name__ in table and source.__module__ in _TABLED:
        return table[source.__name__]
    if source in done:
        return done[source]
    names: dict[str, Any] = dict(source.__globals__)
    rebuilt = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__)
    done[source] = finished = finish(rebuilt)
    for name in source.__code__.co_names:
        callee: Any = names.get(name)
        ours = isinstance(callee, types.FunctionType) and (callee.__module__ or "").startswith(
            __name__.rpartition(".envs")[0]
        )
        if is_jitted(callee) or ours:
            names[name] = _rebuild(callee, table, finish, done)
    del names["__name__"]  # by which torch.compile would look the names up in the module itself
    return finished
