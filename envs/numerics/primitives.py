"""The primitives: the functions that the equations use beside + - * /.

Each kind of number has a table of them by name. The functions here serve Python floats; compiled,
single numbers and lanes take the same instructions.

Args:
    a: Number.
    b: Another number.
    condition: Whether something holds, in each lane.
"""

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

Scalar: TypeAlias = Any
"""One number a car: a float, lanes of a SIMD register, an array, a tensor or a symbol."""
Vector: TypeAlias = Any
"""Numbers in one axis, of any of these kinds."""
Matrix: TypeAlias = Any
"""Numbers in two axes or more."""


def minimum(a: Scalar, b: Scalar) -> Scalar:
    """Select the smaller of two numbers, b where one of them is NaN."""
    return a if a < b else b


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """Select the larger of two numbers, b where one of them is NaN."""
    return a if a > b else b


def absolute(a: Scalar) -> Scalar:
    """Compute |a|."""
    return math.fabs(a)


def floor(a: Scalar) -> Scalar:
    """Round down to the largest whole number at or below, as a float."""
    return math.floor(a) * 1.0


def sqrt(a: Scalar) -> Scalar:
    """Compute the square root, correctly rounded."""
    return math.sqrt(a)


def select(condition: Scalar, a: Scalar, b: Scalar) -> Scalar:
    """Select a where the condition holds, else b; both are evaluated."""
    return a if condition else b


def to_float(a: Scalar) -> Scalar:
    """Convert an integer to a float; a float stays."""
    return a * 1.0


def frexp(a: Scalar) -> Scalar:
    """Split a positive float into m 2^e with 0.5 <= m < 1: (m, e), both floats."""
    m, e = math.frexp(a)
    return m, e * 1.0


def to_int(a: Scalar) -> Scalar:
    """Convert a float that is a whole number to an integer."""
    return int(a)


def to_word(a: Scalar) -> Scalar:
    """Convert a float to a 32-bit word: its value, or its bits where floats have 32 bits."""
    return int(a)


def from_word(a: Scalar) -> Scalar:
    """Convert a 32-bit word to a float."""
    return a * 1.0


def any_lane(condition: Scalar) -> Scalar:
    """Check whether a condition holds for any of the cars in the lanes."""
    return condition


ARRAYS: dict[str, Callable[..., Scalar]] = {
    "minimum": np.minimum, "maximum": np.maximum, "absolute": np.absolute, "floor": np.floor,
    "sqrt": np.sqrt, "select": np.where, "any_lane": np.any,
    "to_float": lambda a: np.multiply(a, 1.0),
    "frexp": lambda a: np.multiply(np.frexp(a), 1.0),
    "to_int": lambda a: np.asarray(a).astype(np.int64),
}  # fmt: skip
"""The primitives for NumPy arrays, by the names the equations use."""
