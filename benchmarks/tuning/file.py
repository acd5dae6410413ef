"""The file of tunings: entries are replaced whole, and the file whole or not at all."""

import json
from pathlib import Path
from typing import Any

from ...agents.tuned import Options, read_tuned
from ...envs.documents import to_toml
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
    entries = {_make_key(old): old for old in read_tunings(target)} if target.exists() else {}
    old = entries.get(_make_key(entry), {})
    note = {"note": old["note"]} if {"note", "command"} <= old.keys() else {}
    entries[_make_key(entry)] = note | entry
    text = target.read_text(encoding="utf-8") if target.exists() else ""
    head = text.partition("[[tuning]]")[0] or _HEAD + "\n"
    write_text(target, head + "\n".join(map(_format_entry, entries.values())))


def _make_key(entry: dict[str, Any]) -> tuple[str, str]:
    return entry["estimator"], entry["sensors"]


def _format_entry(entry: dict[str, Any]) -> str:
    present = [key for key in _KEYS if entry.get(key) not in (None, {})]
    lines = "".join(f"{key} = {to_toml(entry[key])}\n" for key in present)
    return f"[[tuning]]\n{lines}"


_TUNED = """\
# Options of contestants as [class.name.part]; found by `sideslip tune controller NAME`.
"""


def write_tuned(path: str | Path, kind: str, name: str, options: Options) -> None:
    """Replace or add a contestant's options in a file that `agents.tuned` reads."""
    target = Path(path)
    read_tuned.cache_clear()
    classes = read_tuned(target) if target.exists() else {}
    classes = classes | {kind: classes.get(kind, {}) | {name: options}}
    tables = [
        f"[{class_name}.{contestant}.{part}]\n"
        + "".join(f"{option} = {json.dumps(value)}\n" for option, value in part_options.items())
        for class_name, names in sorted(classes.items())
        for contestant, parts in sorted(names.items())
        for part, part_options in parts.items()
        if part_options
    ]
    write_text(target, _TUNED + "\n" + "\n".join(tables))
    read_tuned.cache_clear()
