"""Compiled functions as plain calls."""

from functools import cache
from typing import Any

import numba
import numpy as np
from numba.extending import is_jitted

from ..envs.record import PACKET_WIDTH
from .core.memory import FILTER
from .core.run import advance, process_packet_all, step_all, write_estimate


def compile_call(function: Any, *example_args: Any) -> Any:
    """Return the compiled call of a function for arguments of the example's types.

    numba finds out the types of the arguments at every call, which costs more than a filter's
    step. This is the call without it, so arguments must have exactly these types and layouts.

    Args:
        function: A jitted function; any other is returned as it is.
        *example_args: Arguments whose types and layouts the call takes.

    Returns:
        A callable with the same positional arguments.
    """
    if not is_jitted(function):
        return function
    return function.compile(tuple(map(numba.typeof, example_args)))


def _make_example() -> tuple[Any, Any]:
    return np.zeros(1, FILTER), np.zeros((1, 1, 1))


@cache
def compile_advance() -> Any:
    """Return `advance` as a plain call."""
    matrix, vector = np.zeros((1, 1)), np.zeros(1)
    return compile_call(advance, *_make_example(), matrix, 0, matrix, 0, 0, matrix, matrix, vector)


@cache
def compile_estimate() -> Any:
    """Return `write_estimate` as a plain call."""
    return compile_call(write_estimate, *_make_example(), np.zeros(1), np.zeros((1, 1)))


@cache
def compile_process_packet() -> Any:
    """Return `process_packet_all` as a plain call."""
    return compile_call(process_packet_all, *_make_example(), np.zeros(PACKET_WIDTH))


@cache
def compile_step() -> Any:
    """Return `step_all` as a plain call."""
    matrix = np.zeros((1, 1))
    return compile_call(step_all, *_make_example(), matrix, matrix, 0)
