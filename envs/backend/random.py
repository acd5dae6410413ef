"""Counter-based random numbers: each one is a pure function of (key, tick, channel).

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) gives four
32-bit words for a counter and a key. Words live in signed 64-bit integers under masks, so that
compiled code, Python, NumPy and torch compute the same words.
"""

from typing import Any, NamedTuple

from .decorators import jit
from .elementary import PI, cos_kernel, quadrant, sin_kernel
from .primitives import frexp, maximum, sqrt, to_float

_MASK = 0xFFFFFFFF
_M0, _M1 = 0xD2511F53, 0xCD9E8D57
_W0, _W1 = 0x9E3779B9, 0xBB67AE85
_2_32 = 4294967296.0
_LN2 = 0.6931471805599453
_SQRT_HALF = 0.7071067811865476


class Channels(NamedTuple):
    """The table of channels: a block of four numbers for each use. New blocks go at the end."""

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


CHANNELS = Channels()


@jit
def philox(key_low: int, key_high: int, a: int, b: int, c: int = 0, d: int = 0) -> Any:
    """Four random 32-bit words (non-negative integers) for a counter (a, b, c, d)."""
    k0, k1 = key_low & _MASK, key_high & _MASK  # tells compilers that products fit
    a, b, c, d = a & _MASK, b & _MASK, c & _MASK, d & _MASK
    for _ in range(10):
        p0 = _M0 * a
        p1 = _M1 * c
        a, b, c, d = (
            ((p1 >> 32) & _MASK) ^ b ^ k0,
            p1 & _MASK,
            ((p0 >> 32) & _MASK) ^ d ^ k1,
            p0 & _MASK,
        )
        k0 = (k0 + _W0) & _MASK
        k1 = (k1 + _W1) & _MASK
    return a, b, c, d


@jit
def to_uniform(word: int) -> Any:
    """A number in (0, 1) from a 32-bit word; never 0, never 1."""
    return (to_float(word) + 0.5) / _2_32


@jit
def _log_uniform(word: int) -> Any:
    """log((word + 0.5) / 2^32), error below 1e-13."""
    m, exponent = frexp(to_float(2 * word + 1))  # of 2^33
    z = (m - _SQRT_HALF) / (m + _SQRT_HALF)  # |z| < 0.1716
    q = z * z
    p = 1.0 / 15.0
    p = p * q + 1.0 / 13.0
    p = p * q + 1.0 / 11.0
    p = p * q + 1.0 / 9.0
    p = p * q + 1.0 / 7.0
    p = p * q + 1.0 / 5.0
    p = p * q + 1.0 / 3.0
    return 2.0 * (z + z * (q * p)) - (33.0 - exponent + 0.5) * _LN2


@jit
def _draw_normal_pair(first: int, second: int) -> Any:
    """Two standard normal numbers from two words (Box and Muller)."""
    radius = sqrt(maximum(-2.0 * _log_uniform(first), 0.0))  # below 0 by rounding in float32 alone
    turn = second + (1 << 29)  # the quarter turns are the two leading bits, exactly
    q = turn >> 30
    r = (to_float(turn - (q << 30)) - 536870912.0 + 0.5) * (2.0 * PI / _2_32)
    s, c = quadrant(to_float(q & 3), sin_kernel(r), cos_kernel(r))
    return radius * c, radius * s


@jit
def draw_normals(key_low: int, key_high: int, tick: int, block: int) -> Any:
    """Four independent standard normal numbers of a block at a tick."""
    a, b, c, d = philox(key_low, key_high, tick, block)
    n0, n1 = _draw_normal_pair(a, b)
    n2, n3 = _draw_normal_pair(c, d)
    return n0, n1, n2, n3


@jit
def draw_uniforms(key_low: int, key_high: int, tick: int, block: int, index: int = 0) -> Any:
    """Four independent numbers, uniform in (0, 1), of a block at a tick."""
    a, b, c, d = philox(key_low, key_high, tick, block, index)
    return to_uniform(a), to_uniform(b), to_uniform(c), to_uniform(d)
