"""One text, several machines: the compiler's decorator and the table of primitives.

The equations of sideslip are plain scalar functions over tuples. `jit` compiles them; `plain`
rebuilds the very same functions for Python floats, NumPy arrays or any other table of primitives.
"""

import contextlib
import functools
import hashlib
import os
import shutil
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.dispatcher import Dispatcher

from .compiler import Kernel
from .packed import abreast, at, fixed_tuple, of_lane, put, put_all, put_along, ramp
from .primitives import (
    ARRAYS,
    absolute,
    anywhere,
    floor,
    maximum,
    minimum,
    select,
    sqrt,
    to_float,
    whole,
)

__all__ = [
    "ARRAYS",
    "abreast",
    "absolute",
    "anywhere",
    "apart",
    "at",
    "config",
    "copied",
    "fixed_tuple",
    "floor",
    "inlined",
    "jit",
    "maximum",
    "minimum",
    "of_lane",
    "plain",
    "put",
    "put_all",
    "put_along",
    "ramp",
    "select",
    "sqrt",
    "to_float",
    "whole",
]  # fmt: skip

_PACKAGE = Path(__file__).resolve().parent.parent
_PREFIX = __name__.removesuffix("envs.backend")
_LAYERS = ("envs", "estimators", "agents", "benchmarks")  # each calls only those before it
_TABLED = {fixed_tuple.__module__, minimum.__module__}  # what a table may replace
_KEPT_CACHES = 12

config: Any = numba.config
F = TypeVar("F", bound=Callable[..., Any])


def source_stamp(layer: str = _LAYERS[-1]) -> str:
    """The hash of all source files a layer's kernels may call, which names their folder.

    numba watches only the file of the function itself: an edit in a callee's module would
    otherwise silently give the numbers of the old text. Calls point one way, so an edit in
    `benchmarks` leaves the kernels of `envs` alone.
    """
    digest = hashlib.sha256()
    for folder in _LAYERS[: _LAYERS.index(layer) + 1]:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            digest.update(str(path.relative_to(_PACKAGE)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder(layer: str = _LAYERS[-1]) -> str | None:
    """The folder of a layer's kernels, or None where there can be none; older ones are pruned.

    One that is there but cannot be written is read.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    base = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(home) / "sideslip" / "kernels")
    folder = base / source_stamp(layer)
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    if not folder.is_dir():
        return None
    if "NUMBA_CACHE_DIR" not in os.environ:  # a folder of the user's own is not ours to prune
        with contextlib.suppress(OSError):  # another process may prune as well
            newest = sorted(base.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
            for old in newest[_KEPT_CACHES:]:
                shutil.rmtree(old, ignore_errors=True)
    return str(folder)


_kept_folder = functools.cache(_cache_folder)


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


def plain(function: F, table: Mapping[str, Callable[..., Any]] | None = None) -> F:
    """The same text without the compiler.

    Parameters: `function`, compiled by `jit` or not; `table`, primitives by name that replace
    ours (`ARRAYS` for NumPy arrays, None for Python floats).
    Returns: a function built from the same code object, its callees replaced likewise.
    """
    rebuilt: F = _rebuild(function, dict(table or {}), {})
    return rebuilt


def _rebuild(function: Any, table: dict[str, Any], done: dict[Any, Any]) -> Any:
    source = function.py_func if isinstance(function, Dispatcher) else function
    if source.__name__ in table and source.__module__ in _TABLED:
        return table[source.__name__]
    if source in done:
        return done[source]
    names: dict[str, Any] = dict(source.__globals__)
    rebuilt = types.FunctionType(source.__code__, names, source.__name__, source.__defaults__)
    done[source] = rebuilt
    for name in source.__code__.co_names:
        callee = names.get(name)
        ours = isinstance(callee, types.FunctionType) and (callee.__module__ or "").startswith(
            __name__.rpartition(".envs")[0]
        )
        if isinstance(callee, Dispatcher) or ours:
            names[name] = _rebuild(callee, table, done)
    del names["__name__"]  # by which torch.compile would look the names up in the module itself
    return rebuilt
