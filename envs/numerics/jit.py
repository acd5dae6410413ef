"""One text, several machines: the compiler's decorator and the table of primitives.

The equations of sideslip are plain scalar functions over tuples. `jit` compiles them; `as_python`
rebuilds the very same functions for Python floats, NumPy arrays or any other table of primitives.
"""

import functools
import os
import types
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

import numba
from numba.extending import is_jitted

from .kernel_cache import LAYERS, find_kernel_folder, report_once
from .packed import read
from .primitives import minimum

STOCK = "SIDESLIP_STOCK_NUMBA"
"""The environment variable with which numba compiles by itself."""

_PREFIX = __name__.removesuffix("envs.numerics.jit")
_SUPPORTED = "0.68"  # numba's version whose insides `compiler` uses

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile with numba: IEEE arithmetic in the order written, cached on disk where possible."""
    return _compile(function)


def jit_nrt(function: F) -> F:
    """The same for what allocates or reshapes arrays in `envs` or `estimators`, and its callers.

    All others there do without numba's counting of references, which costs two locked instructions
    for every slice: a filter's tick twice as much.
    """
    return _compile(function, _nrt=True)


def inline(function: F) -> F:
    """The same, and the text goes into its callers: what takes many numbers and is called often.

    A call of a plant's function passes some sixty numbers through memory, which costs as much as
    the function itself.
    """
    return _compile(function, forceinline=True)


def noinline(function: F) -> F:
    """The same, with machine code of its own that callers call: what is long and called seldom.

    It is made and cached once, not in each kernel that calls it.
    """
    return _compile(function, apart=True)


def compile_call(function: F, *arguments: Any) -> F:
    """A compiled function for arguments of these types and no others: numba looks at the types of
    what it is called with, which takes as long as a hundred lines of what it compiled."""
    compiled: Any = function
    if config.DISABLE_JIT:
        return function
    return cast(F, compiled.compile(tuple(map(numba.typeof, arguments))))


def _compile(function: F, apart: bool = False, **options_more: bool) -> F:
    if config.DISABLE_JIT:
        return function
    kernel = _load_kernel_class()
    if kernel is None:
        stock_jit: Any = numba.njit(error_model="numpy", forceinline="forceinline" in options_more)
        return cast(F, stock_jit(function))
    layer = function.__module__.removeprefix(_PREFIX).partition(".")[0]
    is_package_layer = function.__module__.startswith(_PREFIX) and layer in LAYERS
    folder = (
        find_kernel_folder(layer) if is_package_layer else None
    )  # the stamp knows of no other sources
    options: dict[str, Any] = {"nopython": True, "boundscheck": None}
    options |= {"error_model": "numpy", "fastmath": False, "forceinline": False}
    options |= {"_nrt": layer not in ("envs", "estimators")} | options_more
    return cast(F, kernel(function, targetoptions=options, folder=folder, apart=apart))


@functools.cache
def _load_kernel_class() -> Any:
    """The class of our compiler's functions, None where numba compiles by itself.

    It does so on request, and where our compiler was not made for its version: the same numbers.
    """
    if os.environ.get(STOCK):
        reason = f"{STOCK} is set"
    elif not numba.__version__.startswith(f"{_SUPPORTED}."):
        reason = f"our compiler is made for {_SUPPORTED}"
    else:
        try:
            from .compiler import Kernel

            return Kernel
        except (ImportError, AttributeError) as error:
            reason = f"our compiler cannot use it: {error}"
    text = "compiles by itself: longer, in every process, and for the same numbers"
    report_once("stock", f"numba {numba.__version__} {text} ({reason})")
    return None


@jit
def copy_into(source: Any, target: Any) -> None:
    """Copy a vector's numbers into another one; a slice's assignment would allocate."""
    for i in range(len(source)):
        target[i] = source[i]


_PRIMITIVE_MODULES = {read.__module__, minimum.__module__}  # what a table may replace


def _identity(function: Any) -> Any:
    return function


def as_python(
    function: F,
    table: Mapping[str, Callable[..., Any]] | None = None,
    finish: Callable[[Any], Any] = _identity,
) -> F:
    """The same text without the compiler.

    Parameters: `function`, compiled by `jit` or not; `table`, primitives by name that replace
    ours (`ARRAYS` for NumPy arrays, None for Python floats); `finish`, what each rebuilt function
    becomes (another compiler's).
    Returns: a function built from the same code object, its callees replaced likewise.
    """
    rebuilt: F = _rebuild(function, dict(table or {}), finish, {})
    return rebuilt


def _rebuild(
    function: Any, table: dict[str, Any], finish: Any, rebuilt_functions: dict[Any, Any]
) -> Any:
    source = function.py_func if is_jitted(function) else function
    if source.__name__ in table and source.__module__ in _PRIMITIVE_MODULES:
        return table[source.__name__]
    if source in rebuilt_functions:
        return rebuilt_functions[source]
    names: dict[str, Any] = dict(source.__globals__)
    rebuilt = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__)
    rebuilt_functions[source] = finished = finish(rebuilt)
    for name in source.__code__.co_names:
        callee: Any = names.get(name)
        is_package = isinstance(callee, types.FunctionType) and (
            callee.__module__ or ""
        ).startswith(__name__.rpartition(".envs")[0])
        if is_jitted(callee) or is_package:
            names[name] = _rebuild(callee, table, finish, rebuilt_functions)
    del names["__name__"]  # by which torch.compile would look the names up in the module itself
    return finished
