"""The steering programmes: the driver's angle at a time, from numbers that were drawn."""

from typing import Any

from ..backend.arrays import at
from ..backend.decorators import jit
from ..backend.elementary import PI, exp, sincos, smoothstep
from ..backend.primitives import anywhere, floor, maximum, minimum, select, sqrt
from ..ticks import FOREVER, TICK, whole_ticks

(
    STRAIGHT, SINE, SLALOM, LANE_CHANGE, STEP, RANDOM, DOUBLE_LANE_CHANGE, SINE_WITH_DWELL, RAMP,
    SWEEP, HELD_STEP, DRIVER, TRACE, WANDER,
) = range(14)  # fmt: skip
STEERING_KINDS = (
    "straight", "sine", "slalom", "lane-change", "step", "random", "double-lane-change",
    "sine-with-dwell", "ramp", "sweep", "held-step", "driver", "trace",
    "wander",
)  # fmt: skip
SINES, STEPS = 4, 3
_RAMP_AT = 5 * SINES + 3 * STEPS
_SWEEP_AT = _RAMP_AT + 3
WANDER_AT = _SWEEP_AT + 5
STEERING_WIDTH = WANDER_AT + 3
RISE = 0.2  # s, of a step


@jit
def steering_at(tick: Any, programme: Any) -> Any:
    """The driver's steering command in rad at a tick.

    programme: an array that begins with STEERING_WIDTH numbers. A tuple would go through memory at
    every call, and a loop's index into it is a jump table.
    """
    angle = 0.0
    for i in range(SINES):
        start = at(programme, 5 * i + 3)
        s, _ = sincos(at(programme, 5 * i + 1) * ((tick - start) * TICK) + at(programme, 5 * i + 2))
        on = (tick >= start) & (tick < at(programme, 5 * i + 4))
        angle = angle + select(on, at(programme, 5 * i) * s, 0.0)
    for i in range(STEPS):
        k = 5 * SINES + 3 * i
        done = (tick - at(programme, k + 1)) / at(programme, k + 2)
        angle = angle + at(programme, k) * smoothstep(done)
    k = _RAMP_AT
    used = at(programme, k) != 0.0
    if anywhere(used):
        share = (tick - at(programme, k + 1)) / select(used, at(programme, k + 2), 1.0)
        angle = angle + at(programme, k) * minimum(maximum(share, 0.0), 1.0)
    k = _SWEEP_AT
    used = at(programme, k) != 0.0
    if anywhere(used):
        t = maximum(tick - at(programme, k + 3), 0.0) * TICK
        grown = minimum(t, at(programme, k + 4))
        phase = at(programme, k + 1) * t + at(programme, k + 2) * (
            0.5 * grown * grown / select(used, at(programme, k + 4), 1.0) + (t - grown)
        )
        angle = angle + at(programme, k) * sincos(phase)[0]
    return angle


@jit
def trace_at(tick: Any, trace: Any) -> Any:
    """The angle in rad of a recorded trace at a tick, straight between its samples.

    trace: ticks from sample to sample, the samples, and the last one again, which stays.
    """
    place = minimum(tick / trace[0], len(trace) - 2.0)
    k = int(minimum(floor(place), len(trace) - 3.0))
    return trace[k + 1] + (place - k) * (trace[k + 2] - trace[k + 1])


@jit
def wandering(amplitude: Any, hertz: Any, hold: Any) -> Any:
    """(keep, fresh) of a driver who wanders: after `hold` s the angle is keep times what it was
    plus fresh rad times a standard normal number; it has the standard deviation `amplitude`."""
    keep = exp(maximum(-2.0 * PI * hertz * hold, -7.5))  # where `exp` ends
    return keep, amplitude * sqrt(1.0 - keep * keep)


@jit
def _sine(programme: Any, i: int, amplitude: Any, hertz: Any, start: Any, end: Any) -> None:
    programme[5 * i] = amplitude
    programme[5 * i + 1] = 2.0 * PI * hertz
    programme[5 * i + 2] = 0.0
    programme[5 * i + 3] = start
    programme[5 * i + 4] = end


@jit
def _step(programme: Any, i: int, amplitude: Any, start: Any, rise: Any) -> None:
    k = 5 * SINES + 3 * i
    programme[k], programme[k + 1], programme[k + 2] = amplitude, start, rise


@jit
def _dwell(programme: Any, a: Any, hertz: Any, start: Any, dwell: Any) -> None:
    """Three quarters of a sine, its peak held, and the last quarter."""
    peak, last = start + whole_ticks(0.75 / hertz), start + whole_ticks(1.0 / hertz)
    _sine(programme, 0, a, hertz, start, peak)
    _sine(programme, 1, -a, 0.0, peak, peak + dwell)
    programme[5 + 2] = 0.5 * PI
    _sine(programme, 2, a, hertz, peak + dwell, last + dwell)
    programme[10 + 2] = 2.0 * PI * hertz * ((peak - start) * TICK)


@jit
def write_steering(kind: int, d: Any, programme: Any) -> None:
    """Fill the steering programme of a kind from drawn numbers; a driver's and a
    trace's are empty, and one who wanders steers by `wandering` (`engine.window`).

    The slalom, the lane changes, the step and the random steering leave the car on its old
    heading: the slalom starts with a half wave of half the amplitude, the step is followed by its
    mirror image and by straight on, and the sines of a random steering come in pairs whose heading
    angles cancel. The sine with dwell stays at its second peak for `hold` (FMVSS 126). The ramp
    reaches its amplitude after `hold`, the held step after 0.2 s, and both stay there. The sweep
    goes from `frequency` to `frequency_2` within `hold`, evenly in Hz, and stays at that.
    """
    for i in range(SINES):
        _sine(programme, i, 0.0, 0.0, 0.0, 0.0)
    for i in range(STEPS):
        _step(programme, i, 0.0, 0.0, 1.0)
    for i in range(_RAMP_AT, STEERING_WIDTH):
        programme[i] = 0.0
    a = select(d.side < 0.5, -d.amplitude, d.amplitude)
    start = whole_ticks(d.onset)
    if kind == SINE:
        _sine(programme, 0, a, d.frequency, start, FOREVER)
    elif kind == LANE_CHANGE:
        _sine(programme, 0, a, d.frequency, start, start + whole_ticks(1.0 / d.frequency))
    elif kind == DOUBLE_LANE_CHANGE:
        back, period = start + whole_ticks(d.hold), whole_ticks(1.0 / d.frequency)
        _sine(programme, 0, a, d.frequency, start, start + period)
        _sine(programme, 1, -a, d.frequency, back, back + period)
    elif kind == SLALOM:
        half = start + whole_ticks(0.5 / d.frequency)
        _sine(programme, 0, 0.5 * a, d.frequency, start, half)
        _sine(programme, 1, -a, d.frequency, half, FOREVER)
    elif kind == STEP:
        length, rise = whole_ticks(d.hold), whole_ticks(RISE)
        _step(programme, 0, a, start, rise)
        _step(programme, 1, -2.0 * a, start + length, rise)
        _step(programme, 2, a, start + 2.0 * length, rise)
    elif kind == RANDOM:
        second = select(d.side < 0.5, -d.amplitude_2, d.amplitude_2)
        _sine(programme, 0, a, d.frequency, start, FOREVER)
        _sine(programme, 1, -a * (d.frequency_2 / d.frequency), d.frequency_2, start, FOREVER)
        _sine(programme, 2, second, d.frequency_3, start, FOREVER)
        _sine(
            programme, 3, -second * (d.frequency_4 / d.frequency_3), d.frequency_4, start, FOREVER
        )
    elif kind == SINE_WITH_DWELL:
        _dwell(programme, a, d.frequency, start, whole_ticks(d.hold))
    elif kind == RAMP:
        k = _RAMP_AT
        programme[k], programme[k + 1], programme[k + 2] = a, start, whole_ticks(d.hold)
    elif kind == SWEEP:
        k = _SWEEP_AT
        programme[k], programme[k + 1] = a, 2.0 * PI * d.frequency
        programme[k + 2] = 2.0 * PI * (d.frequency_2 - d.frequency)
        programme[k + 3], programme[k + 4] = start, d.hold
    elif kind == HELD_STEP:
        _step(programme, 0, a, start, whole_ticks(RISE))
    elif kind == WANDER:
        keep, fresh = wandering(d.amplitude, d.frequency, d.hold)
        k = WANDER_AT
        programme[k], programme[k + 1], programme[k + 2] = keep, fresh, whole_ticks(d.hold)
