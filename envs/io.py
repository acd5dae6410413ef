"""Files that are written whole or not at all, and documents in TOML or JSON.

Args:
    path: Path of the file; its ending chooses a document's format.
    source: Path of a file, or any value.
    what: Kind of content, for messages.
    values: Numbers, texts, lists and mappings of these by name.
    kind: Dataclass whose fields name and type the values.
    where: Place of the values, for messages.
"""

import contextlib
import io
import json
import math
import os
import stat
import tomllib
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

from .validation import is_finite, join_names, short_repr

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_DataclassT = TypeVar("_DataclassT", bound="DataclassInstance")
_OPEN = ("/dev/std", "/dev/fd/", "/proc/")  # names of files that a process has open
_SUFFIXES = (".toml", ".json")


@contextlib.contextmanager
def atomic_file(path: Path | str) -> Iterator[io.BufferedWriter]:
    """Open a binary file that replaces `path` at the end, and nothing on an error.

    Links are followed, an older file's mode and owner stay; a pipe, a device or an open file such
    as /dev/stdout is written directly.
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
    """Open a binary file that replaces a plain file, or a link itself, at the end.

    Args:
        path: Path of the file.
        mode: Permissions, less the umask.

    Yields:
        The file to write.
    """
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
    """Write a file, or nothing on an error.

    Args:
        path: Path of the file.
        content: Its bytes.
    """
    with atomic_file(path) as file:
        file.write(content)


def is_document(source: object) -> bool:
    """Check whether a value is a path: any `Path`, or a text with an ending."""
    return isinstance(source, os.PathLike) or (isinstance(source, str) and "." in source[-8:])


def read_document(source: "str | os.PathLike[str]", what: str) -> dict[str, Any]:
    """Read the mapping in a TOML or JSON file; its `base` may name another file beside it.

    Raises FileNotFoundError, and ValueError for a folder, another ending, a `base` that leads back
    to the file, and a file that is no TOML or JSON or holds no mapping.
    """
    path = Path(source)
    values = _parse_file(path, what)
    base = _find_base(path, values)
    if base is not None:
        values["base"] = str(base)
    visited = {path.resolve()}
    while base is not None:
        if base.resolve() in visited:
            raise ValueError(f"{path}: its base is the file itself, or leads back to it")
        visited.add(base.resolve())
        is_parsed = base.suffix.lower() in _SUFFIXES  # else: a recorded drive, which has no base
        base = _find_base(base, _parse_file(base, what)) if is_parsed else None
    return values


def _parse_file(path: Path, what: str) -> dict[str, Any]:
    kind = path.suffix.lower()
    if kind not in _SUFFIXES:
        raise ValueError(f"{path}: the file of a {what} ends in {' or '.join(_SUFFIXES)}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such {what} file")
    if not path.is_file():
        raise ValueError(f"{path}: expected a {what} file, found a folder")
    name = kind[1:].upper()
    try:
        text = path.read_text(encoding="utf-8")
        values: Any = tomllib.loads(text) if kind == ".toml" else json.loads(text)
    except RecursionError:
        raise ValueError(f"{path}: expected {name}, but it is nested too deeply") from None
    except (ValueError, OSError) as error:  # of the decoder, of JSON or of TOML
        raise ValueError(f"{path}: expected {name}, but {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected a mapping of names to values")
    if not values:
        raise ValueError(f"{path}: the file holds nothing")
    return values


def _find_base(path: Path, values: Mapping[str, object]) -> Path | None:
    """Path of the file beside a file that it names under `base`; None without one."""
    base = values.get("base")
    with contextlib.suppress(OSError, ValueError):  # a text that can be no file's name
        if isinstance(base, str) and (path.parent / base).is_file():
            return path.parent / base
    return None


def write_document(path: "str | os.PathLike[str]", values: Mapping[str, object]) -> None:
    """Write a TOML or JSON file that `read_document` reads back; ValueError for another ending."""
    kind = Path(path).suffix.lower()
    if kind not in _SUFFIXES:
        raise ValueError(f"{path}: expected a file that ends in {' or '.join(_SUFFIXES)}")
    lines = [f"{_format_key(name)} = {to_toml(value)}" for name, value in values.items()]
    text = "\n".join(lines) if kind == ".toml" else json.dumps(values, indent=1)
    write_atomic(os.fspath(path), (text + "\n").encode())


def to_toml(value: object) -> str:
    """Format a value as TOML writes it behind a key.

    Args:
        value: Number, text, list or mapping.
    """
    if isinstance(value, Mapping):
        pairs = (f"{_format_key(name)} = {to_toml(item)}" for name, item in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(to_toml, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)  # inf, which JSON calls Infinity
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _format_key(name: str) -> str:
    return name if name.isascii() and name.isidentifier() else to_toml(name)


def from_json(kind: type[_DataclassT], entry: object, where: str) -> _DataclassT:
    """Make a dataclass's instance, and those in it, from JSON, lists for tuples; else ValueError.

    Args:
        kind: Dataclass of the instance.
        entry: The parsed JSON value.
        where: Place of the value, for messages.
    """
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected a JSON object, got {short_repr(entry)}")
    known = {spec.name: spec for spec in fields(kind)}
    required = {name for name, spec in known.items() if spec.default is spec.default_factory}
    for what, names in (("unknown", entry.keys() - known), ("missing", required - entry.keys())):
        if names:
            raise ValueError(f"{where}: {what} {join_names(sorted(names))}")
    lists = {name: value for name, value in entry.items() if isinstance(value, list)}
    tuples = {n: tuple(v) for n, v in lists.items() if get_origin(known[n].type) is tuple}
    kinds: dict[str, Any] = {n: known[n].type for n in entry if is_dataclass(known[n].type)}
    records = {n: from_json(k, entry[n], f"{where}: {n}") for n, k in kinds.items()}
    values = entry | tuples | records
    check_types(kind, values, where)
    try:
        return kind(**values)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def check_types(kind: "type[DataclassInstance]", values: Mapping[str, object], where: str) -> None:
    """Check that values have the types of a dataclass's fields; ValueError with place and field."""
    types: dict[str, Any] = {spec.name: spec.type for spec in fields(kind)}
    for name, value in values.items():
        expected = get_origin(types[name]) or types[name]
        fits = isinstance(value, expected) or (expected is float and is_finite(value))
        if not fits or (isinstance(value, bool) and expected is not bool):
            raise ValueError(f"{where}: {name} is {short_repr(value)}, not {expected.__name__}")
