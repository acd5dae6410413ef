"""What a scenario does over time: steering, wind, speed; and its draws, realised from a key.

A scenario names a range for each quantity of `Draws`. `realise` turns a 64-bit key into numbers
within the ranges and writes them into the packed parameters, in compiled code, so that a batch
can reset its rows without Python.
"""

from typing import Any, NamedTuple

from .backend import fixed_tuple, floor, inlined, jit, maximum, minimum, select
from .elementary import PI, sincos, smoothstep
from .noise import CHANNELS, uniforms
from .record import TICK

STRAIGHT, SINE, SLALOM, LANE_CHANGE, STEP, RANDOM, DOUBLE_LANE_CHANGE = range(7)
STEERING_KINDS = (
    "straight", "sine", "slalom", "lane-change", "step", "random", "double-lane-change",
)  # fmt: skip
SINES, STEPS = 4, 3
STEERING_WIDTH = 5 * SINES + 3 * STEPS
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
    hold: Any  # s, of each step; from one lane change to the next
    wind_force: Any  # N
    wind_arm: Any  # m, ahead of the centre of gravity
    wind_start: Any  # s
    wind_length: Any  # s
    side: Any  # uniform in (0, 1): below a half the steering is mirrored
    wind_side: Any


DRAWS_WIDTH = len(Draws._fields)


class Wind(NamedTuple):
    """A side wind between two ticks."""

    force: Any  # N, to the left
    arm: Any  # m, ahead of the centre of gravity
    start: Any
    end: Any
    height: Any = 0.0  # m, above the roll axis


class Pace(NamedTuple):
    """The driver's longitudinal work: a speed held or followed by PI, or an acceleration."""

    speed: Any  # m/s, at the start and to hold
    hold: Any  # 1 hold the speed that `acceleration` and `surge` make of it; 0 apply them alone
    acceleration: Any  # m/s2, from start to end
    start: Any  # tick
    end: Any
    k_p: Any  # 1/s
    k_i: Any  # 1/s2
    surge: Any = 0.0  # m/s2, amplitude of a sine
    surge_rate: Any = 1.0  # rad/s


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
    return angle


@jit
def wind_at(tick: Any, wind: Any) -> Any:
    """(force in N, yaw moment, roll moment in N m) of the wind from this tick to the next."""
    force = select((tick >= wind.start) & (tick < wind.end), wind.force, 0.0)
    return force, force * wind.arm, 0.0 - force * wind.height


@inlined
def acceleration_command(tick: Any, v_x: Any, integral: Any, pace: Any, limit: Any) -> Any:
    """(a_x command in m/s2, next integral): PI on the speed with the integral held at the limit.

    The wanted speed starts at `pace.speed` and is the integral of the wanted acceleration, which
    is fed forward.
    """
    ahead = select((tick >= pace.start) & (tick < pace.end), pace.acceleration, 0.0)
    since = (minimum(maximum(tick, pace.start), pace.end) - pace.start) * TICK
    speed = pace.speed + pace.acceleration * since
    if pace.surge != 0.0:
        s, c = sincos(pace.surge_rate * (tick * TICK))
        ahead = ahead + pace.surge * s
        speed = speed + pace.surge / pace.surge_rate * (1.0 - c)
    error = speed - v_x
    wanted = pace.k_p * error + integral + pace.hold * ahead
    held = minimum(maximum(wanted, 0.0 - limit), limit)
    grown = integral + pace.k_i * error * TICK
    integral = select(wanted == held, grown, integral)
    return pace.hold * held + (1.0 - pace.hold) * ahead, integral


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
    """Whether the drawn linear vehicle is stable at the drawn speed (with 5 % to spare)."""
    C_f, C_r = car.C_f * d.front_stiffness, car.C_r * d.rear_stiffness
    excess = C_f * car.l_f - C_r * car.l_r
    l, v = car.l_f + car.l_r, 1.05 * d.speed  # noqa: E741
    return car.m * v * v * excess < 2.0 * C_f * C_r * l * l


@jit
def _ticks(seconds: Any) -> Any:
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
def write_steering(kind: int, d: Any, programme: Any) -> None:
    """Fill the steering programme of a kind from drawn numbers.

    All but the plain sine leave the car on its old heading: the slalom starts with a half wave of
    half the amplitude, the step is followed by its mirror image and by straight on, and the sines
    of a random steering come in pairs whose heading angles cancel.
    """
    for i in range(SINES):
        _sine(programme, i, 0.0, 0.0, 0.0, 0.0)
    for i in range(STEPS):
        _step(programme, i, 0.0, 0.0, 1.0)
    a = select(d.side < 0.5, -d.amplitude, d.amplitude)
    start = _ticks(d.onset)
    if kind == SINE:
        _sine(programme, 0, a, d.frequency, start, FOREVER)
    elif kind == LANE_CHANGE:
        _sine(programme, 0, a, d.frequency, start, start + _ticks(1.0 / d.frequency))
    elif kind == DOUBLE_LANE_CHANGE:
        back, period = start + _ticks(d.hold), _ticks(1.0 / d.frequency)
        _sine(programme, 0, a, d.frequency, start, start + period)
        _sine(programme, 1, -a, d.frequency, back, back + period)
    elif kind == SLALOM:
        half = start + _ticks(0.5 / d.frequency)
        _sine(programme, 0, 0.5 * a, d.frequency, start, half)
        _sine(programme, 1, -a, d.frequency, half, FOREVER)
    elif kind == STEP:
        length, rise = _ticks(d.hold), _ticks(0.2)
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


@jit
def realise(low: Any, high: Any, key_low: int, key_high: int, car: Any, drawn: Any) -> Any:
    """Draw until the vehicle is stable; returns (the draws, how many unstable ones were lost)."""
    attempt = 0
    draw(low, high, key_low, key_high, attempt, drawn)
    while attempt + 1 < _ATTEMPTS and not stable(Draws(*fixed_tuple(drawn, DRAWS_WIDTH)), car):
        attempt += 1
        draw(low, high, key_low, key_high, attempt, drawn)
    return Draws(*fixed_tuple(drawn, DRAWS_WIDTH)), attempt
