"""Process noise of each filter with its slow sensors, as `sideslip tune estimator` found it.

The numbers are data, in `tunings.toml`: per second, in (unit of the state)^2 / s, with the command
that found them and what was held fixed on the way.
"""

import tomllib
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("tunings.toml")


def read_tunings(path: str | Path = FILE) -> list[dict[str, Any]]:
    """Read the entries of a tunings file.

    Args:
        path: TOML file.

    Returns:
        Entries with `estimator`, `sensors` and `q`, process noise ((unit of the state)^2 / s) by
            state.

    Raises:
        ValueError: It is no file of tunings; the message has the path.
    """
    try:
        entries = tomllib.loads(Path(path).read_text(encoding="utf-8")).get("tuning", [])
        for entry in entries:
            entry["q"] = {state: float(value) for state, value in entry["q"].items()}
            str.split(entry["estimator"] + entry["sensors"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is no file of tunings: {error!r}") from None
    return list(entries)


TUNINGS: dict[tuple[str, str], dict[str, float]] = {
    (entry["estimator"], entry["sensors"]): entry["q"] for entry in read_tunings()
}
