"""Env-step of one vehicle: n plant ticks, sensors, packets, cost and observation; compiled.

Sensors sample the state at tick k, and the packets that arrive at k are delivered; the control of k
acts until k+1. A step from tick k returns the ticks k+1 to k+n; a reset returns tick 0 alone.
"""

from typing import NamedTuple

from ..numerics.functions import TICK, clip
from ..numerics.jit import inline, jit, noinline
from ..numerics.packed import lane_width, load_element, load_lanes, read, store_element, write
from ..numerics.primitives import Matrix, Scalar, Vector, any_lane, select
from ..record import FAST
from ..scenarios.driver import DRIVER
from ..task import (
    BAD_ACTION,
    RATE_TICKS,
    REFUSED,
    REPORT,
    RUNNING,
    WILD,
    WILD_LIMIT,
    compute_failure_cost,
    select_failure,
)
from ..vehicle.tyres import compute_tyre_load
from .layout import FLAGS, EpisodeArrays, EpisodeStart, P, StepVariant, Z
from .outputs import finish_step
from .tick import Measurements, StepParams, StepState, TickInputs, apply_tyre_change, integrate_tick
from .window import TICK_COST, WINDOW, compute_tick_cost, precompute_window, read_draws

SHARES = (0, 1)
"""Places of an action's numbers: yaw moment, added steering."""


class StepEnd(NamedTuple):
    """The end of an env-step."""

    failure: Scalar  # code
    beta: Scalar  # rad
    refs: Vector  # rad, rad/s, the references of beta and gamma
    tick: Scalar
    cost: Scalar  # of the step


@jit
def make_step_params(p: Vector) -> StepParams:
    """Make the parameters that are constant within an env-step."""
    return StepParams(
        car=read(p, P.car), road=read(p, P.road), motor=read(p, P.motor),
        steering=read(p, P.steering), wind=read(p, P.wind), speed_profile=read(p, P.speed_profile),
        target=read(p, P.target), disturbance=read(p, P.disturbance), task=read(p, P.task),
        noise=read(p, P.noise), driver=read(p, P.driver), path=read(p, P.path),
        tyre_change=read(p, P.tyre_change), nominal_car=read(p, P.nominal_car),
        errors=read(p, P.errors), friction_wave=read(p, P.friction_wave),
    )  # fmt: skip


@jit
def make_step_variant(p: Vector, switches: Vector) -> StepVariant:
    """Make the variant of a vehicle's ticks."""
    flags = read(switches, FLAGS)
    n_lagging = int(p[P.motor.start] > 0.0) + int(p[P.steering.start] > 0.0)
    has_driver = int(flags.steering == DRIVER)
    return StepVariant(
        flags.small_angle, flags.law, flags.reference, flags.roll, has_driver, n_lagging,
        flags.road, flags.has_errors,
    )  # fmt: skip


def get_start_variant(start: EpisodeStart) -> StepVariant:
    """Get the variant of an episode's ticks."""
    return StepVariant(*map(int, make_step_variant(start.params, start.switches)))


@jit
def _read_effort(z: Vector, window: Vector, j: int) -> Scalar:
    """Read the yaw moment's share `RATE_TICKS` before tick j of the step."""
    if j < RATE_TICKS:
        return load_element(z, Z.past_efforts[0] + j)
    return load_element(window, WINDOW.cost_inputs.effort, j - RATE_TICKS)


@jit
def _evaluate_cost(
    window: Matrix, n: int, cost: Scalar, params: StepParams, variant: StepVariant
) -> tuple[Scalar, int, bool]:
    """Evaluate n ticks up to a failure: (cost, from 0 on; ticks; whether the last one fails)."""
    for j in range(0, n, lane_width(window)):
        motion = load_lanes(window, WINDOW.track, j)
        cost_inputs = load_lanes(window, WINDOW.cost_inputs, j)
        tick_cost = compute_tick_cost(motion, cost_inputs, params.task, params.path, variant)
        spun, off = select(tick_cost.spun, 1.0, 0.0), select(tick_cost.off, 1.0, 0.0)
        write(window, (tick_cost.cost, tick_cost.beta, spun, off), TICK_COST, j)
    for j in range(n):
        tick_cost = read(window, TICK_COST, j)
        cost = cost + tick_cost.cost * TICK
        if any_lane(tick_cost.spun + tick_cost.off != 0.0):
            return cost, j + 1, True
    return cost, n, False


@jit
def integrate_step(
    row: EpisodeArrays, variant: StepVariant, shares: Vector, n: int, is_single: bool
) -> int:
    """Integrate plant and fast sensors over n ticks, fewer where the episode ends.

    Args:
        row: Arrays of the episode, or of a block of vehicles, where they have one axis more.
        variant: Variant of the ticks.
        shares: (yaw moment, added steering) as fractions of full scale, within +-1.
        n: Number of ticks.
        is_single: Whether it is one vehicle.

    Returns:
        Number of ticks integrated; 0 where one of a block ends early, z and report then unchanged.
    """
    z, rows, window = row.z, row.rows, row.window
    params = make_step_params(row.p)
    task = params.task
    first_tick = load_element(z, Z.clock.tick)
    acts = first_tick >= task.lead_in
    N_z = select(acts, shares[0] * task.yaw_scale, 0.0)
    added = select(acts, shares[1] * task.authority, 0.0)
    n_run = n
    while True:
        motion, drive, tick = read(z, Z.motion), read(z, Z.drive), first_tick
        car = apply_tyre_change(params.car, params.tyre_change, tick > params.tyre_change.tick)
        tyre_load = compute_tyre_load(drive, car, variant)
        refs, nominal_motion = read(z, Z.refs), read(z, Z.nominal_motion)
        state = StepState(
            motion, drive, tyre_load, load_element(z, Z.driver), car, refs, nominal_motion,
            read(z, Z.errors),
        )  # fmt: skip
        for j in range(n_run):
            motion_before = state.motion
            draws, next_steer = read_draws(window, j), load_element(window, WINDOW.steer, j)
            inputs = TickInputs(N_z, added, draws, next_steer, _read_effort(z, window, j))
            state, measured = integrate_tick(params, inputs, state, tick, variant)
            tick = tick + 1.0
            write(rows[j], measured.row, FAST)
            write(window, state.motion, WINDOW.track, j)
            write(window, measured.cost_inputs, WINDOW.cost_inputs, j)
            is_lost = any_lane(measured.lost)
            if is_lost or any_lane(tick >= task.duration) or j + 1 == n_run:
                cost, done, failed = _evaluate_cost(window, j + 1, 0.0 * N_z, params, variant)
                if not is_single and (is_lost or failed or done < n):
                    return 0
                n_run = done
                if done <= j:  # a tick before this one failed: integrate anew, up to that one
                    break
                tick_cost = read(window, TICK_COST, j)
                motion, beta, refs = state.motion, tick_cost.beta, measured.refs
                if is_lost:  # the last motion that is finite, for `info`
                    motion, beta, refs = motion_before, 0.0 * cost, (0.0 * cost, 0.0 * cost)
                write(z, motion, Z.motion)
                failure = select_failure(measured.lost, tick_cost.spun != 0.0, tick_cost.off != 0.0)
                cost = select(acts, cost, 0.0)
                end = StepEnd(failure, beta, refs, tick, cost)
                if variant.has_errors:
                    for i in range(RATE_TICKS):  # of the last ticks, j + 1 of them of this step
                        effort = _read_effort(z, window, j + 1 + i)
                        store_element(z, effort, Z.past_efforts[0] + i)
                write_final_state(row, state, measured, end, task.duration)
                return j + 1


@inline
def write_final_state(
    row: EpisodeArrays, state: StepState, measured: Measurements, end: StepEnd, duration: Scalar
) -> None:
    """Write the end of an env-step, but for the motion.

    Args:
        row: Arrays of the episode, or of a block.
        state: State at the end.
        measured: Measurements at the end.
        end: What else is known of the end.
        duration: Length of the episode (ticks).
    """
    z, report, tick = row.z, row.report, end.tick
    write(z, state.drive, Z.drive)
    store_element(z, state.driver, Z.driver)
    write(z, end.refs, Z.refs)
    write(z, state.nominal_motion, Z.nominal_motion)
    write(z, state.errors, Z.errors)
    store_element(z, tick, Z.clock.tick)
    store_element(z, end.failure, Z.clock.failure)
    failure_cost = select(end.failure != RUNNING, compute_failure_cost(duration, tick), 0.0)
    store_element(report, end.cost + failure_cost, REPORT.cost)
    store_element(report, end.beta, REPORT.beta)
    store_element(report, end.refs[0], REPORT.beta_ref)
    store_element(report, end.refs[1], REPORT.gamma_ref)
    store_element(report, measured.steer, REPORT.steer)
    store_element(report, measured.moment, REPORT.yaw_moment)
    store_element(report, select(tick >= duration, 1.0, 0.0), REPORT.ended)


@jit
def clip_action(action: Vector) -> tuple[float, float]:
    """Clip an action to +-1, as (yaw moment, added steering); NaN where it is not finite."""
    # in plain Python a float32 would make float32 of all that follows
    yaw_share = float(action[0])
    steer_share = float(action[1]) if len(action) > 1 else 0.0
    total = yaw_share + steer_share
    if total - total != 0.0:  # not finite
        return total - total, total - total
    return clip(yaw_share, -1.0, 1.0), clip(steer_share, -1.0, 1.0)


@jit
def check_action_range(action: Vector) -> int:
    """Check an action's range: WILD where a number is finite and beyond WILD_LIMIT, else 0."""
    for share in action:
        if (share > WILD_LIMIT or share < -WILD_LIMIT) and share - share == 0.0:
            return WILD
    return 0


@jit
def reject_action(row: EpisodeArrays) -> int:
    """Refuse an action that is not finite (REFUSED), or fail the episode by `fail_bad` (0)."""
    z, report = row.z, row.report
    if row.switches[FLAGS.fail_bad] == 0:
        return REFUSED
    z[Z.clock.failure] = BAD_ACTION
    report[REPORT.failure] = BAD_ACTION
    report[REPORT.cost] = compute_failure_cost(row.p[P.task.duration], z[Z.clock.tick])
    report[REPORT.reward], report[REPORT.packets] = -report[REPORT.cost], 0.0
    return 0


@noinline
def step_vehicle(row: EpisodeArrays, action: Vector, n: int) -> int:
    """Step a vehicle by n ticks, fewer at the end: how many, or what `reject_action` returns."""
    shares = clip_action(action)
    if shares[0] != shares[0]:
        return int(reject_action(row))
    variant = make_step_variant(row.p, row.switches)
    precompute_window(row, n, variant)
    done = integrate_step(row, variant, shares, n, True)
    finish_step(row, n, done)
    return int(done)


@jit
def step_episode(row: EpisodeArrays, action: Vector) -> int:
    """Step by a control period as `step_vehicle`, WILD added for an action beyond its limit."""
    done = int(step_vehicle(row, action, len(row.rows)))
    return done + check_action_range(action) if done > 0 else done
