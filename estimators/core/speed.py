"""The measured speed: when the model is built anew, and where its gains stand.

There is a table of gains for each cell of speed. Its rows: a head, then, for each step of the
cycle, one for every fast measurement (one where there is none), then, for each frame of the
pattern, one for every row of the slow sensor, then those of the rule between samples.
"""

from typing import Any

from ...envs.backend.decorators import jit
from ...envs.backend.primitives import absolute, maximum, minimum
from .memory import FilterRecord
from .transition import MIN_SPEED

MAX_NUMBER = 1e15  # of a number that a filter takes: below it, whole floats are exact as int
SPEED_TOLERANCE = 0.005  # the model is built anew where the speed moved by this share


@jit
def is_finite(value: float) -> Any:
    """Whether a number is one to calculate with: not NaN, infinite or beyond all measure."""
    return absolute(value) < MAX_NUMBER


@jit
def smooth_speed(speed: Any, sample: Any, share: Any) -> Any:
    """The low-passed speed in m/s after this sample, which counts by a share."""
    return speed + share * (sample - speed)


@jit
def is_speed_changed(speed: Any, model_speed: Any) -> Any:
    """Whether a speed in m/s is too far from the model's."""
    return absolute(maximum(speed, MIN_SPEED) - model_speed) > SPEED_TOLERANCE * model_speed


@jit
def filter_speed(f: FilterRecord, sample: float) -> Any:
    """The low-passed mean of the front wheels' speeds in m/s, with this sample of it."""
    if not is_finite(sample):
        return f.speed
    if f.model_speed == 0.0:
        return sample
    return smooth_speed(f.speed, sample, f.smoothing)


@jit
def is_model_outdated(f: FilterRecord, speed: float) -> Any:
    """Whether the model has to be built anew for this speed in m/s."""
    return is_speed_changed(speed, f.model_speed)


@jit
def find_cell(f: FilterRecord, speed: float) -> Any:
    """The table of gains nearest to a speed in m/s."""
    if f.spacing == 0.0:
        return 0
    V = minimum(maximum(speed, f.low), f.high)
    return int((V - f.low) / f.spacing + 0.5)


@jit
def find_next_cell(f: FilterRecord, sample: float) -> Any:
    """The table of gains that a row with this sample of the speed, m/s, will ask for."""
    if f.measured == 1:
        speed = filter_speed(f, sample)
        if is_model_outdated(f, speed):
            return find_cell(f, speed)
    return f.cell


@jit
def locate_step_row(f: FilterRecord) -> Any:
    """The table's row with the gain of the first fast measurement in this step."""
    return 1 + f.at * maximum(f.fasts, 1)


@jit
def locate_frame_row(f: FilterRecord, s: int, frame: int) -> Any:
    """The row with the gain of sensor s's first row for a frame of the pattern.

    frame = pattern: the first row of the rule between samples.
    """
    return 1 + f.cycle * maximum(f.fasts, 1) + frame * f.rows[s]
