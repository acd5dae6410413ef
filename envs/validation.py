"""Checks of arguments, for one environment or rows of them, and the texts of their messages.

Args:
    name: Name of a value, for messages.
    value: Value to check or to format.
    what: Kind of what is checked, for messages.
    known: Known names.
    minimum: Smallest number.
    maximum: Largest number; None for no limit.
    action: Numbers of one row, shape (width,).
    actions: Those of several rows, shape (count, width).
    count: Number of rows.
    width: Numbers of an action.
    fail: Whether a bad action becomes NaN; else ValueError names it or its row.
"""

import dataclasses
import difflib
import inspect
import math
import reprlib
import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import numpy.typing as npt
from gymnasium import logger

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Actions = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
MAX_NUMBER = 1e12  # of a scenario or a vehicle: its ticks and its square stay finite
_MAX_LISTED_ROWS = 8  # rows that a message lists
_CONVERSION_ERRORS = (TypeError, ValueError, OverflowError)  # numpy's, for no numbers

_FLOAT32 = np.dtype(np.float32)
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 80


def short_repr(value: object) -> str:
    """Format a value for a message, shortened."""
    try:
        return _REPR.repr(value)
    except Exception:  # such as an integer of thousands of digits
        return f"<{type(value).__name__}>"


def join_names(names: Iterable[str]) -> str:
    """Format names for a message, the first of them where they are many.

    Args:
        names: Names in the order of the text.
    """
    return textwrap.shorten(", ".join(names), 250, placeholder=" ...")


def is_finite(value: Any) -> TypeGuard[float]:
    """Check whether a value is a number within +-MAX_NUMBER; True and False are none."""
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return is_number and not isinstance(value, bool) and bool(abs(value) <= MAX_NUMBER)


def check_number(name: str, value: object) -> float:
    """Check a number and convert it to float; ValueError, with its name, for another value."""
    if not is_finite(value):
        raise ValueError(f"{name} {short_repr(value)} is no finite number")
    return float(value)


def check_mapping(name: str, value: object) -> Mapping[str, Any]:
    """Check a mapping; TypeError, with its name, for another value."""
    if not isinstance(value, Mapping):
        raise TypeError(f"{name} is a mapping, got {short_repr(value)}")
    return value


def describe_unknown(what: str, values: Iterable[object], known: Iterable[str]) -> str:
    """Describe unknown names: the nearest known one of the first, or all that are known.

    Args:
        what: What the names name.
        values: The unknown names, one at least.
        known: Known names.
    """
    got, names = list(values), list(known)
    close = difflib.get_close_matches(got[0][:80], names, 1) if isinstance(got[0], str) else []
    hint = f"did you mean {close[0]!r}?" if close else f"known: {join_names(names)}"
    return f"unknown {what} {join_names(map(short_repr, got))}; {hint}"


def check_choice(what: str, value: object, known: Iterable[str]) -> None:
    """Check that a value is a known name; ValueError, with the nearest one, for another."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(describe_unknown(what, [value], known))


def check_options(what: str, function: Callable[..., object], options: Iterable[str]) -> None:
    """Check options of a function beside its first argument; TypeError for an unknown one.

    Args:
        what: What has the options, for messages.
        function: Function whose parameters are the known options.
        options: Names of options.
    """
    parameters = list(inspect.signature(function).parameters.values())[1:]
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    known = [parameter.name for parameter in parameters]
    if unknown := [name for name in options if name not in known]:
        raise TypeError(f"{what}: {describe_unknown('option', unknown, known)}")


def check_int(
    name: str, value: object, what: str, minimum: int = 1, maximum: int | None = None
) -> int:
    """Check a number of `what`; TypeError for no integer, ValueError out of its limits."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} is a number of {what}, got {short_repr(value)}")
    if value < minimum or (maximum is not None and value > maximum):
        limits = f"at least {minimum}" if maximum is None else f"{minimum} to {maximum} {what}"
        raise ValueError(f"{name} is {limits}, got {short_repr(value)}")
    return int(value)


def format_rows(rows: npt.ArrayLike) -> str:
    """Format rows for a message: "row 3" or "rows 1, 5, ...".

    Args:
        rows: Numbers of rows, shape (M,).
    """
    numbers = np.asarray(rows).tolist()
    if len(numbers) == 1:
        return f"row {numbers[0]}"
    dots = ", ..." if len(numbers) > _MAX_LISTED_ROWS else ""
    return f"rows {', '.join(map(str, numbers[:_MAX_LISTED_ROWS]))}{dots} ({len(numbers)} of them)"


def split_by_rows(values: Mapping[str, object], count: int, what: str = "") -> list[dict[str, Any]]:
    """Split arguments by rows: a list, tuple or array has one, or None, for each row.

    Args:
        values: Arguments of all rows by name.
        count: Number of rows.
        what: Kind of the arguments, put before a name in messages.
    """
    columns = {}
    for name, value in values.items():
        if isinstance(value, np.ndarray) and value.ndim > 0:
            value = value.tolist()
        if not isinstance(value, list | tuple):
            value = [value] * count
        elif len(value) != count:
            rule = f"one or a list of {count}, one a row"
            raise ValueError(f"{what}{name}: {rule}, got {len(value)}")
        columns[name] = value
    return [{n: v[i] for n, v in columns.items() if v[i] is not None} for i in range(count)]


def parse_action(action: object, width: int, fail: bool) -> Actions:
    """Parse an action to float32, shape (width,)."""
    if type(action) is np.ndarray and action.dtype is _FLOAT32 and action.shape == (width,):
        return action if action.flags.carray else action.copy()  # others are other types
    try:
        return _convert_action(action, width)
    except ValueError as error:
        if not fail:
            text = f"an action has shape ({width},), got {error}; nothing was stepped"
            raise ValueError(text) from None
    return np.full(width, np.nan, np.float32)


def parse_actions(actions: Any, count: int, width: int, fail: bool) -> Actions:
    """Parse actions of several rows to float32; rows of wrong shape or without numbers are bad."""
    try:
        array = np.array(actions, np.float32)  # a copy: contiguous whatever came
        if array.shape == (count, width):
            return array
    except _CONVERSION_ERRORS:  # rows of different lengths, or no numbers
        pass
    array, wrong = np.full((count, width), np.nan, np.float32), {}
    try:
        rows = list(actions)
    except TypeError:  # no rows at all
        rows = []
    for i, row in enumerate(rows if len(rows) == count else ()):
        try:
            array[i] = _convert_action(row, width)
        except ValueError as error:
            wrong[i] = str(error)
    if not fail and (wrong or len(rows) != count):
        bad = list(wrong)
        got = f"in {format_rows(bad)} {wrong[bad[0]]}" if bad else f"{len(rows)} rows"
        raise ValueError(f"actions have shape ({count}, {width}), got {got}; nothing was stepped")
    return array


def warn_once(env: object, actions: Actions) -> None:
    """Warn, once per env, of actions far outside of -1 to 1.

    Args:
        env: Environment that remembers the warning.
        actions: Actions, of any shape, one of them far outside.
    """
    if not vars(env).get("_warned"):
        largest = np.abs(actions[np.isfinite(actions)]).max()
        logger.warn(
            f"an action of {largest:g} is clipped to 1: actions are shares of full scale, "
            "from -1 to 1, not N m or rad; the env says so once"
        )
    vars(env)["_warned"] = True


def _convert_action(action: object, width: int) -> Actions:
    """Action (width,) as float32; ValueError with the value or shape of a bad one."""
    try:
        array = np.array(action, np.float32)
    except _CONVERSION_ERRORS as error:
        raise ValueError(f"{short_repr(action)}: {error}") from None
    if array.shape != (width,):
        raise ValueError(f"shape {array.shape}")
    return array


_CONFUSED_UNITS = {  # units in which a number may be by mistake, as fractions of the right one
    "m": {"mm": 1e-3, "cm": 1e-2},
    "s": {"ms": 1e-3},
    "m/s": {"km/h": 1.0 / 3.6},
    "rad": {"deg": math.pi / 180.0},
    "rad/s": {"deg/s": math.pi / 180.0},
    "kg": {"t": 1e3},
    "N/rad": {"kN/rad": 1e3, "N/deg": 180.0 / math.pi},
    "-": {"%": 1e-2},
}


def quantity(
    unit: str, low: float, high: float, text: str = "", default: Any = dataclasses.MISSING,
    per: tuple[str, ...] = (),
) -> Any:  # fmt: skip
    """Make a dataclass's field whose numbers have a plausible range.

    Args:
        unit: Unit of the numbers.
        low: Lower end of the range.
        high: Upper end of the range.
        text: Meaning of the field, for tables.
        default: Default value, if there is one.
        per: Names of fields by which the range is multiplied.
    """
    metadata = {"unit": unit, "text": text, "plausible": (low, high), "per": per}
    return dataclasses.field(default=default, metadata=metadata)


def check_plausible(values: "DataclassInstance") -> None:
    """Check a dataclass's numbers; ValueError outside of a range, with the unit by mistake.

    Args:
        values: The dataclass, with fields made by `quantity`.
    """
    entries = [spec for spec in dataclasses.fields(values) if "plausible" in spec.metadata]
    entries.sort(key=lambda spec: len(spec.metadata["per"]))  # ranges that depend on others last
    for entry in entries:
        unit, (low, high), per = map(entry.metadata.__getitem__, ("unit", "plausible", "per"))
        value, scale = getattr(values, entry.name), math.prod(getattr(values, n) for n in per)
        low, high = scale * low, scale * high
        for number in value if isinstance(value, tuple) else (value,):
            if number is None or low <= number <= high:
                continue
            per_text = f" for its {', '.join(per)}" if per else ""
            units = _CONFUSED_UNITS.get(unit, {}).items()
            candidates = " or ".join(name for name, size in units if low <= number * size <= high)
            got = f"{type(values).__name__}.{entry.name}: {short_repr(number)} {unit}"
            got = got.removesuffix(" -")
            raise ValueError(
                f"{got} is outside the plausible {low:.4g} to {high:.4g}{per_text}"
                f"{f' (is it in {candidates}?)' if candidates else ''}; strict=False takes it"
            )
