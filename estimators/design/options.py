"""The options of a call, each read once: what is wrong names filter, option and value."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.arguments import unknown_names
from ...envs.record import FAST

Fits = Callable[[float], bool]

FAST_CHANNELS = {
    "steer": ("steer",),
    "gyro": ("gyro",),
    "accel_x": ("accel_x",),
    "accel_y": ("accel_y",),
    "roll_rate": ("roll_rate",),
    "wheels": ("wheel_left", "wheel_right"),
}
"""The columns of `envs.record.Fast` that are late together."""
LONGEST = 0.5  # s, of a latency that is known
FIND = "find"


def _any(number: float) -> bool:
    return True


class Options:
    """Keyword arguments of a filter by name; `done` refuses those that nothing has read."""

    def __init__(self, name: str, options: Mapping[str, Any]) -> None:
        self.name, self._left, self._known = name, dict(options), list[str]()

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def value(self, key: str, default: Any) -> Any:
        """The option as it came, or its default."""
        self._known.append(key)
        return self._left.pop(key, default)

    def wrong(self, key: str, expected: str, value: Any) -> ValueError:
        """The error for a value that an option cannot have."""
        return ValueError(f"{self.name}: {key} {expected}, got {value!r}")

    def one_of(self, key: str, default: str, known: Sequence[str]) -> str:
        """An option that is one of some words; ValueError for another."""
        value = self.value(key, default)
        if value not in known:
            raise self.wrong(key, f"is one of {', '.join(filter(None, known))}", value)
        return str(value)

    def some_of(self, key: str, default: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
        """An option that is the first of some words and any others, in their order; raises
        ValueError for anything else."""
        value = self.value(key, default)
        words = list(value) if isinstance(value, list | tuple) else [value]
        found = tuple(word for word in known if word in words)
        if len(found) != len(words) or known[0] not in found:
            raise self.wrong(key, f"is {known[0]!r} and any of {', '.join(known[1:])}", value)
        return found

    def not_negative(self, key: str, unit: str, default: float = 0.0) -> float:
        """A number that is 0 or more, in a unit."""
        expected = f"is in {unit} and not negative"
        return self.number(key, default, expected, lambda v: 0.0 <= v < np.inf)

    def number(self, key: str, default: float, expected: str = "", fits: Fits = _any) -> float:
        """An option that is a number; raises as `checked`."""
        return self.checked(key, self.value(key, default), expected, fits)

    def positive(self, key: str, default: float) -> float:
        """A number above zero; raises as `checked`."""
        return self.number(key, default, "must be positive and finite", lambda v: 0.0 < v < np.inf)

    def checked(self, key: str, value: Any, expected: str = "", fits: Fits = _any) -> float:
        """An option's value as a number; TypeError if it is none, ValueError if it does not fit."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} is a number, got {value!r}") from None
        if not fits(number):
            raise self.wrong(key, expected, number)
        return number

    def numbers(self, key: str, value: Any) -> npt.NDArray[np.float64]:
        """The value of an option as an array of its own; TypeError if it holds no numbers."""
        try:
            return np.array(value, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} holds numbers, got {value!r}") from None

    def done(self) -> None:
        """TypeError for options that nothing has read."""
        if self._left:
            message = unknown_names("option", sorted(self._left), sorted(self._known))
            raise TypeError(f"{self.name}: {message}")


def columns_of(channel: str) -> tuple[int, ...]:
    """The columns of a fast row that a channel of `FAST_CHANNELS` has."""
    return tuple(int(getattr(FAST, name)) for name in FAST_CHANNELS[channel])


def latency_of(read: Options, findable: bool) -> dict[str, float | str]:
    """The option `latency` without zeros: s by channel, or `FIND` for one of them.

    findable: whether the filter has slow sensors, and tyres as states.
    """
    value: Any = read.value("latency", {})
    if not isinstance(value, Mapping):
        raise TypeError(f"{read.name}: latency is seconds by channel, got {value!r}")
    for channel in value:
        if channel not in FAST_CHANNELS:
            raise read.wrong("latency", f"is of {', '.join(FAST_CHANNELS)}", dict(value))
    found: dict[str, float | str] = {}
    for channel, late in value.items():
        expected = f"is 0 to {LONGEST} s or {FIND!r}"
        if late == FIND:
            found[channel] = FIND
        elif read.checked(f"latency of {channel}", late, expected, lambda s: 0 <= s <= LONGEST):
            found[channel] = float(late)
    if list(found.values()).count(FIND) > (1 if findable else 0):
        expected = f"is {FIND!r} for one channel of a filter with tyres as states and slow sensors"
        raise read.wrong("latency", expected, dict(value))
    return found
