"""Tuned options of the entries, by the class of tasks that they drive: `tuned.toml`.

`sideslip tune controller` finds them. A class is a car with its disturbances and its reference,
such as "coms-model" or "car-steering".
"""

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("tuned.toml")
PARTS = ("filter", "controller")

Options = dict[str, dict[str, Any]]
"""Options of the filter and of the controller, by `PARTS`."""


@cache
def read_tuned(path: Path = FILE) -> dict[str, dict[str, Options]]:
    """Read the options of a file, by class and entry.

    Args:
        path: TOML file.

    Returns:
        Options by class, entry and part.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file holds something else; the message has the path.
    """
    try:
        classes: Any = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from None
    for kind, names in classes.items():
        for name, parts in names.items() if isinstance(names, dict) else [("", names)]:
            is_valid = isinstance(parts, dict) and parts.keys() <= set(PARTS)
            if not (is_valid and all(isinstance(options, dict) for options in parts.values())):
                raise ValueError(f"{path}: {kind}.{name} is no table of {' and '.join(PARTS)}")
    return dict(classes)


def get_tuned_options(contest_class: str, name: str) -> Options:
    """Get the tuned options of an entry by part, empty where none was tuned.

    Args:
        contest_class: Class of tasks.
        name: Name of the entry.

    Returns:
        Options by part.
    """
    options = read_tuned().get(contest_class, {}).get(name, {})
    return {part: dict(options.get(part, {})) for part in PARTS}
