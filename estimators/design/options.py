"""The options of a call, each read once: what is wrong names filter, option and value."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.arguments import describe_unknown
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
MAX_LATENCY = 0.5  # s, of a latency that is known
FIND = "find"


def _is_any_number(number: float) -> bool:
    return True


class OptionReader:
    """Keyword arguments of a filter; `check_unread` refuses those that were not read.

    Args:
        name: Name of the filter for messages.
        options: Values by name.
    """

    def __init__(self, name: str, options: Mapping[str, Any]) -> None:
        self.name, self._unread, self._known = name, dict(options), list[str]()

    def __contains__(self, key: str) -> bool:
        return key in self._unread

    def read_value(self, key: str, default: Any) -> Any:
        """Read an option as it is.

        Args:
            key: Name of the option.
            default: Value where it is not given.

        Returns:
            The value.
        """
        self._known.append(key)
        return self._unread.pop(key, default)

    def make_error(self, key: str, expected: str, value: Any) -> ValueError:
        """Make the error for a value that an option cannot have.

        Args:
            key: Name of the option.
            expected: Predicate of the message, "is ...".
            value: The value.

        Returns:
            The error, to be raised.
        """
        return ValueError(f"{self.name}: {key} {expected}, got {value!r}")

    def read_choice(self, key: str, default: str, known: Sequence[str]) -> str:
        """Read an option that is one of some words.

        Args:
            key: Name of the option.
            default: Value where it is not given.
            known: Allowed words.

        Returns:
            The word.

        Raises:
            self.make_error: The ValueError for another word.
        """
        value = self.read_value(key, default)
        if value not in known:
            raise self.make_error(key, f"is one of {', '.join(filter(None, known))}", value)
        return str(value)

    def read_choices(
        self, key: str, default: Sequence[str], known: Sequence[str]
    ) -> tuple[str, ...]:
        """Read an option that is the first of some words and any others.

        Args:
            key: Name of the option.
            default: Value where it is not given.
            known: Allowed words.

        Returns:
            The words in the order of `known`.

        Raises:
            self.make_error: The ValueError for anything else.
        """
        value = self.read_value(key, default)
        words = list(value) if isinstance(value, list | tuple) else [value]
        chosen = tuple(word for word in known if word in words)
        if len(chosen) != len(words) or known[0] not in chosen:
            raise self.make_error(key, f"is {known[0]!r} and any of {', '.join(known[1:])}", value)
        return chosen

    def read_non_negative(self, key: str, unit: str, default: float = 0.0) -> float:
        """Read a number that is 0 or more; errors as in `check_number`.

        Args:
            key: Name of the option.
            unit: Unit for messages.
            default: Value where it is not given.

        Returns:
            The number.
        """
        expected = f"is in {unit} and not negative"
        return self.read_number(key, default, expected, lambda v: 0.0 <= v < np.inf)

    def read_number(
        self, key: str, default: float, expected: str = "", fits: Fits = _is_any_number
    ) -> float:
        """Read an option that is a number; errors as in `check_number`.

        Args:
            key: Name of the option.
            default: Value where it is not given.
            expected: Predicate of the message, "is ...".
            fits: Whether a number is allowed.

        Returns:
            The number.
        """
        return self.check_number(key, self.read_value(key, default), expected, fits)

    def read_positive(self, key: str, default: float) -> float:
        """Read a number above zero; errors as in `check_number`.

        Args:
            key: Name of the option.
            default: Value where it is not given.

        Returns:
            The number.
        """
        return self.read_number(
            key, default, "must be positive and finite", lambda v: 0.0 < v < np.inf
        )

    def check_number(
        self, key: str, value: Any, expected: str = "", fits: Fits = _is_any_number
    ) -> float:
        """Convert an option's value to a number and check it.

        Args:
            key: Name of the option.
            value: The value.
            expected: Predicate of the message, "is ...".
            fits: Whether a number is allowed.

        Returns:
            The number.

        Raises:
            TypeError: The value is no number.
            self.make_error: The ValueError for a number that is not allowed.
        """
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} is a number, got {value!r}") from None
        if not fits(number):
            raise self.make_error(key, expected, number)
        return number

    def read_array(self, key: str, value: Any) -> npt.NDArray[np.float64]:
        """Convert the value of an option to an array of its own.

        Args:
            key: Name of the option.
            value: Numbers of any shape.

        Returns:
            The array.

        Raises:
            TypeError: The value holds no numbers.
        """
        try:
            return np.array(value, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} holds numbers, got {value!r}") from None

    def check_unread(self) -> None:
        """Check that every option was read.

        Raises:
            TypeError: An option is unknown.
        """
        if self._unread:
            message = describe_unknown("option", sorted(self._unread), sorted(self._known))
            raise TypeError(f"{self.name}: {message}")


def find_columns(channel: str) -> tuple[int, ...]:
    """Find the columns of a fast row that a channel has.

    Args:
        channel: Name of `FAST_CHANNELS`.

    Returns:
        Their indices.
    """
    return tuple(int(getattr(FAST, name)) for name in FAST_CHANNELS[channel])


def parse_latency(reader: OptionReader, is_findable: bool) -> dict[str, float | str]:
    """Parse the option `latency`, without zeros.

    Args:
        reader: Options of the filter.
        is_findable: Whether the filter has slow sensors, and tyres as states.

    Returns:
        Latency (s) by channel, or `FIND` for one of them.

    Raises:
        TypeError: The option is no mapping.
        reader.make_error: The ValueError for an unknown channel or a value out of range.
    """
    value: Any = reader.read_value("latency", {})
    if not isinstance(value, Mapping):
        raise TypeError(f"{reader.name}: latency is seconds by channel, got {value!r}")
    for channel in value:
        if channel not in FAST_CHANNELS:
            raise reader.make_error("latency", f"is of {', '.join(FAST_CHANNELS)}", dict(value))
    latencies: dict[str, float | str] = {}
    for channel, late in value.items():
        expected = f"is 0 to {MAX_LATENCY} s or {FIND!r}"
        if late == FIND:
            latencies[channel] = FIND
        elif reader.check_number(
            f"latency of {channel}", late, expected, lambda s: 0 <= s <= MAX_LATENCY
        ):
            latencies[channel] = float(late)
    if list(latencies.values()).count(FIND) > (1 if is_findable else 0):
        expected = f"is {FIND!r} for one channel of a filter with tyres as states and slow sensors"
        raise reader.make_error("latency", expected, dict(value))
    return latencies
