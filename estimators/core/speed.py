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
    """Return whether a number can be calculated with: not NaN, infinite or beyond `MAX_NUMBER`.

    Args:
        value: Any number.

    Returns:
        True for a usable number.
    """
    return absolute(value) < MAX_NUMBER


@jit
def smooth_speed(speed: Any, sample: Any, share: Any) -> Any:
    """Low-pass the speed.

    Args:
        speed: Low-passed speed so far (m/s).
        sample: New sample (m/s).
        share: Weight of the sample, 0 to 1.

    Returns:
        Low-passed speed (m/s).
    """
    return speed + share * (sample - speed)


@jit
def is_speed_changed(speed: Any, model_speed: Any) -> Any:
    """Return whether a speed is too far from the model's.

    Args:
        speed: Speed (m/s).
        model_speed: Speed of the model (m/s).

    Returns:
        True beyond `SPEED_TOLERANCE`.
    """
    return absolute(maximum(speed, MIN_SPEED) - model_speed) > SPEED_TOLERANCE * model_speed


@jit
def filter_speed(f: FilterRecord, sample: float) -> Any:
    """Compute the low-passed mean of the front wheels' speeds; a bad sample is skipped.

    Args:
        f: Memory of the filter.
        sample: New sample of that mean (m/s).

    Returns:
        Low-passed speed (m/s).
    """
    if not is_finite(sample):
        return f.speed
    if f.model_speed == 0.0:
        return sample
    return smooth_speed(f.speed, sample, f.smoothing)


@jit
def is_model_outdated(f: FilterRecord, speed: float) -> Any:
    """Return whether the model has to be built anew.

    Args:
        f: Memory of the filter.
        speed: Speed (m/s).

    Returns:
        True where the speed is too far from the model's.
    """
    return is_speed_changed(speed, f.model_speed)


@jit
def find_cell(f: FilterRecord, speed: float) -> Any:
    """Find the table of gains nearest to a speed.

    Args:
        f: Memory of the filter.
        speed: Speed (m/s).

    Returns:
        Index of the cell.
    """
    if f.spacing == 0.0:
        return 0
    V = minimum(maximum(speed, f.low), f.high)
    return int((V - f.low) / f.spacing + 0.5)


@jit
def find_next_cell(f: FilterRecord, sample: float) -> Any:
    """Find the table of gains that the next row will use.

    Args:
        f: Memory of the filter.
        sample: The row's sample of the speed (m/s).

    Returns:
        Index of the cell.
    """
    if f.measured == 1:
        speed = filter_speed(f, sample)
        if is_model_outdated(f, speed):
            return find_cell(f, speed)
    return f.cell


@jit
def locate_step_row(f: FilterRecord) -> Any:
    """Locate the gain of the first fast measurement in this step.

    Args:
        f: Memory of the filter.

    Returns:
        Row of the table.
    """
    return 1 + f.at * maximum(f.fasts, 1)


@jit
def locate_frame_row(f: FilterRecord, s: int, frame: int) -> Any:
    """Locate the gain of a slow sensor's first row for a frame.

    Args:
        f: Memory of the filter.
        s: Index of the slow sensor.
        frame: Frame of the pattern; the pattern's length for the rule between samples.

    Returns:
        Row of the table.
    """
    return 1 + f.cycle * maximum(f.fasts, 1) + frame * f.rows[s]
