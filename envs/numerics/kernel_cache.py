"""The folder of compiled kernels on disk, and the sources for which they hold.

Whoever can write a kernel's file can run anything. So a folder or file is used only where its path
is absolute, it belongs to the user or root and nobody else can write it; otherwise kernels are
compiled in memory, with one warning.

Args:
    layer: Name in `LAYERS`.
"""

import contextlib
import errno
import functools
import hashlib
import logging
import multiprocessing
import os
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path

_QUIET = "SIDESLIP_QUIET"  # environment variable that silences `report_once`
_PACKAGE = Path(__file__).resolve().parents[2]
LAYERS = ("envs", "estimators", "agents", "benchmarks")  # each calls only those before it
_NOT_COMPILED = ("rendering", "highway")
_DATA_SUFFIXES = (".toml", ".json")
_MAX_VERSIONS = 12  # of the sources whose kernels stay on disk

logger = logging.getLogger("sideslip.compiler")
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
    if logger.hasHandlers():
        logger.log(level, "sideslip: %s", text)
    elif multiprocessing.parent_process() is None:
        print(f"sideslip: {text}", file=sys.stderr, flush=True)


def hash_sources(layer: str = LAYERS[-1]) -> str:
    """Hash all source files that a layer's kernels may call, to 16 hexadecimal digits.

    numba watches only the file of the function itself; an edit in a callee's module would go
    unnoticed. Calls point one way, so an edit in `benchmarks` leaves the kernels of `envs` alone.
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
    """Find or make a layer's kernel folder (perhaps read-only), else None; prune older versions."""
    try:
        folder = _find_cache_folder() / hash_sources(layer)
        _make_folder(folder)
    except (_UntrustedError, OSError) as error:
        report_once("cache", f"compiled kernels are not cached: {error}")
        return None
    with contextlib.suppress(OSError):
        os.utime(folder)
    with contextlib.suppress(OSError):  # another process may prune as well
        if "NUMBA_CACHE_DIR" not in os.environ:  # a folder of the user's own is not ours to prune
            versions = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime)
            for old in versions[:-_MAX_VERSIONS]:
                shutil.rmtree(old, ignore_errors=True)
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


def read_trusted(path: Path) -> bytes | None:
    """Read a cached file's bytes; None where there is none, or one that others could have written.

    Args:
        path: Path of the file.
    """
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
