"""The measured speed: when the model is built anew, and where its gains stand.

There is a table of gains for each cell of speed. Its rows: a head, then, for each step of the
cycle, one for every fast measurement (one where there is none), then, for each frame of the
pattern, one for every row of the slow sensor, then those of the rule between samples.
"""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum, minimum
from .memory import Memory
from .transition import SLOWEST

LARGEST = 1e15  # of a number that a filter takes: below it, whole floats are exact as int
MOVED = 0.005  # the model is built anew where the speed moved by this share


@jit
def finite(value: float) -> Any:
    """Whether a number is one to calculate with: not NaN, infinite or beyond all measure."""
    return absolute(value) < LARGEST


@jit
def low_passed(speed: Any, now: Any, share: Any) -> Any:
    """The low-passed speed in m/s after this sample, which counts by a share."""
    return speed + share * (now - speed)


@jit
def off(speed: Any, model_speed: Any) -> Any:
    """Whether a speed in m/s is too far from the model's."""
    return absolute(maximum(speed, SLOWEST) - model_speed) > MOVED * model_speed


@jit
def measured_speed(f: Memory, now: float) -> Any:
    """The low-passed mean of the front wheels' speeds in m/s, with this sample of it."""
    if not finite(now):
        return f.speed
    if f.model_speed == 0.0:
        return now
    return low_passed(f.speed, now, f.smoothing)


@jit
def moved(f: Memory, speed: float) -> Any:
    """Whether the model has to be built anew for this speed in m/s."""
    return off(speed, f.model_speed)


@jit
def cell_of(f: Memory, speed: float) -> Any:
    """The table of gains nearest to a speed in m/s."""
    if f.spacing == 0.0:
        return 0
    V = minimum(maximum(speed, f.low), f.high)
    return int((V - f.low) / f.spacing + 0.5)


@jit
def next_cell(f: Memory, now: float) -> Any:
    """The table of gains that a row with this sample of the speed, m/s, will ask for."""
    if f.measured == 1:
        speed = measured_speed(f, now)
        if moved(f, speed):
            return cell_of(f, speed)
    return f.cell


@jit
def step_row(f: Memory) -> Any:
    """The table's row with the gain of the first fast measurement in this step."""
    return 1 + f.at * maximum(f.fasts, 1)


@jit
def frame_row(f: Memory, s: int, frame: int) -> Any:
    """The row with the gain of sensor s's first row for a frame of the pattern.

    frame = pattern: the first row of the rule between samples.
    """
    return 1 + f.cycle * maximum(f.fasts, 1) + frame * f.rows[s]
