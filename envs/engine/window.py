"""The look-ahead window of an env-step: noise and steering programme of its ticks, which do not
depend on the car, computed ahead; and where the car went.

Its columns are the ticks of the step. That of a block of vehicles has a third axis, their lanes.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from ..backend.arrays import abreast, along, at, lane_count, offsets, put, ramp, read, write
from ..backend.decorators import inlined, jit
from ..backend.primitives import absolute, anywhere, select, to_float, whole, word
from ..backend.random import CHANNELS, normals
from ..backend.simd import LANES
from ..record import Array
from ..scenarios.steering import WANDER_AT, steering_at, trace_at
from ..scenarios.tracks import path_offset
from ..sensors.inertial import Chance
from ..task.cost import cost_rate
from ..ticks import TICK
from ..vehicle.dynamics import Motion, sideslip_angle
from .layout import PARAMS_WIDTH, P, Z


class Past(NamedTuple):
    """What is judged of a tick besides the motion that it led to."""

    beta_ref: Any
    gamma_ref: Any
    effort: Any  # of `Acted`
    added: Any


class Verdict(NamedTuple):
    """Cost and failures of a tick."""

    cost: Any  # per second
    beta: Any
    spun: Any  # whether the car spins
    off: Any  # or has left the road


class Window(NamedTuple):
    """Rows of the array: normal numbers, the programme's angle in rad, Motion at the tick's end and
    what is to be judged of it."""

    inertial: Annotated[tuple[Any, ...], 4]
    wheels: Annotated[tuple[Any, ...], 4]
    ahead: Any
    track: Motion
    past: Past


WINDOW, HEIGHT = offsets(Window)
VERDICT = Verdict(*WINDOW.past)
"""The rows in which a tick's Verdict stands once there is one, flags as 0 and 1."""
_KEEP, _FRESH, _HOLD = P.programme[WANDER_AT : WANDER_AT + 3]


@jit
def columns_of(n: int) -> int:
    """The columns for n ticks a step: whole lanes."""
    return -(-n // LANES) * LANES


def window_of(n: int, *lanes: int) -> Array:
    """The array for n ticks a step."""
    return np.zeros((HEIGHT, columns_of(n), *lanes))


@jit
def programmed(p: Any, tick: Any) -> Any:
    """The angle in rad at a tick of one vehicle's programme, or of the trace behind `Params`."""
    if len(p) > PARAMS_WIDTH and p[PARAMS_WIDTH] > 0.0:
        return trace_at(tick, p[PARAMS_WIDTH:])
    return steering_at(tick, p[P.programme[0] :])


@jit
def follow(p: Any, z: Any, n: int, window: Any) -> None:
    """Write the angles of a trace, or of a driver who wanders, over those of the programme."""
    if len(p) > PARAMS_WIDTH and p[PARAMS_WIDTH] > 0.0:
        for j in range(n):
            window[WINDOW.ahead, j] = trace_at(z[Z.clock.tick] + (j + 1), p[PARAMS_WIDTH:])
    hold = p[_HOLD]
    if hold > 0.0:
        angle, key_low, key_high = z[Z.driver], word(z[Z.clock.key_low]), word(z[Z.clock.key_high])
        for j in range(n):
            tick = int(z[Z.clock.tick]) + (j + 1)
            if tick % int(hold) == 0:
                fresh = normals(key_low, key_high, tick, CHANNELS.steering)[0]
                angle = p[_KEEP] * angle + p[_FRESH] * fresh
            window[WINDOW.ahead, j] = angle


@jit
def follows_another(p: Any, width: int) -> bool:
    """Whether `follow` has something to write for one of a block's vehicles at least; p has a
    column for each, `width` is that of their parameters."""
    return width > PARAMS_WIDTH or bool(anywhere(at(p, _HOLD) > 0.0))


@jit
def foresee(p: Any, z: Any, n: int, follows: int, window: Any) -> None:
    """The random numbers and the programme's steering of the next n ticks of one vehicle.

    follows: 1 where the driver reacts to the car, and no programme steers.
    """
    clock = read(z, Z.clock)
    key_low, key_high, first = word(clock.key_low), word(clock.key_high), int(clock.tick) + 1
    programme = p[P.programme[0] :]
    for j in range(0, n, lane_count()):
        ticks = ramp(first + j)
        inertial = normals(key_low, key_high, ticks, CHANNELS.inertial)
        wheels = normals(key_low, key_high, ticks, CHANNELS.wheels)
        write(window, inertial, WINDOW.inertial, j)
        write(window, wheels, WINDOW.wheels, j)
        if not follows:
            put(window, steering_at(to_float(ticks), programme), WINDOW.ahead, j)
    follow(p, z, n, window)


@jit
def foresee_lanes(p: Any, z: Any, n: int, follows: int, window: Any) -> None:
    """The same of a block of vehicles: p, z with a column for each."""
    clock = read(z, Z.clock)
    key_low, key_high = word(clock.key_low), word(clock.key_high)
    programme = p[P.programme[0] :]
    for j in range(n):
        tick = clock.tick + (j + 1)
        inertial = normals(key_low, key_high, whole(tick), CHANNELS.inertial)
        wheels = normals(key_low, key_high, whole(tick), CHANNELS.wheels)
        write(window, inertial, WINDOW.inertial, j)
        write(window, wheels, WINDOW.wheels, j)
        if not follows:
            put(window, steering_at(tick, programme), WINDOW.ahead, j)


@jit
def chance_at(window: Any, j: int) -> Chance:
    """The random numbers of a tick of the step."""
    return Chance(read(window, WINDOW.inertial, j), read(window, WINDOW.wheels, j))


@inlined
def judge(motion: Any, past: Past, task: Any, path: Any, kind: Any) -> Verdict:
    """The Verdict on a tick that led to a motion.

    No tick of the plant waits for it: that of all of a step's follows at once.
    """
    beta = sideslip_angle(motion.v_x, motion.v_y, kind.small_angle)
    e_beta, e_gamma = beta - past.beta_ref, motion.gamma - past.gamma_ref
    aside = motion.y - (path_offset(path, motion.s) if kind.follows else 0.0)
    return Verdict(
        cost_rate(e_beta, e_gamma, past.effort, past.added, kind.reference),
        beta,
        (absolute(beta) > task.spin) & (motion.v_x > 0.0),  # backing up is no spin
        absolute(aside) > task.half_width,
    )


@jit
def judged(window: Any, n: int, cost: Any, fixed: Any, kind: Any) -> tuple[Any, int, bool]:
    """(cost, ticks, whether the last of them is a failure) of a step's n ticks, up to one at which
    a car spins or has left the road. cost: 0, of one car or of those of a block.

    Verdicts take the place of what they are on.
    """
    for j in range(0, n, abreast(window)):
        motion, past = along(window, WINDOW.track, j), along(window, WINDOW.past, j)
        found = judge(motion, past, fixed.task, fixed.path, kind)
        spun, off = select(found.spun, 1.0, 0.0), select(found.off, 1.0, 0.0)
        write(window, (found.cost, found.beta, spun, off), WINDOW.past, j)
    for j in range(n):
        found = read(window, VERDICT, j)
        cost = cost + found.cost * TICK
        if anywhere(found.spun + found.off != 0.0):
            return cost, j + 1, True
    return cost, n, False
