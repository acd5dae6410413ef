# numba's own types say too little about itself:
# mypy: disable-error-code="attr-defined,no-untyped-call,call-arg,misc,unused-ignore"
"""Compiled kernels on disk: a file for each kernel and argument types, written whole or not at all.

numba's own cache numbers its files in an index that two processes overwrite for each other, raises
where the disk is full or a file is cut short, and keeps every function below a kernel as well.
"""

import contextlib
import functools
import hashlib
import importlib
import os
import pickle
import shutil
import sys
import uuid
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import compile_result
from numba.core.environment import _rebuild_env
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

_PACKAGE = Path(__file__).resolve().parents[2]
_LAYERS = ("envs", "estimators", "agents", "benchmarks")  # each calls only those before it
_KEPT_CACHES = 12


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

_ENVIRONMENT = "_ZN08NumbaEnv"  # begins the names of the globals that point to environments
_DIGEST = hashlib.sha256().digest_size


def link_environments(library: Any, environments: Any) -> None:
    """Tell emitted code where the environments of its functions are."""
    for environment in environments:
        library.codegen.set_env(environment.env_name, environment)


def environment_names(library: Any) -> list[str]:
    """The names of the environments that a library's code refers to."""
    return [
        variable.name
        for variable in library._final_module.global_variables
        if variable.name.startswith(_ENVIRONMENT)
    ]


class Kept:
    """The kernels in a folder, all of one version of the sources."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def path(self, function: Any, args: Any, codegen: Any) -> Path:
        """The file of a function for arguments of these types on this machine."""
        name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
        built = numba.__version__, llvmlite.__version__, sys.version, codegen.magic_tuple()
        key = repr((function.__module__, function.__qualname__, str(args), built))
        return self.folder / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.kernel"

    def save(self, path: Path, result: Any, environments: Any, needed: Any) -> None:
        """Keep a kernel; one that cannot be kept is compiled again next time.

        needed: (module, name, argument types) of kernels whose machine code it calls.
        """
        if result.library.has_dynamic_globals:  # addresses of this process
            return
        result.fndesc.typemap = result.fndesc.calltypes = None
        code = result.library._get_compiled_object()
        told = (result.signature, result.fndesc, result.environment, result.reload_init)
        data = dumps((code, told, tuple(map(_noted, environments)), needed))
        with contextlib.suppress(OSError):
            _write(path, hashlib.sha256(data).digest() + data)

    def load(self, path: Path, args: Any, target: Any) -> Any:
        """A kernel that was kept; None where there is none, or only a damaged one."""
        try:
            data = path.read_bytes()
        except OSError:
            return None
        if hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            return None
        code, told, environments, needed = pickle.loads(data[_DIGEST:])
        signature, fndesc, environment, reload_init = told
        if signature.args != args:
            return None
        rtsys.initialize(target)  # what arrays need, without all that a compiler needs
        for prepare in reload_init:
            prepare()
        for module, name, types in needed:
            getattr(importlib.import_module(module), name).compile(types)
        library = _loaded(target.codegen(), fndesc, code)
        entry = target.get_executable(library, fndesc, environment)
        link_environments(library, [_rebuild_env(*noted) for noted in environments])
        return compile_result(
            typing_context=target.typing_context,
            target_context=target,
            entry_point=entry,
            signature=signature,
            objectmode=False,
            lifted=(),
            fndesc=fndesc,
            library=library,
            environment=environment,
            reload_init=reload_init,
        )


def _noted(environment: Any) -> tuple[str, list[Any], str]:
    """What numba rebuilds an environment from. Functions that numba itself writes, for expressions
    of whole arrays, are of no module."""
    module = environment.globals.get("__name__", "builtins")
    return module, list(environment.consts), environment.env_name


def _loaded(codegen: Any, fndesc: Any, code: bytes) -> JITCodeLibrary:
    """The machine code as a library. Only its entry is called: its LLVM text is not needed."""
    library: JITCodeLibrary = codegen.create_library(fndesc.qualname)
    library.enable_object_caching()
    library._set_compiled_object(code)
    library._finalize_final_module()
    codegen._engine._defined_symbols.add(fndesc.llvm_cpython_wrapper_name)
    return library


def _write(path: Path, data: bytes) -> None:
    """Write a file that other processes see whole or not at all."""
    draft = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    try:
        draft.write_bytes(data)
        os.replace(draft, path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink()
        raise
