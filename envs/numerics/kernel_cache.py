"""Where compiled kernels lie on disk, and whether what lies there may be run.

Who can write a kernel's file can run anything. So a folder or a file counts only where it belongs
to the user or to root and nobody else can write it, and its path is absolute; all else is compiled
in memory, and said once.

Compiled kernels as files: a line of JSON and the machine code, whole or not at all.

Nothing is unpickled: a kernel's types are those that the process asks for. numba's own cache
numbers its files in an index that two processes overwrite for each other, raises where the disk is
full or a file is cut short, and stores every function below a kernel as well.
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

QUIET = "SIDESLIP_QUIET"
"""The environment variable that keeps `report_once` from writing to standard error."""

_PACKAGE = Path(__file__).resolve().parents[2]
LAYERS = ("envs", "estimators", "agents", "benchmarks")  # each calls only those before it
_NOT_COMPILED = ("rendering", "highway")
_DATA_SUFFIXES = (".toml", ".json")
_MAX_VERSIONS = 12  # of the sources whose kernels stay on disk

_logger = logging.getLogger("sideslip.compiler")
_reported: set[str] = set()


class UntrustedError(Exception):
    """What somebody else could have written."""


def report_once(subject: str, text: str, level: int = logging.WARNING) -> None:
    """Say something about a subject once in a process.

    A line on standard error; a record of the logger `sideslip.compiler` instead where the program
    has set up logging; nothing in worker processes or with SIDESLIP_QUIET set.
    """
    if subject in _reported or os.environ.get(QUIET):
        return
    _reported.add(subject)
    if _logger.hasHandlers():
        _logger.log(level, "sideslip: %s", text)
    elif multiprocessing.parent_process() is None:
        print(f"sideslip: {text}", file=sys.stderr, flush=True)


def hash_sources(layer: str = LAYERS[-1]) -> str:
    """The hash of all source files a layer's kernels may call, which names their folder.

    numba watches only the file of the function itself: an edit in a callee's module would
    otherwise silently give the numbers of the old text. Calls point one way, so an edit in
    `benchmarks` leaves the kernels of `envs` alone. What compiles nothing is left out.
    """
    digest = hashlib.sha256()
    for folder in LAYERS[: LAYERS.index(layer) + 1]:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            if path.parent.name not in _NOT_COMPILED:
                digest.update(str(path.relative_to(_PACKAGE)).encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def hash_experiment() -> str:
    """The hash of all that a drive's numbers depend on but tuned options and weights: the sources
    below the benchmarks, the ids with their options, and the cars and cameras in files."""
    digest = hashlib.sha256(hash_sources("agents").encode())
    files = [path for path in (_PACKAGE / "envs").rglob("*.*") if path.suffix in _DATA_SUFFIXES]
    for path in [_PACKAGE / "__init__.py", *sorted(files)]:
        digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def find_kernel_folder(layer: str = LAYERS[-1]) -> Path | None:
    """The folder of a layer's kernels, made where it is missing; None where there can be none.

    One that can only be read is read. Older versions are pruned.
    """
    try:
        folder = _find_cache_folder() / hash_sources(layer)
        _make_folder(folder)
    except (UntrustedError, OSError) as error:
        report_once("cache", f"compiled kernels are not cached: {error}")
        return None
    with contextlib.suppress(OSError):
        os.utime(folder)
    if "NUMBA_CACHE_DIR" not in os.environ:  # a folder of the user's own is not ours to prune
        _prune(folder.parent)
    return folder


def _find_cache_folder() -> Path:
    """The folder of all versions' folders, after the environment's variables.

    Raises UntrustedError where it is not absolute: a folder that was downloaded and is worked in
    could bring kernels.
    """
    names = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
    variable = next((name for name in names if os.environ.get(name)), names[-1])
    folder = Path(os.environ.get(variable, ""))
    if not folder.is_absolute():
        raise UntrustedError(f"{variable} is no absolute path ({str(folder)!r})")
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
    """Make a folder for the user alone where it is missing, and its parents.

    Raises UntrustedError where others could have made it, or can write in it; OSError where there
    is none. sticky: one where all may write, but none can replace what is another's.
    """
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
    """A cached file's bytes; None where there is none, or one that others could have written."""
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
    except (UntrustedError, OSError) as error:
        report_once("kernel", f"a cached kernel is compiled anew: {error}")
        return None


def _open_if_trusted(
    path: Path, kind: Callable[[int], bool], folder: int | None = None, sticky: bool = False
) -> int:
    """The descriptor of a folder, or of a file in an open folder, that nobody else can write.

    What is checked is what was opened. Raises UntrustedError, OSError.
    """
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        descriptor = os.open(path if folder is None else path.name, flags, dir_fd=folder)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise UntrustedError(f"{path} is a link") from None
        raise
    try:
        _check_owner(path, os.fstat(descriptor), kind, sticky)
    except UntrustedError:
        os.close(descriptor)
        raise
    return descriptor


def _check_owner(
    path: Path, status: os.stat_result, kind: Callable[[int], bool], sticky: bool = False
) -> None:
    mode, owner = status.st_mode, status.st_uid
    if not kind(mode):
        raise UntrustedError(f"{path} is no plain file or folder")
    if owner not in (0, os.geteuid()):
        raise UntrustedError(f"{path} belongs to another user ({owner})")
    if mode & 0o022 and not stat.S_ISLNK(mode) and not (sticky and mode & stat.S_ISVTX):
        raise UntrustedError(f"{path} can be written by others (mode {stat.S_IMODE(mode):o})")


# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,call-arg,misc,unused-ignore"


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
