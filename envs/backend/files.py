"""Files that are there whole or not at all."""

import contextlib
import io
import os
import stat
import uuid
from collections.abc import Iterator
from pathlib import Path

_OPEN = ("/dev/std", "/dev/fd/", "/proc/")  # what a process has open, by name


@contextlib.contextmanager
def atomic_file(path: Path | str) -> Iterator[io.BufferedWriter]:
    """A binary file to write, which takes the place of `path` at the end, or none does on an error.

    Whoever is killed meanwhile leaves an older file as it was. Links are followed, an older file's
    mode and owner stay; a pipe, a device or an open file such as /dev/stdout is written as it is.
    """
    try:
        old = os.stat(path)
    except FileNotFoundError:
        old = None
    if old and (not stat.S_ISREG(old.st_mode) or os.path.abspath(path).startswith(_OPEN)):
        with open(path, "ab") as file:
            yield file
        return
    with replace_file(Path(os.path.realpath(path))) as file:
        yield file
        if old:
            with contextlib.suppress(PermissionError):
                os.fchown(file.fileno(), old.st_uid, old.st_gid)
            os.fchmod(file.fileno(), stat.S_IMODE(old.st_mode))


@contextlib.contextmanager
def replace_file(path: Path, mode: int = 0o666) -> Iterator[io.BufferedWriter]:
    """The same for a plain file or a link, which is replaced itself; `mode` as the umask has it."""
    part = path.with_name(f".{path.name[:200]}.{uuid.uuid4().hex}.part")
    try:
        with open(part, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_atomic(path: Path | str, content: bytes) -> None:
    """Write a file or nothing."""
    with atomic_file(path) as file:
        file.write(content)
