"""The file of tunings: entries are replaced whole, and the file whole or not at all."""

import json
from pathlib import Path
from typing import Any

from ...agents.tuned import Options, read_tuned
from ...envs.documents import toml_of
from ...estimators.design.tunings import read_tunings
from ..harness.results import write_text

_KEYS = ("estimator", "sensors", "command", "note", "q", "noise")
_HEAD = """\
# Tunings: process noise per second, (unit of the state)^2 / s, and measurement noise where it was
# searched too. Each entry is the output of its command; `sensors` are the slow ones.
"""


def update(path: str | Path, entry: dict[str, Any]) -> None:
    """Replace or add an entry of a tunings file, which is made if it is not there.

    entry: estimator, sensors, q (by state), command, and noise (by option) and note where there is
    a reason for one. The note of what a command found outlives the numbers unless a new one comes
    with them; that of what was chosen by hand does not.
    """
    target = Path(path)
    entries = {_key(old): old for old in read_tunings(target)} if target.exists() else {}
    old = entries.get(_key(entry), {})
    note = {"note": old["note"]} if {"note", "command"} <= old.keys() else {}
    entries[_key(entry)] = note | entry
    text = target.read_text(encoding="utf-8") if target.exists() else ""
    head = text.partition("[[tuning]]")[0] or _HEAD + "\n"
    write_text(target, head + "\n".join(map(_text, entries.values())))


def _key(entry: dict[str, Any]) -> tuple[str, str]:
    return entry["estimator"], entry["sensors"]


def _text(entry: dict[str, Any]) -> str:
    there = [key for key in _KEYS if entry.get(key) not in (None, {})]
    lines = "".join(f"{key} = {toml_of(entry[key])}\n" for key in there)
    return f"[[tuning]]\n{lines}"


_TUNED = """\
# Options of contestants as [class.name.part]; found by `sideslip tune controller NAME`.
"""


def put_tuned(path: str | Path, kind: str, name: str, options: Options) -> None:
    """Replace or add a contestant's options in a file that `agents.tuned` reads."""
    target = Path(path)
    read_tuned.cache_clear()
    classes = read_tuned(target) if target.exists() else {}
    classes = classes | {kind: classes.get(kind, {}) | {name: options}}
    tables = [
        f"[{each}.{who}.{part}]\n"
        + "".join(f"{option} = {json.dumps(value)}\n" for option, value in held.items())
        for each, names in sorted(classes.items())
        for who, parts in sorted(names.items())
        for part, held in parts.items()
        if held
    ]
    write_text(target, _TUNED + "\n" + "\n".join(tables))
    read_tuned.cache_clear()
