# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,call-arg,misc,unused-ignore"
"""Compiled kernels as files: a line of JSON and the machine code, whole or not at all.

Nothing is unpickled: a kernel's types are those that the process asks for. numba's own cache
numbers its files in an index that two processes overwrite for each other, raises where the disk is
full or a file is cut short, and stores every function below a kernel as well.
"""

import contextlib
import hashlib
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import numba
from numba.core import types
from numba.core.compiler import compile_result
from numba.core.environment import Environment
from numba.core.funcdesc import PythonFunctionDescriptor
from numba.core.itanium_mangler import prepend_namespace
from numba.core.runtime import rtsys
from numba.core.typing import signature

from ..cache import read_trusted, report_once
from ..files import replace_file

RETURNS = {str(kind): kind for kind in (types.none, types.float64, types.int64, types.boolean)}
"""What a function may return that callers find by name."""

_ENVIRONMENTS = "_ZN08NumbaEnv"  # begins the names of the globals that point to environments
_DIGEST = hashlib.sha256().digest_size
_ENVIRONMENT = Environment({})  # of all kernels from files: those whose own are empty
_libraries: dict[str, tuple["Header", Any]] = {}  # in this process's memory, by file


class Header(NamedTuple):
    """What a file says of its machine code."""

    kernel: str
    """Of which function, argument types, machine and compiler it is."""
    symbol: str
    """The function's name in it."""
    returns: str
    environments: list[str]
    """Names of the globals that point to environments; the function's own comes first."""
    needs: list[tuple[str, str]]
    """Folder and file of each kernel whose machine code it calls."""


def make_key(function: Any, args: Any, codegen: Any) -> str:
    """What tells a kernel from all others: function, argument types, versions, machine."""
    versions = numba.__version__, llvmlite.__version__, sys.version, codegen.magic_tuple()
    return repr((function.__module__, function.__qualname__, str(args), versions))


def make_path(folder: Path, function: Any, key: str) -> Path:
    """The file of the kernel of this key."""
    name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
    return folder / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.kernel"


def save(
    path: Path,
    key: str,
    result: Any,
    environments: dict[str, Any],
    needs: list[tuple[str, str]],
) -> None:
    """Write a kernel; one that cannot be written is compiled again next time."""
    library, descriptor = result.library, result.fndesc
    constants = any(environment.consts for environment in environments.values())
    if constants or library.has_dynamic_globals or result.reload_init:
        return  # addresses and objects of this process
    own_name, returns = descriptor.env_name, str(result.signature.return_type)
    names = [own_name, *(name for name in list_environments(library) if name != own_name)]
    header = Header(key, descriptor.mangled_name, returns, names, needs)
    data = json.dumps(header).encode() + b"\n" + library._get_compiled_object()
    _libraries[str(path)] = header, library
    with contextlib.suppress(OSError), replace_file(path, mode=0o600) as file:
        file.write(hashlib.sha256(data).digest() + data)


def load(path: Path, key: str, function: Any, args: Any, target: Any) -> Any:
    """A kernel from its file; None where there is none, or only a damaged or foreign one."""
    rtsys.initialize(target)  # what arrays need, without all that a compiler needs
    linked = _load_library(path, target.codegen(), key)
    if linked is None:
        return None
    header, library = linked
    returns = RETURNS.get(header.returns, types.undefined)
    descriptor = PythonFunctionDescriptor(
        native=True,
        modname=function.__module__,
        qualname=function.__qualname__,
        unique_name=function.__qualname__,
        doc="",
        typemap=None,
        restype=returns,
        calltypes=None,
        args=function.__code__.co_varnames[: len(args)],
        kws=(),
        mangler=lambda *_, **__: header.symbol,
        argtypes=args,
        env_name=header.environments[0],
    )
    return compile_result(
        typing_context=target.typing_context,
        target_context=target,
        entry_point=target.get_executable(library, descriptor, _ENVIRONMENT),
        signature=signature(returns, *args),
        objectmode=False,
        lifted=(),
        fndesc=descriptor,
        library=library,
        environment=_ENVIRONMENT,
        reload_init=[],
    )


def _load_library(path: Path, codegen: Any, key: str | None = None) -> tuple[Header, Any] | None:
    """A file's machine code, with that of the kernels it needs, in this process's memory."""
    if str(path) in _libraries:
        return _libraries[str(path)]
    data = read_trusted(path)
    if data is None or hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
        return None
    header_line, _, code = data[_DIGEST:].partition(b"\n")
    try:
        header = Header(*json.loads(header_line))
        if key not in (None, header.kernel):
            raise ValueError("it is another kernel's")
        for folder, name in header.needs:
            if _load_library(path.parents[1] / Path(folder).name / name, codegen) is None:
                return None
    except (ValueError, TypeError, RecursionError) as error:
        report_once("kernel", f"{path} is no cached kernel, which is compiled anew: {error}"[:500])
        return None
    library = codegen.create_library(header.symbol)
    library.enable_object_caching()
    library._set_compiled_object(code)  # only its entry is called: its LLVM text is not needed
    library._finalize_final_module()
    codegen._engine._defined_symbols.add(prepend_namespace(header.symbol, ns="cpython"))
    set_environments(library, dict.fromkeys(header.environments, _ENVIRONMENT))
    return _libraries.setdefault(str(path), (header, library))


def set_environments(library: Any, environments: dict[str, Any]) -> None:
    """Tell emitted code where the environments of its functions are."""
    for name, environment in environments.items():
        library.codegen.set_env(name, environment)


def list_environments(library: Any) -> list[str]:
    """The names of the environments that a library's code refers to."""
    return [
        variable.name
        for variable in library._final_module.global_variables
        if variable.name.startswith(_ENVIRONMENTS)
    ]
