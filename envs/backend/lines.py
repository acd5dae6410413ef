"""Records that begin where a cache line does: what lies next to each other comes in one piece."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

LINE = 64  # bytes that a cache fetches at once


def whole_lines(fields: Sequence[Any]) -> np.dtype[Any]:
    """A structured dtype of these fields, as long as so many whole lines."""
    rest = -np.dtype(list(fields)).itemsize % LINE
    return np.dtype([*fields, *([("rest", np.int8, rest)] if rest else [])])


def zeros_on_lines(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    """A record array of zeros whose first record begins on a line."""
    size = math.prod(shape) * dtype.itemsize
    room = np.zeros(size + LINE, np.int8)
    first = -room.ctypes.data % LINE
    return room[first : first + size].view(dtype).reshape(shape).view(np.recarray)
