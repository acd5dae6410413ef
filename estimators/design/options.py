"""The options of a call, each read once: what is wrong names filter, option and value.

A filter's noise levels: sensors, disturbances, Q, and deviations at the start.

Process noise of each filter with its slow sensors, as `sideslip tune estimator` found it.

The numbers are data, in `tunings.toml`: per second, in (unit of the state)^2 / s, with the command
that found them and what was held fixed on the way.
"""

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST, Array
from ...envs.validation import describe_unknown
from ..core.record import N_KNOTS
from ..filters import FilterDefinition
from .kalman import check_covariance
from .models import COURSE_SPEED, MEASUREMENTS, STATES, TYRES

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


_ROWS = [row for sensor in MEASUREMENTS.values() for row in sensor.rows]
_VELOCITIES = [row for sensor in MEASUREMENTS.values() for row in sensor.velocities]
NOISE = {"gyro_noise": 0.005} | {f"{row.noise}_noise": row.sd for row in _ROWS}  # gyro: rad/s
EXTRA_NOISE = {
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
} | {f"{row.noise}_noise": row.sd for row in _VELOCITIES}
MAX_MEMBERS = 8
N_IMM_MEMBERS = 4  # members
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s


def parse_noise(forces: bool, reader: OptionReader) -> tuple[dict[str, float], dict[str, float]]:
    """Parse the standard deviations of sensors and disturbances.

    Args:
        forces: Whether the disturbances are a force and a moment.
        reader: Options of the filter.

    Returns:
        `FilterConfig.noise` and `FilterConfig.noise_over_speed`.
    """
    speed_dependent = [
        row.noise for row in _ROWS if row.over_speed and f"{row.noise}_noise" not in reader
    ]
    levels = NOISE | EXTRA_NOISE
    noise = {
        key.removesuffix("_noise"): reader.read_positive(key, sd) for key, sd in levels.items()
    }
    if forces:
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: reader.read_positive(key, default) for short, (key, default) in keys}
    return noise, {name: noise[name] * COURSE_SPEED for name in speed_dependent}


def parse_hdop_table(
    row: FilterDefinition, reader: OptionReader
) -> tuple[tuple[float, float], ...]:
    """Parse the factors on the GPS's noise.

    Args:
        row: Definition of the filter.
        reader: Options of the filter.

    Returns:
        Knots (HDOP, factor), or none.

    Raises:
        reader.make_error: The ValueError for a table that is no such pairs.
    """
    table = reader.read_value("hdop_table", row.hdop)
    if table is None or (isinstance(table, tuple) and not table):
        return ()
    knots = reader.read_array("hdop_table", table)
    is_valid = knots.ndim == 2 and knots.shape[1] == 2 and 2 <= len(knots) <= N_KNOTS
    if not (is_valid and (np.diff(knots[:, 0]) > 0.0).all() and (knots[:, 1] > 0.0).all()):
        expected = f"is 2 to {N_KNOTS} pairs (HDOP, factor) with rising HDOP and positive factors"
        raise reader.make_error("hdop_table", expected, table)
    return tuple((float(hdop), float(factor)) for hdop, factor in knots)


def parse_bank(
    states: Sequence[str], forces: bool, delay: str, reader: OptionReader
) -> dict[str, Any]:
    """Parse the options of a bank of filters.

    Args:
        states: Names of the filter's states.
        forces: Whether the disturbances are a force and a moment.
        delay: Rule for late samples.
        reader: Options of the filter.

    Returns:
        `members`, `levels` and `sudden` of a `FilterConfig`.

    Raises:
        reader.make_error: The ValueError for a value out of range or without what it needs.
    """
    value = reader.read_value("levels", (1.0,))
    levels = reader.read_array("levels", value)
    pairs = levels.reshape(-1, 1).repeat(2, 1) if levels.ndim < 2 else levels
    fits = pairs.shape[1:] == (2,) and 1 <= len(pairs) <= MAX_MEMBERS
    if not (fits and (pairs > 0.0).all() and np.isfinite(pairs).all()):
        raise reader.make_error(
            "levels", f"are 1 to {MAX_MEMBERS} positive factors or pairs", value
        )
    expected = f"is a number of filters from 1 to {MAX_MEMBERS}"
    count = reader.read_number(
        "members", len(pairs), expected, lambda v: v in range(1, MAX_MEMBERS + 1)
    )
    if count > 1 and TYRES[0] not in states:
        raise reader.make_error("members", "is 1 where tyres are known", count)
    if (pairs != 1.0).any() and not (forces and 1 < count >= len(pairs)):
        raise reader.make_error("levels", "need disturbances='forces' and a member each", value)
    sudden = bool(reader.read_value("sudden", False))
    if sudden and not (count == 1 and TYRES[0] in states and forces and delay == "clone"):
        expected = "needs unknown tyres, disturbances='forces', delay='clone', no members or levels"
        raise reader.make_error("sudden", expected, sudden)
    return {"members": N_IMM_MEMBERS if sudden else int(count), "levels": pairs, "sudden": sudden}


def parse_process_noise(
    states: Sequence[str], tuning: Mapping[str, float], reader: OptionReader
) -> Array:
    """Parse Q: the tuning's or the option's, with single states' on its diagonal.

    Args:
        states: Names of the filter's states.
        tuning: Process noise per second by state.
        reader: Options of the filter.

    Returns:
        Q per second, shape (n, n).

    Raises:
        ValueError: Q has another shape; `check_covariance` refuses what is no covariance.
    """
    n, matrix = len(states), reader.read_value("Q", None)
    tuned_diagonal = [tuning.get(state, 0.0) for state in states]
    Q = reader.read_array("Q", tuned_diagonal if matrix is None else matrix)
    if Q.shape not in ((n,), (n, n)):
        raise ValueError(f"{reader.name}: Q has shape ({n}, {n}) or ({n},), got {Q.shape}")
    Q = np.diag(Q) if Q.ndim == 1 else Q
    for i, state in enumerate(states):
        Q[i, i] = reader.read_number(f"q_{state}", float(Q[i, i]))
    check_covariance(f"{reader.name}: Q", Q)
    return Q


def parse_prior(
    states: Sequence[str],
    noise: Mapping[str, float],
    biases: Mapping[str, float],
    reader: OptionReader,
) -> dict[str, float]:
    """Parse the standard deviations of all states at the start.

    Args:
        states: Names of the filter's states.
        noise: Standard deviations of sensors and disturbances.
        biases: Standard deviations of the biases by state.
        reader: Options of the filter.

    Returns:
        Standard deviation by state, in the state's unit.

    Raises:
        TypeError: The option is no mapping.
        ValueError: A state is unknown.
        reader.make_error: The ValueError for a value that is no standard deviation.
    """
    deviations = {state: STATES[state].prior for state in states} | dict(biases)
    if "force" in noise:
        deviations |= {"F_d": noise["force"], "N_d": noise["moment"]}
    prior = reader.read_value("prior", {})
    if not isinstance(prior, Mapping):
        raise TypeError(f"{reader.name}: prior is standard deviations by state, got {prior!r}")
    for state, value in prior.items():
        if state not in states:
            known = ", ".join(states)
            raise ValueError(
                f"{reader.name} has no state {state!r}; it has: {known}; prior={prior}"
            )
        sd = reader.read_array(f"the prior of {state}", value)
        if sd.ndim > 0 or not 0.0 <= sd < math.inf:
            raise reader.make_error(f"the prior of {state}", "is a standard deviation", value)
        deviations[state] = float(sd)
    return deviations


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
