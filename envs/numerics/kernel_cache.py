"""The cache of compiled kernels on disk: a line of JSON and the machine code in each file.

Whoever can write such a file can run anything. So a folder or file is used only where its path is
absolute, it belongs to the user or root and nobody else can write it; otherwise kernels are
compiled in memory, with one warning. Nothing is unpickled. Unlike with numba's own cache, processes
share no index, a full disk raises nothing, and callees are not stored.
"""

import contextlib
import errno
import functools
import hashlib
import json
import logging
import multiprocessing
import os
import shutil
import stat
import sys
from collections.abc import Callable
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

from ..io import replace_file

# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,call-arg,misc,unused-ignore"

_QUIET = "SIDESLIP_QUIET"  # environment variable that silences `report_once`
_PACKAGE = Path(__file__).resolve().parents[2]
LAYERS = ("envs", "estimators", "agents", "benchmarks")  # each calls only those before it
_NOT_COMPILED = ("rendering", "highway")
_DATA_SUFFIXES = (".toml", ".json")
_MAX_VERSIONS = 12  # of the sources whose kernels stay on disk

_logger = logging.getLogger("sideslip.compiler")
_reported: set[str] = set()


class _UntrustedError(Exception):
    """A file or folder that somebody else could have written."""


def report_once(subject: str, text: str, level: int = logging.WARNING) -> None:
    """Report on a subject once in a process.

    It is a line on standard error, or a record of the logger `sideslip.compiler` where logging is
    set up; nothing in worker processes or with SIDESLIP_QUIET set.

    Args:
        subject: Key of the report.
        text: Message.
        level: Level of the record.
    """
    if subject in _reported or os.environ.get(_QUIET):
        return
    _reported.add(subject)
    if _logger.hasHandlers():
        _logger.log(level, "sideslip: %s", text)
    elif multiprocessing.parent_process() is None:
        print(f"sideslip: {text}", file=sys.stderr, flush=True)


def hash_sources(layer: str = LAYERS[-1]) -> str:
    """Hash all source files that a layer's kernels may call.

    numba watches only the file of the function itself; an edit in a callee's module would go
    unnoticed. Calls point one way, so an edit in `benchmarks` leaves the kernels of `envs` alone.

    Args:
        layer: Name in `LAYERS`.

    Returns:
        16 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for folder in LAYERS[: LAYERS.index(layer) + 1]:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            if path.parent.name not in _NOT_COMPILED:
                digest.update(str(path.relative_to(_PACKAGE)).encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def hash_experiment() -> str:
    """Hash all that a drive's numbers depend on, except tuned options and weights.

    That is the sources below the benchmarks, the ids and the files of cars and cameras.
    """
    digest = hashlib.sha256(hash_sources("agents").encode())
    files = [path for path in (_PACKAGE / "envs").rglob("*.*") if path.suffix in _DATA_SUFFIXES]
    for path in [_PACKAGE / "__init__.py", *sorted(files)]:
        digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def find_kernel_folder(layer: str = LAYERS[-1]) -> Path | None:
    """Find or make the folder of a layer's kernels, and prune older versions.

    Args:
        layer: Name in `LAYERS`.

    Returns:
        The folder, which may be read-only; None where there can be none.
    """
    try:
        folder = _find_cache_folder() / hash_sources(layer)
        _make_folder(folder)
    except (_UntrustedError, OSError) as error:
        report_once("cache", f"compiled kernels are not cached: {error}")
        return None
    with contextlib.suppress(OSError):
        os.utime(folder)
    if "NUMBA_CACHE_DIR" not in os.environ:  # a folder of the user's own is not ours to prune
        _prune(folder.parent)
    return folder


def _find_cache_folder() -> Path:
    """Folder of all versions, absolute: a downloaded working folder could bring kernels."""
    names = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
    variable = next((name for name in names if os.environ.get(name)), names[-1])
    folder = Path(os.environ.get(variable, ""))
    if not folder.is_absolute():
        raise _UntrustedError(f"{variable} is no absolute path ({str(folder)!r})")
    if variable == "HOME":
        folder /= ".cache"
    if folder.is_symlink():  # of the user's own
        _check_owner(folder, folder.lstat(), stat.S_ISLNK)
    folder = folder.resolve()
    _make_folder(folder, sticky=True)
    if variable != "NUMBA_CACHE_DIR":
        for name in ("sideslip", "kernels"):
            folder /= name
            _make_folder(folder)
    return folder


def _make_folder(folder: Path, sticky: bool = False) -> None:
    """Make a trusted folder and its parents; sticky: all may write but not replace in it."""
    if not folder.parent.exists():
        _make_folder(folder.parent)
    try:
        folder.mkdir(mode=0o700)
    except OSError:
        if not folder.exists():
            raise
    os.close(_open_if_trusted(folder, stat.S_ISDIR, sticky=sticky))


def _prune(base: Path) -> None:
    with contextlib.suppress(OSError):  # another process may prune as well
        newest = sorted(base.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in newest[_MAX_VERSIONS:]:
            shutil.rmtree(old, ignore_errors=True)


def read_trusted(path: Path) -> bytes | None:
    """Read a cached file; None where there is none, or one that others could have written."""
    try:
        folder = _open_if_trusted(path.parent, stat.S_ISDIR)
        try:
            descriptor = _open_if_trusted(path, stat.S_ISREG, folder)
        finally:
            os.close(folder)
        with open(descriptor, "rb") as file:
            return file.read()
    except FileNotFoundError:
        return None
    except (_UntrustedError, OSError) as error:
        report_once("kernel", f"a cached kernel is compiled anew: {error}")
        return None


def _open_if_trusted(
    path: Path, kind: Callable[[int], bool], folder: int | None = None, sticky: bool = False
) -> int:
    """Descriptor of a folder, or of a file in an open folder; what was opened is checked."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        descriptor = os.open(path if folder is None else path.name, flags, dir_fd=folder)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _UntrustedError(f"{path} is a link") from None
        raise
    try:
        _check_owner(path, os.fstat(descriptor), kind, sticky)
    except _UntrustedError:
        os.close(descriptor)
        raise
    return descriptor


def _check_owner(
    path: Path, status: os.stat_result, kind: Callable[[int], bool], sticky: bool = False
) -> None:
    mode, owner = status.st_mode, status.st_uid
    if not kind(mode):
        raise _UntrustedError(f"{path} is no plain file or folder")
    if owner not in (0, os.geteuid()):
        raise _UntrustedError(f"{path} belongs to another user ({owner})")
    if mode & 0o022 and not stat.S_ISLNK(mode) and not (sticky and mode & stat.S_ISVTX):
        raise _UntrustedError(f"{path} can be written by others (mode {stat.S_IMODE(mode):o})")


RETURNS = {str(kind): kind for kind in (types.none, types.float64, types.int64, types.boolean)}
"""Return types of functions that callers find by name."""

_ENVIRONMENTS = "_ZN08NumbaEnv"  # begins the names of the globals that point to environments
_DIGEST = hashlib.sha256().digest_size
_ENVIRONMENT = Environment({})  # of all kernels from files: those whose own are empty
_libraries: dict[str, tuple["_Header", Any]] = {}  # in this process's memory, by file


class _Header(NamedTuple):
    """First line of a kernel's file."""

    kernel: str  # result of `make_key`
    symbol: str  # the function's name in the machine code
    returns: str  # key of RETURNS
    environments: list[str]  # globals that point to environments, the function's own first
    needs: list[tuple[str, str]]  # folder and file of each kernel whose machine code it calls


def make_key(function: Any, args: Any, codegen: Any) -> str:
    """Make a kernel's key: function, argument types, versions and machine."""
    versions = numba.__version__, llvmlite.__version__, sys.version, codegen.magic_tuple()
    return repr((function.__module__, function.__qualname__, str(args), versions))


def make_path(folder: Path, function: Any, key: str) -> Path:
    """Make the path of a kernel's file."""
    name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
    return folder / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.kernel"


def save(
    path: Path, key: str, result: Any, environments: dict[str, Any], needs: list[tuple[str, str]]
) -> None:
    """Save a kernel; one that cannot be written is compiled again next time."""
    library, descriptor = result.library, result.fndesc
    constants = any(environment.consts for environment in environments.values())
    if constants or library.has_dynamic_globals or result.reload_init:
        return  # addresses and objects of this process
    own_name, returns = descriptor.env_name, str(result.signature.return_type)
    names = [own_name, *(name for name in list_environments(library) if name != own_name)]
    header = _Header(key, descriptor.mangled_name, returns, names, needs)
    data = json.dumps(header).encode() + b"\n" + library._get_compiled_object()
    _libraries[str(path)] = header, library
    with contextlib.suppress(OSError), replace_file(path, mode=0o600) as file:
        file.write(hashlib.sha256(data).digest() + data)


def load(path: Path, key: str, function: Any, args: Any, target: Any) -> Any:
    """Load a kernel from its file; None where there is none, or a damaged or foreign one."""
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


def _load_library(path: Path, codegen: Any, key: str | None = None) -> tuple[_Header, Any] | None:
    """(header, library) of a file and of the kernels it needs, in this process's memory."""
    if str(path) in _libraries:
        return _libraries[str(path)]
    data = read_trusted(path)
    if data is None or hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
        return None
    header_line, _, code = data[_DIGEST:].partition(b"\n")
    try:
        header = _Header(*json.loads(header_line))
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
    """Set the addresses of the environments that emitted code refers to."""
    for name, environment in environments.items():
        library.codegen.set_env(name, environment)


def list_environments(library: Any) -> list[str]:
    """List the names of the environments that a library's code refers to."""
    names = [variable.name for variable in library._final_module.global_variables]
    return [name for name in names if name.startswith(_ENVIRONMENTS)]
