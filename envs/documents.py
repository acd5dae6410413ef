"""Documents: what a user writes about a vehicle or a scenario, as TOML or JSON on disk."""

import json
import math
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .backend.files import write_whole

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
    base = values.get("base")
    if isinstance(base, str) and (path.parent / base).is_file():
        if (path.parent / base).samefile(path):
            raise ValueError(f"{path}: its base is the file itself")
        values["base"] = str(path.parent / base)
    return values


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
        text = "\n".join(f"{_key(name)} = {_toml(value)}" for name, value in values.items())
    write_whole(os.fspath(path), (text + "\n").encode())


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return (
            "{" + ", ".join(f"{_key(name)} = {_toml(each)}" for name, each in value.items()) + "}"
        )
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)  # inf, which JSON calls Infinity
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if name.isascii() and name.isidentifier() else _toml(name)
