"""One text, several machines: the compiler's decorator and the table of primitives.

The equations of sideslip are plain scalar functions over tuples. `jit` compiles them; `plain`
rebuilds the very same functions for Python floats, NumPy arrays or any other table of primitives.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

from .cache import _LAYERS, _kept_folder
from .compiler import Kernel

_PREFIX = __name__.removesuffix("envs.backend.decorators")

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile with numba: IEEE arithmetic in the order written, cached on disk where possible."""
    return _compiled(function)


def counted(function: F) -> F:
    """The same for what allocates or reshapes arrays in `envs` or `estimators`, and its callers.

    All others there do without numba's counting of references, which costs two locked instructions
    for every slice: a filter's tick twice as much.
    """
    return _compiled(function, _nrt=True)


def inlined(function: F) -> F:
    """The same, and the text goes into its callers: what takes many numbers and is called often.

    A call of a plant's function passes some sixty numbers through memory, which costs as much as
    the function itself.
    """
    return _compiled(function, forceinline=True)


def apart(function: F) -> F:
    """The same, with machine code of its own that callers call: what is long and called seldom.

    It is made and kept once, not in each kernel that calls it.
    """
    return _compiled(function, apart=True)


def _compiled(function: F, apart: bool = False, **more: bool) -> F:
    if config.DISABLE_JIT:
        return function
    layer = function.__module__.removeprefix(_PREFIX).partition(".")[0]
    ours = function.__module__.startswith(_PREFIX) and layer in _LAYERS
    kept = _kept_folder(layer) if ours else None  # the stamp knows of no other sources
    told: dict[str, Any] = {"nopython": True, "boundscheck": None}
    told |= {"error_model": "numpy", "fastmath": False, "forceinline": False}
    told |= {"_nrt": layer not in ("envs", "estimators")} | more
    return Kernel(function, targetoptions=told, kept=kept, apart=apart)  # type: ignore[return-value]


@jit
def copied(source: Any, target: Any) -> None:
    """Copy a vector's numbers into another one; a slice's assignment would allocate."""
    for i in range(len(source)):
        target[i] = source[i]
