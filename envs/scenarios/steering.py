"""What a scenario does over time: steering and wind; and its draws, realised from a key.

A scenario names a range for each quantity of `Draws`. `realise` turns a 64-bit key into numbers
within the ranges and writes them into the packed parameters, in compiled code, so that a batch
can reset its rows without Python.
"""

from typing import Any, NamedTuple

from .backend import anywhere, fixed_tuple, floor, jit, maximum, minimum, select
from .elementary import PI, sincos, smoothstep
from .noise import CHANNELS, uniforms
from .record import TICK

(
    STRAIGHT, SINE, SLALOM, LANE_CHANGE, STEP, RANDOM, DOUBLE_LANE_CHANGE, SINE_WITH_DWELL, RAMP,
    SWEEP, HELD_STEP, DRIVER,
) = range(12)  # fmt: skip
STEERING_KINDS = (
    "straight", "sine", "slalom", "lane-change", "step", "random", "double-lane-change",
    "sine-with-dwell", "ramp", "sweep", "held-step", "driver",
)  # fmt: skip
SINES, STEPS = 4, 3
_RAMP_AT = 5 * SINES + 3 * STEPS
_SWEEP_AT = _RAMP_AT + 3
STEERING_WIDTH = _SWEEP_AT + 5
RISE = 0.2  # s, of a step
FOREVER = 1e15  # ticks
_ATTEMPTS = 64


class Draws(NamedTuple):
    """The quantities a scenario gives as a number or a range."""

    speed: Any  # m/s
    friction: Any
    front_stiffness: Any  # factor on the vehicle's
    rear_stiffness: Any
    onset: Any  # s
    amplitude: Any  # rad
    amplitude_2: Any  # rad, of the second pair of a random steering
    frequency: Any  # Hz
    frequency_2: Any
    frequency_3: Any
    frequency_4: Any
    hold: Any  # s, of a step, a dwell, a ramp, a sweep; from one lane change to the next
    wind_force: Any  # N
    wind_arm: Any  # m, ahead of the centre of gravity
    wind_start: Any  # s
    wind_length: Any  # s
    side: Any  # uniform in (0, 1): below a half the steering is mirrored
    wind_side: Any
    curvature: Any  # 1/m, of the road
    path_speed: Any  # m/s at which a track has its standard's lengths; 0 always
    friction_right: Any  # 0 as on the left
    tyre_change_time: Any  # s; 0 never
    front_change: Any  # factors on the stiffness from then on
    rear_change: Any


DRAWS_WIDTH = len(Draws._fields)


class Wind(NamedTuple):
    """A side wind between two ticks."""

    force: Any  # N, to the left
    arm: Any  # m, ahead of the centre of gravity
    start: Any
    end: Any
    height: Any = 0.0  # m, above the roll axis


@jit
def steering_at(tick: Any, programme: Any) -> Any:
    """The driver's steering command in rad at a tick; `programme` is STEERING_WIDTH numbers."""
    angle = 0.0
    for i in range(SINES):
        start = programme[5 * i + 3]
        s, _ = sincos(programme[5 * i + 1] * ((tick - start) * TICK) + programme[5 * i + 2])
        on = (tick >= start) & (tick < programme[5 * i + 4])
        angle = angle + select(on, programme[5 * i] * s, 0.0)
    for i in range(STEPS):
        k = 5 * SINES + 3 * i
        angle = angle + programme[k] * smoothstep((tick - programme[k + 1]) / programme[k + 2])
    k = _RAMP_AT
    used = programme[k] != 0.0
    if anywhere(used):
        share = (tick - programme[k + 1]) / select(used, programme[k + 2], 1.0)
        angle = angle + programme[k] * minimum(maximum(share, 0.0), 1.0)
    k = _SWEEP_AT
    used = programme[k] != 0.0
    if anywhere(used):
        t = maximum(tick - programme[k + 3], 0.0) * TICK
        grown = minimum(t, programme[k + 4])
        phase = programme[k + 1] * t + programme[k + 2] * (
            0.5 * grown * grown / select(used, programme[k + 4], 1.0) + (t - grown)
        )
        angle = angle + programme[k] * sincos(phase)[0]
    return angle


@jit
def wind_at(tick: Any, wind: Any) -> Any:
    """(force in N, yaw moment, roll moment in N m) of the wind from this tick to the next."""
    force = select((tick >= wind.start) & (tick < wind.end), wind.force, 0.0)
    return force, force * wind.arm, 0.0 - force * wind.height


@jit
def draw(low: Any, high: Any, key_low: int, key_high: int, attempt: int, drawn: Any) -> None:
    """Fill `drawn` (len(Draws)) with numbers in [low, high]; fixed ones keep their bits."""
    u = uniforms(key_low, key_high, attempt, CHANNELS.scenario, 0)
    for i in range(len(drawn)):
        if i % 4 == 0:
            u = uniforms(key_low, key_high, attempt, CHANNELS.scenario, i // 4)
        drawn[i] = low[i] + (high[i] - low[i]) * u[i % 4]


@jit
def stable(d: Any, car: Any) -> Any:
    """Whether the drawn linear vehicle is stable at the drawn speed (with 5 % to spare), before
    its tyres change and after."""
    C_f, C_r = car.C_f * d.front_stiffness, car.C_r * d.rear_stiffness
    changes = d.tyre_change_time > 0.0
    later_f = C_f * select(changes, d.front_change, 1.0)
    later_r = C_r * select(changes, d.rear_change, 1.0)
    return _holds(C_f, C_r, d.speed, car) & _holds(later_f, later_r, d.speed, car)


@jit
def _holds(C_f: Any, C_r: Any, speed: Any, car: Any) -> Any:
    excess = C_f * car.l_f - C_r * car.l_r
    l, v = car.l_f + car.l_r, 1.05 * speed  # noqa: E741
    return car.m * v * v * excess < 2.0 * C_f * C_r * l * l


@jit
def whole_ticks(seconds: Any) -> Any:
    """Whole ticks of a time in seconds."""
    return floor(seconds / TICK + 0.5)


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
    """Fill the steering programme of a kind from drawn numbers; a driver's is empty.

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


@jit
def realise(low: Any, high: Any, key_low: int, key_high: int, car: Any, drawn: Any) -> Any:
    """Draw until the vehicle is stable; returns (the draws, how many unstable ones were lost)."""
    attempt = 0
    draw(low, high, key_low, key_high, attempt, drawn)
    while attempt + 1 < _ATTEMPTS and not stable(Draws(*fixed_tuple(drawn, DRAWS_WIDTH)), car):
        attempt += 1
        draw(low, high, key_low, key_high, attempt, drawn)
    return Draws(*fixed_tuple(drawn, DRAWS_WIDTH)), attempt
