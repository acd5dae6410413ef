"""Documents: what is written about a vehicle or a scenario, as TOML or JSON, and typed objects."""

import contextlib
import json
import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

from .arguments import brief, is_finite, listed
from .backend.files import write_whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Made = TypeVar("Made", bound="DataclassInstance")
ENDINGS = (".toml", ".json")


def ends_in(source: object, endings: tuple[str, ...]) -> bool:
    """Whether a value is a text or a `Path` with one of these endings."""
    return isinstance(source, str | os.PathLike) and str(source).lower().endswith(endings)


def is_document(source: object) -> bool:
    """Whether a value is a path: any `Path`, or a text with an ending, which no name has."""
    return isinstance(source, os.PathLike) or (isinstance(source, str) and "." in source[-8:])


def read_document(source: "str | os.PathLike[str]", what: str) -> dict[str, Any]:
    """The mapping in a file; a file named under `base` is looked for beside it.

    what: is in the file, for messages. Raises FileNotFoundError, and ValueError for a folder,
    another ending, and a file that is no TOML or JSON or holds no mapping.
    """
    path = Path(source)
    values = _parsed(path, what)
    base = _base_beside(path, values)
    if base is not None:
        _check_ends(path, base, what)
        values["base"] = str(base)
    return values


def _parsed(path: Path, what: str) -> dict[str, Any]:
    kind = path.suffix.lower()
    if kind not in ENDINGS:
        raise ValueError(f"{path}: the file of a {what} ends in {' or '.join(ENDINGS)}")
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


def _base_beside(path: Path, values: Mapping[str, Any]) -> Path | None:
    """The file beside a file that it names under `base`."""
    base = values.get("base")
    with contextlib.suppress(OSError, ValueError):  # a text that can be no file's name
        if isinstance(base, str) and (path.parent / base).is_file():
            return path.parent / base
    return None


def _check_ends(path: Path, base: Path | None, what: str) -> None:
    """ValueError where a file's base, or the base of that, leads back to one of them."""
    seen = {path.resolve()}
    while base is not None:
        if base.resolve() in seen:
            raise ValueError(f"{path}: its base is the file itself, or leads back to it")
        seen.add(base.resolve())
        base = _base_beside(base, _parsed(base, what)) if ends_in(base, ENDINGS) else None


def write_document(path: "str | os.PathLike[str]", values: Mapping[str, Any]) -> None:
    """Write a mapping of numbers, texts, lists and such mappings, which `read_document` reads back.

    Raises ValueError for another ending.
    """
    kind = Path(path).suffix.lower()
    if kind not in ENDINGS:
        raise ValueError(f"{path}: expected a file that ends in {' or '.join(ENDINGS)}")
    if kind == ".json":
        text = json.dumps(values, indent=1)
    else:
        text = "\n".join(f"{_key(name)} = {toml_of(value)}" for name, value in values.items())
    write_whole(os.fspath(path), (text + "\n").encode())


def toml_of(value: Any) -> str:
    """A number, text, list or mapping as TOML writes it behind a key."""
    if isinstance(value, Mapping):
        pairs = (f"{_key(name)} = {toml_of(each)}" for name, each in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_of, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)  # inf, which JSON calls Infinity
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if name.isascii() and name.isidentifier() else toml_of(name)


def made_of(kind: type[Made], entry: Any, where: str) -> Made:
    """A dataclass's instance from a JSON object, whose lists may stand for tuples.

    Raises ValueError, with the place and the field, for an unknown or missing field and a value of
    another type.
    """
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected a JSON object, got {brief(entry)}")
    known: dict[str, Any] = {each.name: each for each in fields(kind)}
    needed = {name for name, each in known.items() if each.default is each.default_factory}
    for what, names in (("unknown", entry.keys() - known), ("missing", needed - entry.keys())):
        if names:
            raise ValueError(f"{where}: {what} {listed(sorted(names))}")
    lists = {name: value for name, value in entry.items() if isinstance(value, list)}
    tuples = {n: tuple(v) for n, v in lists.items() if get_origin(known[n].type) is tuple}
    check_types(kind, entry | tuples, where)
    try:
        return kind(**entry | tuples)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def check_types(kind: "type[DataclassInstance]", values: Mapping[str, Any], where: str) -> None:
    """ValueError, with the place and the field, for a value of another type than a dataclass's."""
    types: dict[str, Any] = {each.name: each.type for each in fields(kind)}
    for name, value in values.items():
        wanted = get_origin(types[name]) or types[name]
        fits = isinstance(value, wanted) or (wanted is float and is_finite(value))
        if not fits or (isinstance(value, bool) and wanted is not bool):
            raise ValueError(f"{where}: {name} is {brief(value)}, not {wanted.__name__}")
