"""Compiled functions as plain calls."""

from functools import cache
from typing import Any

import numba
import numpy as np
from numba.extending import is_jitted

from ..envs.record import PACKET_WIDTH
from .core.memory import FILTER
from .core.run import advance, receive_all, step_all, write_estimate


def entry(function: Any, *example: Any) -> Any:
    """The compiled call of a function for arguments of the example's types.

    numba finds out the types of the arguments at every call, which costs more than a filter's
    step; this is the call without it, so arguments must have exactly these types and layouts.
    """
    if not is_jitted(function):
        return function
    return function.compile(tuple(map(numba.typeof, example)))


def _memory() -> tuple[Any, Any]:
    return np.zeros(1, FILTER), np.zeros((1, 1, 1))


@cache
def advance_entry() -> Any:
    """`advance` as a plain call."""
    matrix, vector = np.zeros((1, 1)), np.zeros(1)
    return entry(advance, *_memory(), matrix, 0, matrix, 0, 0, matrix, matrix, vector)


@cache
def estimate_entry() -> Any:
    """`write_estimate` as a plain call."""
    return entry(write_estimate, *_memory(), np.zeros(1), np.zeros((1, 1)))


@cache
def receive_entry() -> Any:
    """`receive_all` as a plain call."""
    return entry(receive_all, *_memory(), np.zeros(PACKET_WIDTH))


@cache
def step_entry() -> Any:
    """`step_all` as a plain call."""
    matrix = np.zeros((1, 1))
    return entry(step_all, *_memory(), matrix, matrix, 0)
