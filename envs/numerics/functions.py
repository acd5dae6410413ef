"""Elementary functions, ticks and counter-based random numbers, of the same bits on every backend.

Library functions differ in the last bit between platforms; these polynomials use only + - * / and
correctly rounded square roots. A random number is a pure function of (key, tick, channel) by
Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), whose 32-bit
words are signed 64-bit integers under masks.

Args:
    x: Argument; an angle in rad.
    angle: Angle (rad).
    seconds: Time (s).
    key_low: Lower 32 bits of a key.
    key_high: Its upper 32 bits.
    tick: The tick, or several.
    block: Block of `Channels`.
"""

from typing import NamedTuple

from .jit import as_python, jit
from .primitives import Scalar, absolute, floor, frexp, maximum, minimum, select, sqrt, to_float

_Four = tuple[Scalar, Scalar, Scalar, Scalar]

_TWO_OVER_PI = 0.6366197723675814
_PI_2_HIGH = 1.5707963267341256  # the first 33 bits of pi/2, so that k * high is exact
_PI_2_LOW = 6.077100506506192e-11
PI = 3.141592653589793


@jit
def _sin_kernel(r: Scalar) -> Scalar:
    """Compute sin r for |r| <= pi/4, error below 1e-16."""
    z = r * r
    p = 1.58969099521155010221e-10 * z - 2.50507602534068634195e-08
    p = (p * z + 2.75573137070700676789e-06) * z - 1.98412698298579493134e-04
    p = (p * z + 8.33333333332248946124e-03) * z - 1.66666666666666324348e-01
    return r + r * (z * p)


@jit
def _cos_kernel(r: Scalar) -> Scalar:
    """Compute cos r for |r| <= pi/4, error below 2e-16."""
    z = r * r
    p = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-09
    p = (p * z - 2.75573143513906633035e-07) * z + 2.48015872894767294178e-05
    p = (p * z - 1.38888888888741095749e-03) * z + 4.16666666666666019037e-02
    return 1.0 - 0.5 * z + z * (z * p)


@jit
def sincos(x: Scalar) -> tuple[Scalar, Scalar]:
    """Compute (sin x, cos x), error below 3e-16 + 1e-16 |x| for |x| < 1e6 rad."""
    k = floor(x * _TWO_OVER_PI + 0.5)
    r = (x - k * _PI_2_HIGH) - k * _PI_2_LOW
    return _quadrant(k - 4.0 * floor(0.25 * k), _sin_kernel(r), _cos_kernel(r))


@jit
def _quadrant(q: Scalar, s: Scalar, c: Scalar) -> tuple[Scalar, Scalar]:
    """(sin, cos) of an angle turned by q = 0, 1, 2 or 3 quarter turns."""
    odd = (q == 1.0) | (q == 3.0)
    sign_s = select(q > 1.5, -1.0, 1.0)
    sign_c = select((q == 1.0) | (q == 2.0), -1.0, 1.0)
    return sign_s * select(odd, c, s), sign_c * select(odd, s, c)


@jit
def _atan_kernel(t: Scalar) -> Scalar:
    """arctan t for |t| < 0.1990, error below 1e-16: the series."""
    z = t * t
    p = 1.0 / 19.0 - z * (1.0 / 21.0 - z * (1.0 / 23.0))
    p = 1.0 / 15.0 - z * (1.0 / 17.0 - z * p)
    p = 1.0 / 11.0 - z * (1.0 / 13.0 - z * p)
    p = 1.0 / 7.0 - z * (1.0 / 9.0 - z * p)
    p = 1.0 / 3.0 - z * (1.0 / 5.0 - z * p)
    return t - t * (z * p)


@jit
def atan(x: Scalar) -> Scalar:
    """Compute arctan x (rad), error below 5e-16: reciprocal above 1, two half angles, series."""
    steep = absolute(x) > 1.0
    u = select(steep, -1.0, x) / select(steep, x, 1.0)
    t = u / (1.0 + sqrt(1.0 + u * u))
    t = t / (1.0 + sqrt(1.0 + t * t))
    return 4.0 * _atan_kernel(t) + select(steep, select(x > 0.0, 0.5 * PI, -0.5 * PI), 0.0)


@jit
def compute_arctan_gap(x: Scalar) -> Scalar:
    """Compute 1 - arctan(x) / x, 0 to 1, |x| < 1e30, error below 3e-11 (1 + |x|), one quotient."""
    s, z = absolute(x), x * x
    q = z * z  # short chains: a plant's stage waits for them
    above = 5.586100468508 * z + 1.012690968234 + q * (0.9999999939284 * z + 5.579042025092)
    above = above + s * (6.684892346813 * z + 3.117870231206 + q * 3.109211234682)
    below = 18.58102408883 * z + 3.038072752758 + q * (q + (11.93039565170 * z + 26.57710829909))
    odd = 25.66798879711 * z + 9.353617561616 + q * (4.680007034254 * z + 20.74487056689)
    below = below + s * odd
    return z * above / below


@jit
def compute_sine(x: Scalar) -> Scalar:
    """Compute sin x, error below 1e-13 + 2e-16 |x| for |x| < 1e6 rad, in half of `sincos`' time."""
    k = floor(x * (0.5 * _TWO_OVER_PI) + 0.5)
    r = (x - k * (2.0 * _PI_2_HIGH)) - k * (2.0 * _PI_2_LOW)
    z = r * r
    p = 1.5409520412048905e-10 * z - 2.5030196307617753e-8
    p = (p * z + 2.7556953094702609e-6) * z - 1.9841266729487837e-4
    p = (p * z + 8.3333333210858298e-3) * z - 1.6666666666504574e-1
    s = r + r * (z * p)
    return s - 2.0 * s * (k - 2.0 * floor(0.5 * k))


@jit
def atan2(y: Scalar, x: Scalar) -> Scalar:
    """Compute the angle of (x, y) in [-pi, pi] (rad), error below 1e-15; 0 at the origin.

    The half-angle steps of `atan` without their quotients: tan(a / 2) = y / (x + |(x, y)|).

    Args:
        y: Ordinate of the point.
        x: Abscissa of the point.
    """
    wide, high = absolute(x), absolute(y)
    steep = high > wide
    far, near = maximum(wide, high), minimum(wide, high)
    far = far + sqrt(far * far + near * near)
    far = far + sqrt(far * far + near * near)
    turn = 4.0 * _atan_kernel(near / maximum(far, 1e-300))
    turn = select(steep, 0.5 * PI - turn, turn)
    turn = select(x < 0.0, PI - turn, turn)
    return select(y < 0.0, 0.0 - turn, turn)


@jit
def wrap(angle: Scalar) -> Scalar:
    """Wrap an angle (rad) into [-pi, pi)."""
    return angle - 2.0 * PI * floor(angle / (2.0 * PI) + 0.5)


@jit
def smoothstep(x: Scalar) -> Scalar:
    """Compute the C1 step: 0 below 0, 1 above 1, a cubic between."""
    t = select(x < 0.0, 0.0, select(x > 1.0, 1.0, x))
    return t * t * (3.0 - 2.0 * t)


@jit
def exp(x: Scalar) -> Scalar:
    """Compute e^x for |x| < 8, relative error below 5e-14: polynomial at x / 64, to the 64th."""
    z = x * (1.0 / 64.0)
    p = (1.0 / 362880.0 * z + 1.0 / 40320.0) * z + 1.0 / 5040.0
    p = (p * z + 1.0 / 720.0) * z + 1.0 / 120.0
    p = (p * z + 1.0 / 24.0) * z + 1.0 / 6.0
    p = ((p * z + 0.5) * z + 1.0) * z + 1.0
    for _ in range(6):
        p = p * p
    return p


@jit
def clip(value: Scalar, low: Scalar, high: Scalar) -> Scalar:
    """Clip a value to [low, high].

    Args:
        value: Number to limit.
        low: Lower limit.
        high: Upper limit, at least low.
    """
    return minimum(maximum(value, low), high)


TICK = 0.001
"""The base tick of the simulated car in seconds."""
FOREVER = 1e15  # ticks
NEVER = -1.0


@jit
def round_to_ticks(seconds: Scalar) -> Scalar:
    """Round a time in seconds to whole ticks."""
    return floor(seconds / TICK + 0.5)


_round_to_ticks = as_python(round_to_ticks)


def count_ticks(seconds: float) -> float:
    """Round a time in seconds to whole ticks, without the compiler."""
    return float(_round_to_ticks(seconds))


_MASK = 0xFFFFFFFF
_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85
_2_32 = 4294967296.0
_LN2 = 0.6931471805599453
_SQRT_HALF = 0.7071067811865476


class Channels(NamedTuple):
    """Channels of random numbers, a block of four each; new ones go at the end."""

    inertial: int = 0  # gyro, a_y, a_x, roll rate
    wheels: int = 1  # left and right front wheel speed, disturbance force, disturbance moment
    camera: int = 2  # psi, y_l, two unused
    gps: int = 3  # course, speed, X, Y
    camera_link: int = 4  # uniforms: delay, loss, duplication, one unused
    gps_link: int = 5  # the same of the GPS
    initial: int = 6  # disturbance force and moment at reset; clock phases
    scenario: int = 7  # uniforms of the scenario's draws; the counter's tick is the attempt
    sky: int = 8  # log HDOP's innovation, its start at reset, two unused
    steering: int = 9  # of a driver who wanders; three unused
    errors: int = 10  # a_y's vibration; three unused


CHANNELS = Channels()


@jit
def _philox(key_low: int, key_high: int, a: int, b: int, c: int = 0, d: int = 0) -> _Four:
    """Compute four random 32-bit words for a key and a counter (a, b, c, d)."""
    k0, k1 = key_low & _MASK, key_high & _MASK  # tells compilers that products fit
    a, b, c, d = a & _MASK, b & _MASK, c & _MASK, d & _MASK
    for _ in range(10):
        p0, p1 = _M0 * a, _M1 * c
        a, c = ((p1 >> 32) & _MASK) ^ b ^ k0, ((p0 >> 32) & _MASK) ^ d ^ k1
        b, d = p1 & _MASK, p0 & _MASK
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return a, b, c, d


@jit
def _to_uniform(word: int) -> Scalar:
    """Convert a 32-bit word to a number in (0, 1); never 0, never 1."""
    return (to_float(word) + 0.5) / _2_32


@jit
def _log_uniform(word: int) -> Scalar:
    """log((word + 0.5) / 2^32), error below 1e-13."""
    m, exponent = frexp(to_float(2 * word + 1))  # of 2^33
    z = (m - _SQRT_HALF) / (m + _SQRT_HALF)  # |z| < 0.1716
    q = z * z
    p = (1.0 / 15.0 * q + 1.0 / 13.0) * q + 1.0 / 11.0
    p = (p * q + 1.0 / 9.0) * q + 1.0 / 7.0
    p = (p * q + 1.0 / 5.0) * q + 1.0 / 3.0
    return 2.0 * (z + z * (q * p)) - (33.0 - exponent + 0.5) * _LN2


@jit
def _draw_normal_pair(first: int, second: int) -> tuple[Scalar, Scalar]:
    """Two standard normal numbers from two words (Box and Muller)."""
    radius = sqrt(maximum(-2.0 * _log_uniform(first), 0.0))  # below 0 by rounding in float32 alone
    turn = second + (1 << 29)  # the quarter turns are the two leading bits, exactly
    q = turn >> 30
    r = (to_float(turn - (q << 30)) - 536870912.0 + 0.5) * (2.0 * PI / _2_32)
    s, c = _quadrant(to_float(q & 3), _sin_kernel(r), _cos_kernel(r))
    return radius * c, radius * s


@jit
def draw_normals(key_low: int, key_high: int, tick: int, block: int) -> _Four:
    """Draw four independent standard normal numbers of a block at a tick."""
    a, b, c, d = _philox(key_low, key_high, tick, block)
    n0, n1 = _draw_normal_pair(a, b)
    n2, n3 = _draw_normal_pair(c, d)
    return n0, n1, n2, n3


@jit
def draw_uniforms(key_low: int, key_high: int, tick: int, block: int, index: int = 0) -> _Four:
    """Draw four independent numbers, uniform in (0, 1), of a block at a tick.

    Args:
        key_low: Lower 32 bits of the key.
        key_high: Upper 32 bits.
        tick: The tick, or several.
        block: Block of `Channels`.
        index: Number of the draw, where a block is drawn from more than once at a tick.
    """
    a, b, c, d = _philox(key_low, key_high, tick, block, index)
    return _to_uniform(a), _to_uniform(b), _to_uniform(c), _to_uniform(d)
