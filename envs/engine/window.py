"""The window of an env-step: noise and steering of its ticks, computed ahead, and motion and cost.

Its columns are the ticks of the step. A block of vehicles has a third axis, their lanes.
"""

from typing import Annotated, NamedTuple

import numpy as np

from ..numerics.functions import CHANNELS, TICK, draw_normals
from ..numerics.jit import inline, jit
from ..numerics.packed import (
    count_lanes,
    iota,
    load_element,
    make_offsets,
    read,
    store_element,
    write,
)
from ..numerics.primitives import Scalar, Vector, absolute, to_float, to_int, to_word
from ..numerics.simd import LANES
from ..record import Array
from ..scenarios.driver import WANDER_START, compute_steering, interpolate_trace
from ..scenarios.road import TrackPath, compute_path_offset
from ..sensors.inertial import NormalDraws
from ..task import RATE_TICKS, compute_cost_rate
from ..vehicle.dynamics import Motion, compute_sideslip_angle
from .layout import PARAMS_WIDTH, EpisodeArrays, P, StepVariant, TaskParams, Z


class CostInputs(NamedTuple):
    """Inputs of a tick's cost besides the motion at its end."""

    beta_ref: Scalar  # rad
    gamma_ref: Scalar  # rad/s
    effort_change: Scalar  # of `effort` over `RATE_TICKS`
    added: Scalar  # rad, added steering
    effort: Scalar  # yaw moment as a fraction of full scale; no `_TickCost` overwrites it


class _TickCost(NamedTuple):
    """Cost and failures of a tick."""

    cost: Scalar  # 1/s, cost rate
    beta: Scalar  # rad
    spun: Scalar  # whether the car spins
    off: Scalar  # whether it has left the road


class _StepWindow(NamedTuple):
    """Rows of the window: normal numbers, steering angle (rad), motion and cost inputs."""

    inertial: Annotated[tuple[Scalar, ...], 4]
    wheels: Annotated[tuple[Scalar, ...], 4]
    vibration: Scalar
    steer: Scalar  # rad, the profile's
    track: Motion
    cost_inputs: CostInputs


WINDOW, WINDOW_HEIGHT = make_offsets(_StepWindow)
TICK_COST = _TickCost(*WINDOW.cost_inputs[:4])
"""The rows that hold a tick's cost once it is evaluated, flags as 0 and 1."""
_DECAY, _NOISE_GAIN, _HOLD = P.steering_profile[WANDER_START : WANDER_START + 3]


def make_window(n: int) -> Array:
    """Make a window of zeros, shape (WINDOW_HEIGHT, columns)."""
    return np.zeros((WINDOW_HEIGHT, -(-n // LANES) * LANES))  # whole lanes


@jit
def compute_profile_angle(p: Vector, tick: Scalar) -> Scalar:
    """Compute the steering angle (rad) of a profile, or of the trace behind `EpisodeParams`."""
    if len(p) > PARAMS_WIDTH and p[PARAMS_WIDTH] > 0.0:
        return interpolate_trace(tick, p[PARAMS_WIDTH:])
    return compute_steering(tick, p[P.steering_profile[0] :])


@jit
def overwrite_steering(row: EpisodeArrays, n: int) -> None:
    """Write the angles of a trace, or of a wandering driver, over those of the profile."""
    p, z, window = row.p, row.z, row.window
    if len(p) > PARAMS_WIDTH and p[PARAMS_WIDTH] > 0.0:
        for j in range(n):
            window[WINDOW.steer, j] = interpolate_trace(z[Z.clock.tick] + (j + 1), p[PARAMS_WIDTH:])
    hold = p[_HOLD]
    if hold > 0.0:
        angle = z[Z.driver]
        key_low, key_high = to_word(z[Z.clock.key_low]), to_word(z[Z.clock.key_high])
        for j in range(n):
            tick = int(z[Z.clock.tick]) + (j + 1)
            if tick % int(hold) == 0:
                wander_noise = draw_normals(key_low, key_high, tick, CHANNELS.steering)[0]
                angle = p[_DECAY] * angle + p[_NOISE_GAIN] * wander_noise
            window[WINDOW.steer, j] = angle


@jit
def precompute_window(row: EpisodeArrays, n: int, variant: StepVariant) -> None:
    """Write noise and steering of one vehicle's next ticks."""
    first = int(row.z[Z.clock.tick]) + 1
    for j in range(0, n, count_lanes()):
        _write_ticks(row, j, iota(first + j), variant)
    overwrite_steering(row, n)


@jit
def precompute_lane_window(row: EpisodeArrays, n: int, variant: StepVariant) -> None:
    """Write noise and steering of a block's next ticks, but for `overwrite_steering`."""
    tick = load_element(row.z, Z.clock.tick)
    for j in range(n):
        _write_ticks(row, j, to_int(tick + (j + 1)), variant)


@jit
def _write_ticks(row: EpisodeArrays, j: int, ticks: Scalar, variant: StepVariant) -> None:
    """Write noise and steering of a tick, or of as many as lanes, into the window from j on."""
    clock, window = read(row.z, Z.clock), row.window
    key_low, key_high = to_word(clock.key_low), to_word(clock.key_high)
    write(window, draw_normals(key_low, key_high, ticks, CHANNELS.inertial), WINDOW.inertial, j)
    write(window, draw_normals(key_low, key_high, ticks, CHANNELS.wheels), WINDOW.wheels, j)
    if variant.has_errors:
        vibration = draw_normals(key_low, key_high, ticks, CHANNELS.errors)[0]
        store_element(window, vibration, WINDOW.vibration, j)
    if not variant.has_driver:
        steer = compute_steering(to_float(ticks), row.p[P.steering_profile[0] :])
        store_element(window, steer, WINDOW.steer, j)


@jit
def read_draws(window: Vector, j: int) -> NormalDraws:
    """Read the random numbers of a tick.

    Args:
        window: Window of the step.
        j: Number of the tick in the step.
    """
    inertial, wheels = read(window, WINDOW.inertial, j), read(window, WINDOW.wheels, j)
    return NormalDraws(inertial, wheels, load_element(window, WINDOW.vibration, j))


@inline
def compute_tick_cost(
    motion: Motion, cost_inputs: CostInputs, task: TaskParams, path: TrackPath,
    variant: StepVariant,
) -> _TickCost:  # fmt: skip
    """Compute cost and failures of a tick from the motion at its end.

    No tick of the plant waits for it: a step's ticks are evaluated together.

    Args:
        motion: Motion at the tick's end.
        cost_inputs: The other inputs of the cost.
        task: Limits of the episode.
        path: The driver's path.
        variant: Variant of the tick.
    """
    beta = compute_sideslip_angle(motion.v_x, motion.v_y, variant.small_angle)
    e_beta, e_gamma = beta - cost_inputs.beta_ref, motion.gamma - cost_inputs.gamma_ref
    path_offset = compute_path_offset(path, motion.s) if variant.has_driver else 0.0
    lateral_deviation = motion.y - path_offset
    effort_rate = cost_inputs.effort_change * (1.0 / (RATE_TICKS * TICK))
    rate_cost, steer = task.moment_rate * (effort_rate * effort_rate), cost_inputs.added
    return _TickCost(
        compute_cost_rate(e_beta, e_gamma, cost_inputs.effort, steer, variant.reference, rate_cost),
        beta,
        (absolute(beta) > task.spin) & (motion.v_x > 0.0),  # backing up is no spin
        absolute(lateral_deviation) > task.half_width,
    )
