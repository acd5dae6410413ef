"""The measured speed: when the model is built anew, and which table of gains belongs to it."""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum, minimum
from .transition import SLOWEST

LARGEST = 1e15  # of a number that a filter takes: below it, whole floats are exact as int
MOVED = 0.005  # the model is built anew where the speed moved by this share


@jit
def finite(value: Any) -> Any:
    """Whether a number is one to calculate with: not NaN, infinite or beyond all measure."""
    return absolute(value) < LARGEST


@jit
def measured_speed(f: Any, now: Any) -> Any:
    """The low-passed mean of the front wheels' speeds, with this sample of it."""
    if not finite(now):
        return f.speed
    if f.model_speed == 0.0:
        return now
    return f.speed + f.smoothing * (now - f.speed)


@jit
def moved(f: Any, speed: Any) -> Any:
    """Whether the model has to be built anew for this speed."""
    return absolute(maximum(speed, SLOWEST) - f.model_speed) > MOVED * f.model_speed


@jit
def cell_of(f: Any, speed: Any) -> int:
    """The table of gains nearest to a speed."""
    if f.spacing == 0.0:
        return 0
    V = minimum(maximum(speed, f.low), f.high)
    return int((V - f.low) / f.spacing + 0.5)


@jit
def next_cell(f: Any, now: Any) -> Any:
    """The table of gains that a row with this sample of the speed will ask for."""
    if f.measured == 1:
        speed = measured_speed(f, now)
        if moved(f, speed):
            return cell_of(f, speed)
    return f.cell
