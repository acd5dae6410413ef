# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,call-arg,misc,no-untyped-call,no-untyped-def"
"""The engine's functions as CUDA device functions, rebuilt from the code of the other engines.

CUDA has its own primitives, and literals are of one precision.
"""

from collections.abc import Callable
from types import CodeType
from typing import Any

import numpy as np
from numba import cuda, types

from ..numerics import require_extra
from ..numerics.jit import as_python
from ..numerics.packed import load_element, read, store_element, write

with require_extra("cuda", "the CUDA engine needs numba-cuda"):
    import numba_cuda as numba_cuda  # makes sure of it: numba's own `cuda` is an older one

_Function = Callable[..., Any]
SIMULATED = bool(cuda.config.ENABLE_CUDASIM)
"""Whether numba simulates CUDA in Python (NUMBA_ENABLE_CUDASIM=1)."""


def to_cuda(function: Any, real: type[np.floating[Any]]) -> Any:
    """Rebuild a function and its callees, as plain Python in the simulator.

    Args:
        function: Function compiled by `jit`.
        real: Type of floats.

    Returns:
        Device function, or plain Python function in the simulator.
    """

    def finish(rebuilt: Any) -> Any:
        if real is not np.float64:
            _set_precision(rebuilt, real)
        return rebuilt if SIMULATED else _compile_device(rebuilt)

    if not SIMULATED:
        return as_python(function, _make_table(real), finish)
    return as_python(function, _SINGLE if real is np.float32 else None, finish)


_SINGLE: dict[str, _Function] = {
    "to_word": lambda a: int(np.float32(a).view(np.uint32)),
    "from_word": lambda a: np.uint32(a).view(np.float32),
}
"""Primitives of the simulator's float32: a word's 32 bits are those of a float."""


def _set_precision(function: Any, real: Any) -> None:
    """Give the function's literals and global numbers a precision, so that no float64 enters."""
    names, code = function.__globals__, function.__code__
    function.__code__ = code.replace(co_consts=_convert_literals(code.co_consts, real))
    for name in code.co_names:
        if name == "float" or isinstance(names.get(name), float | tuple):
            names[name] = real if name == "float" else _convert_literals(names[name], real)


def _convert_literals(value: Any, real: Any) -> Any:
    """Convert the floats of a value and of nested tuples."""
    if isinstance(value, float):
        return real(value)
    if isinstance(value, tuple) and not isinstance(value, CodeType):
        make = getattr(value, "_make", tuple)  # of a named tuple
        return make([_convert_literals(item, real) for item in value])
    return value


def _compile_device(function: Any) -> Any:
    return cuda.jit(device=True, forceinline=True)(function)


def _make_table(real: Any) -> dict[str, _Function]:
    """Make CUDA's own primitives by the names that the equations use; Python's serve for others."""
    from numba.cuda import libdevice

    single = real is np.float32
    fabs = libdevice.fabsf if single else libdevice.fabs
    floor = libdevice.floorf if single else libdevice.floor
    sqrt = libdevice.fsqrt_rn if single else libdevice.dsqrt_rn
    frexp = libdevice.frexpf if single else libdevice.frexp
    functions = {
        "absolute": lambda a: fabs(a),
        "floor": lambda a: floor(a),
        "sqrt": lambda a: sqrt(a),
        "to_float": lambda a: real(a),
        "frexp": lambda a: (frexp(a)[0], real(frexp(a)[1])),
        "from_word": lambda a: real(a),
    }
    if single:  # a float64 has a word's value, a float32 its bits
        functions["to_word"] = lambda a: int(libdevice.float_as_int(a))
        functions["from_word"] = lambda a: libdevice.int_as_float(np.int32(a))
    return {name: _compile_device(f) for name, f in functions.items()} | _register_access()


def _register_access() -> dict[str, _Function]:
    """Register numba-cuda's versions of reading and writing packed arrays, once."""
    if not _registered:
        from numba.cuda.extending import overload

        jit_options = {"forceinline": True}
        functions: list[_Function] = [read, write, load_element, store_element]
        typings: list[_Function] = [_read, _write, _load_element, _store_element]
        for function, typing in zip(functions, typings, strict=True):
            overload(function, jit_options=jit_options)(typing)
            _registered[function.__name__] = function
    return _registered


_registered: dict[str, _Function] = {}


def _format_column(j: Any) -> str:
    return "" if j is None or isinstance(j, types.Omitted | types.NoneType) else ", j"


def _build_function(text: str, **names: Any) -> Any:
    exec(text, names)  # the text is made here alone
    return names["written"]


def _read(array, where, j=None):
    numbers = "".join(f"array[where[0] + {k}{_format_column(j)}], " for k in range(len(where)))
    made = getattr(where, "instance_class", None)
    body = f"made({numbers})" if made else f"({numbers})"
    return _build_function(f"def written(array, where, j=None): return {body}", made=made)


def _write(array, values, where, j=None):
    lines = [f"    array[where[{k}]{_format_column(j)}] = values[{k}]\n" for k in range(len(where))]
    return _build_function(f"def written(array, values, where, j=None):\n{''.join(lines)}")


def _load_element(array, i, j=None):
    return _build_function(f"def written(array, i, j=None): return array[i{_format_column(j)}]")


def _store_element(array, value, i, j=None):
    return _build_function(
        f"def written(array, value, i, j=None): array[i{_format_column(j)}] = value"
    )
