"""The car as nonlinear predictive control foresees it: the plant's own text, many plans at once.

A plan is what is added to the linear regulator's answer, constant in blocks of steps; the sum is
limited as the plant limits it. So the plan of zeros is the regulator itself, and where nothing is
limited or bent it is the best one. As many plans as a SIMD value has lanes are rolled out at once.
"""

import math
from typing import Any, NamedTuple

from ...envs.backend.arrays import at, put
from ...envs.backend.decorators import apart, inlined
from ...envs.backend.primitives import maximum, minimum, select
from ...envs.engine.tick import load_at
from ...envs.ticks import TICK
from ...envs.vehicle.actuators import distribute, lagged, slewed, torque_limit, within_stop
from ...envs.vehicle.dynamics import Motion, Push, sideslip_angle
from ...envs.vehicle.integration import rk4
from .prediction_model import Model, Start

RESIDUALS = 6  # of a step: slip, yaw rate, moment and steering with the spread of each in the step
TERMINAL = 4  # residuals behind the last step


class Now(NamedTuple):
    """A prediction's state between steps."""

    motion: Any
    T_l: Any
    T_r: Any
    delta_f: Any
    slewing: Any
    beta_ref: Any
    gamma_ref: Any
    F_d: Any
    N_d: Any


@inlined
def clipped(value: Any, most: Any) -> Any:
    """The value within +-most."""
    return minimum(maximum(value, 0.0 - most), most)


@inlined
def at_limit(value: Any, low: Any, high: Any) -> Any:
    """1 or -1 where the value is at the upper or the lower limit, else 0."""
    close = 1e-9 * (high - low)
    return select(value >= high - close, 1.0, select(value <= low + close, -1.0, 0.0))


@inlined
def product(M: Any, row: int, model: Model, driver: Any, now: Now, beta: Any) -> Any:
    """A row of M (rows, 9) times the states of the design model with forces."""
    share = 0.5 * model.car.d_r / model.car.r / model.full_scale * (now.T_r - now.T_l)
    lateral = M[row, 0] * beta + M[row, 1] * now.motion.gamma + M[row, 2] * share
    held = M[row, 3] * now.delta_f + M[row, 4] * driver + M[row, 5] * now.beta_ref
    pushed = M[row, 6] * now.gamma_ref + M[row, 7] * now.F_d + M[row, 8] * now.N_d
    return lateral + held + pushed


@inlined
def commanded(
    model: Model, start: Start, K: Any, now: Now, beta: Any, added: Any, turn: Any
) -> Any:
    """(share of full scale, rad of added steering, which of both are at a limit): the regulator's
    answer and a plan's part.

    Where nothing steers K has one row, and there is no turn. At a limit: 1 or -1.
    """
    most = start.most
    share = clipped(0.0 - product(K, 0, model, start.driver, now, beta), most) + added
    wheel, bound = 0.0 * share, 0.0 * share
    if len(K) > 1:
        wheel = clipped(0.0 - product(K, 1, model, start.driver, now, beta), model.authority)
        wheel = clipped(wheel + model.authority * turn, model.authority)
        wheel = slewed(now.slewing, wheel, model.slew)
        high = minimum(now.slewing + model.slew, model.authority)
        low = maximum(now.slewing - model.slew, 0.0 - model.authority)
        bound = at_limit(wheel, low, high)
    share = clipped(share, most)
    return share, wheel, at_limit(share, 0.0 - most, most), bound


@inlined
def advanced(
    model: Model, start: Start, now: Now, share: Any, wheel: Any, more: Any, turn: Any
) -> Any:
    """(the state after a step, the effort's four residuals) for commands held over it.

    more, turn: of share and wheel, beyond every limit of theirs.
    """
    kind, motor, steering, h = model.kind, model.motor, model.steering, model.step
    car, driver = start.car, start.driver
    most = torque_limit(now.motion.v_x, car)
    N_z = share * model.full_scale
    T_l, T_r = distribute(N_z, start.a_x, car, model.yaw_first, most)
    beyond = more * (model.full_scale * car.r / car.d_r)
    T_l, T_r = T_l - beyond, T_r + beyond
    extra = within_stop(wheel, driver, model.stop) + turn
    steer = driver + extra
    loads = (
        load_at(lagged(steer, now.delta_f, steering.start), T_l, T_r, now, motor.start, car, kind),
        load_at(
            lagged(steer, now.delta_f, steering.middle), T_l, T_r, now, motor.middle, car, kind
        ),
        load_at(lagged(steer, now.delta_f, steering.end), T_l, T_r, now, motor.end, car, kind),
    )
    push, road = Push(now.F_d, now.N_d, 0.0), model.road
    motion = rk4(now.motion, loads, push, car, road, h, kind.small_angle, kind.law, kind.roll)
    per_torque = 0.5 * car.d_r / car.r / model.full_scale
    asked, before = per_torque * (T_r - T_l), per_torque * (now.T_r - now.T_l)
    added = now.delta_f - driver
    efforts = (
        model.per_share * lagged(asked, before, model.motor_work[0]),
        model.per_share * model.motor_work[1] * (before - asked),
        model.per_steer * lagged(extra, added, model.steering_work[0]),
        model.per_steer * model.steering_work[1] * (added - extra),
    )
    after = Now(
        motion,
        lagged(T_l, now.T_l, motor.end),
        lagged(T_r, now.T_r, motor.end),
        lagged(steer, now.delta_f, steering.end),
        wheel,
        lagged(start.steady[0], now.beta_ref, model.ref_rest),
        lagged(start.steady[1], now.gamma_ref, model.ref_rest),
        model.keep * now.F_d,
        model.keep * now.N_d,
    )
    return after, efforts


@apart
def roll_out(
    model: Model,
    start: Start,
    K: Any,
    terminal: Any,
    blocks: Any,
    plans: Any,
    pokes: Any,
    residuals: Any,
    limits: Any,
    first: Any,
) -> None:
    """Roll out plans (variables, lanes): fill their residuals and their first commands.

    pokes: (variables, lanes), which change the commands beyond their limits, for slopes that a
    limit does not hide. limits: (variables, lanes), filled with whether a block starts at one.

    blocks: steps of each. Variables: of every block the share of the yaw moment and, where the car
    steers, that of the authority. residuals: (RESIDUALS steps + TERMINAL, lanes), whose squares
    sum to J but for its cap. first: (2, lanes).
    """
    zero, m, moved = 0.0 * at(plans, 0), len(K), start.motion
    motion = Motion(
        moved.v_x + zero, moved.v_y + zero, moved.gamma + zero, zero, zero, zero, zero, zero, zero,
        moved.phi + zero, moved.phi_dot + zero,
    )  # fmt: skip
    now = Now(
        motion,
        start.T_l + zero,
        start.T_r + zero,
        start.delta_f + zero,
        start.slewing + zero,
        start.refs[0] + zero,
        start.refs[1] + zero,
        start.push.F_d + zero,
        start.push.N_d + zero,
    )
    beta = sideslip_angle(now.motion.v_x, now.motion.v_y, model.kind.small_angle)
    row, last = 0, RESIDUALS * (blocks.sum() - 1)
    for b in range(len(blocks)):
        added, more, turn, bend = at(plans, m * b), at(pokes, m * b), zero, zero
        if m > 1:
            turn, bend = at(plans, m * b + 1), model.authority * at(pokes, m * b + 1)
        for k in range(blocks[b]):
            share, wheel, ends, bound = commanded(model, start, K, now, beta, added, turn)
            if k == 0:
                put(limits, ends, m * b)
                if m > 1:
                    put(limits, bound, m * b + 1)
            if row == 0:
                put(first, share, 0)
                put(first, wheel, 1)
            now, efforts = advanced(model, start, now, share, wheel, more, bend)
            beta = sideslip_angle(now.motion.v_x, now.motion.v_y, model.kind.small_angle)
            # ticks after the first step's start up to its end, by the trapezoid rule
            node = math.sqrt(model.step if row < last else 0.5 * (model.step + TICK))
            span = math.sqrt(model.step)
            put(residuals, node * model.per_beta * (beta - now.beta_ref), row)
            put(residuals, node * model.per_gamma * (now.motion.gamma - now.gamma_ref), row + 1)
            put(residuals, span * efforts[0], row + 2)
            put(residuals, span * efforts[1], row + 3)
            put(residuals, span * efforts[2], row + 4)
            put(residuals, span * efforts[3], row + 5)
            row += RESIDUALS
    for j in range(TERMINAL):
        put(residuals, product(terminal, j, model, start.driver, now, beta), row + j)
