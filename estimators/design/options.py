"""The reader of a filter's options, the default noise levels and the tuned process noise.

The process noise of each filter with its slow sensors is in `tunings.toml`, as `sideslip tune
estimator` found it: per second, in (unit of the state)^2 / s, with the command that found it.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST
from ...envs.validation import describe_unknown
from .models import MEASUREMENTS

_Fits = Callable[[float], bool]

FAST_CHANNELS = {
    "steer": ("steer",),
    "gyro": ("gyro",),
    "accel_x": ("accel_x",),
    "accel_y": ("accel_y",),
    "roll_rate": ("roll_rate",),
    "wheels": ("wheel_left", "wheel_right"),
}
"""The columns of `envs.record.Fast` that are late together."""
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
        self, key: str, default: float, expected: str = "", fits: _Fits = _is_any_number
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
        self, key: str, value: Any, expected: str = "", fits: _Fits = _is_any_number
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
        """Convert the value of an option to a new array.

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


NOISE = {"gyro_noise": 0.005} | {  # rad/s
    f"{row.noise}_noise": row.sd for sensor in MEASUREMENTS.values() for row in sensor.rows
}
EXTRA_NOISE = {
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
} | {f"{row.noise}_noise": row.sd for sensor in MEASUREMENTS.values() for row in sensor.velocities}
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s


FILE = Path(__file__).with_name("tunings.toml")


def read_tunings(path: str | Path = FILE) -> list[dict[str, Any]]:
    """Read the entries of a tunings file.

    Args:
        path: TOML file.

    Returns:
        Entries with `estimator`, `sensors` and `q`, process noise by state, (unit)^2 / s.

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
