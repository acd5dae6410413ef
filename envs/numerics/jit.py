"""The compiler's decorators, and the rebuilding of compiled functions for other numbers.

The equations are plain scalar functions over tuples. `jit` compiles them; `as_python` rebuilds the
same code for Python floats, NumPy arrays or any other table of primitives.
"""

import functools
import os
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any, Protocol, TypeVar, cast

import numba
from numba.extending import is_jitted

from .kernel_cache import LAYERS, find_kernel_folder, report_once
from .primitives import Vector

_STOCK = "SIDESLIP_STOCK_NUMBA"  # environment variable with which plain numba compiles
_PREFIX = __name__.removesuffix("envs.numerics.jit")  # of the names of all our modules
_SUPPORTED = "0.68"  # numba's version whose insides `compiler` uses

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])


def _compile(function: F, apart: bool = False, **options_more: bool) -> F:
    if config.DISABLE_JIT:
        return function
    make_kernel = _load_compiler()
    if make_kernel is None:
        stock_jit: Any = numba.njit(error_model="numpy", forceinline="forceinline" in options_more)
        return cast(F, stock_jit(function))
    layer = function.__module__.removeprefix(_PREFIX).partition(".")[0]
    is_hashed = function.__module__.startswith(_PREFIX) and layer in LAYERS
    folder = find_kernel_folder(layer) if is_hashed else None
    options = {"_nrt": layer not in ("envs", "estimators")} | options_more
    return cast(F, make_kernel(function, folder, apart, options))


@functools.cache
def _load_compiler() -> Callable[..., object] | None:
    """The maker of our compiler's kernels; None for plain numba, on request or by its version."""
    if os.environ.get(_STOCK):
        reason = f"{_STOCK} is set"
    elif not numba.__version__.startswith(f"{_SUPPORTED}."):
        reason = f"our compiler is made for {_SUPPORTED}"
    else:
        try:
            from .compiler import make_kernel

            return make_kernel
        except (ImportError, AttributeError) as error:  # a private name that moved
            reason = f"our compiler cannot use it: {error}"
    text = "compiles by itself: longer, in every process, and for the same numbers"
    report_once("stock", f"numba {numba.__version__} {text} ({reason})")
    return None


class _Decorator(Protocol):
    """A decorator of Python functions in numba's subset, whose types it keeps."""

    def __call__(self, function: F) -> F: ...


jit: _Decorator = _compile
"""Compile with numba: IEEE arithmetic in the order written; stock numba has no disk cache."""
jit_nrt: _Decorator = functools.partial(_compile, _nrt=True)
"""Compile with reference counting: what allocates or reshapes arrays, and its callers. All others
in `envs` and `estimators` do without it, which halves the time of a filter's tick."""
inline: _Decorator = functools.partial(_compile, forceinline=True)
"""Compile into the callers: what takes many numbers and is called often. A call of a plant's
function passes some sixty numbers through memory, which takes as long as the function itself."""
noinline: _Decorator = functools.partial(_compile, apart=True)
"""Compile once, to machine code that all callers call: what is long and called seldom. Stock numba
compiles it as `jit` does."""


def compile_call(function: F, *arguments: object) -> F:
    """Compile a function for the types of some arguments alone, which saves numba's dispatch.

    Args:
        function: Function compiled by `jit`.
        arguments: Arguments of the types that it will be called with.
    """
    if config.DISABLE_JIT:
        return function
    compiled: Any = function
    return cast(F, compiled.compile(tuple(map(numba.typeof, arguments))))


@jit
def copy_into(source: Vector, target: Vector) -> None:
    """Copy a vector's numbers into another one; assigning a slice would allocate.

    Args:
        source: Vector to read.
        target: Vector to write, at least as long.
    """
    for i in range(len(source)):
        target[i] = source[i]


_NUMERICS = __name__.rpartition(".")[0]  # whose functions a table may replace


def as_python(
    function: F,
    table: Mapping[str, Callable[..., Any]] | None = None,
    finish: Callable[[FunctionType], Any] = lambda function: function,
) -> F:
    """Rebuild a function and its callees from the same code objects, without the compiler.

    Args:
        function: Function, compiled by `jit` or not.
        table: Primitives by name that replace ours: None for Python floats, `ARRAYS` for arrays.
        finish: Decorator of each rebuilt function, such as another compiler's.
    """
    rebuilt: F = _rebuild(function, dict(table or {}), finish, {})
    return rebuilt


def _rebuild(
    function: Any, table: dict[str, Callable[..., Any]], finish: Callable[[FunctionType], Any],
    rebuilt_functions: dict[Any, Any],
) -> Any:  # fmt: skip
    """Rebuild a function and its callees, of which some are rebuilt already."""
    source = function.py_func if is_jitted(function) else function
    if source.__name__ in table and source.__module__.startswith(_NUMERICS):
        return table[source.__name__]
    if source in rebuilt_functions:
        return rebuilt_functions[source]
    names = dict(source.__globals__)
    rebuilt = FunctionType(source.__code__, names, source.__name__, source.__defaults__)
    rebuilt_functions[source] = finished = finish(rebuilt)
    for name in source.__code__.co_names:
        callee: Any = names.get(name)
        is_function = isinstance(callee, FunctionType)
        if is_jitted(callee) or (is_function and (callee.__module__ or "").startswith(_PREFIX)):
            names[name] = _rebuild(callee, table, finish, rebuilt_functions)
    del names["__name__"]  # by which torch.compile would look the names up in the module itself
    return finished
