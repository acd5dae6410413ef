"""Env-step of one vehicle: n plant ticks, sensors, packets, cost and observation; compiled.

Order of tick k: sensors sample the state at k; packets with arrival k are delivered, ordered by
(captured tick, sensor). The control of tick k acts until k+1. A step from tick k returns the ticks
k+1 to k+n; a reset returns tick 0 alone. `precompute_window` writes what does not depend on the
car, `integrate_step` moves the car, `finish_step` does slow sensors, observation and report.
"""

from ..numerics.functions import clip
from ..numerics.jit import copy_into, inline, jit, noinline
from ..numerics.packed import load_element, read, store_element, write
from ..numerics.primitives import Matrix, Scalar, Vector, any_lane, maximum, minimum, select
from ..record import FAST
from ..scenarios.steering import DRIVER
from ..task import (
    BAD_ACTION,
    REFUSED,
    REPORT,
    RUNNING,
    WILD,
    WILD_LIMIT,
    compute_failure_cost,
    select_failure,
)
from ..vehicle.tyres import has_load_shift
from .layout import FLAGS, P, Z
from .outputs import observe_fast, observe_slow, sample_slow_sensors, write_report
from .tick import (
    Measurements,
    StepParams,
    StepState,
    StepVariant,
    apply_tyre_change,
    compute_static_load,
    integrate_tick,
)
from .window import TICK_COST, WINDOW, evaluate_cost, precompute_window, read_draws
from .workspace import EpisodeArrays, EpisodeStart, split_workspace


@jit
def make_step_params(p: Vector) -> StepParams:
    """Make the parameters that are constant within an env-step.

    Args:
        p: Packed parameters, shape (PARAMS_WIDTH,).

    Returns:
        The parameters.
    """
    return StepParams(
        car=read(p, P.car), road=read(p, P.road), motor=read(p, P.motor),
        steering=read(p, P.steering), wind=read(p, P.wind), speed_profile=read(p, P.speed_profile),
        target=read(p, P.target), disturbance=read(p, P.disturbance), task=read(p, P.task),
        noise=read(p, P.noise), driver=read(p, P.driver), path=read(p, P.path),
        tyre_change=read(p, P.tyre_change), nominal_car=read(p, P.nominal_car),
    )  # fmt: skip


@jit
def make_step_variant(p: Vector, switches: Vector) -> StepVariant:
    """Make the variant of a vehicle's ticks.

    Args:
        p: Packed parameters, shape (PARAMS_WIDTH,).
        switches: `Switches` of the episode.

    Returns:
        Variant of the ticks.
    """
    flags = read(switches, FLAGS)
    n_lagging = int(p[P.motor.start] > 0.0) + int(p[P.steering.start] > 0.0)
    has_driver = int(flags.steering == DRIVER)
    load_shift = has_load_shift(flags.small_angle, flags.law, flags.roll)
    return StepVariant(
        flags.small_angle, flags.law, flags.reference, flags.roll, has_driver, n_lagging,
        load_shift, flags.road,
    )  # fmt: skip


def get_start_variant(start: EpisodeStart) -> StepVariant:
    """Get the variant of an episode's ticks.

    Args:
        start: Packed start of the episode.

    Returns:
        The variant.
    """
    return StepVariant(*map(int, make_step_variant(start.params, start.switches)))


@jit
def integrate_step(
    p: Vector, z: Vector, variant: StepVariant, yaw_share: Scalar, steer_share: Scalar, n: int,
    rows: Matrix, report: Vector, window: Vector, is_single: bool,
) -> int:  # fmt: skip
    """Integrate plant and fast sensors over n ticks, fewer where the episode ends.

    Args:
        p: Packed parameters; of a block of vehicles p, z and report have a column for each.
        z: Packed state, shape (STATE_WIDTH,).
        variant: Variant of the ticks.
        yaw_share: Yaw moment as a fraction of full scale, within +-1.
        steer_share: Added steering as a fraction of full scale, within +-1.
        n: Number of ticks.
        rows: Fast rows to write, shape (n, FAST_WIDTH); a block's have an axis more, as its window.
        report: Report to write, shape (len(REPORT),).
        window: Noise and steering of the ticks, shape (WINDOW_HEIGHT, columns).
        is_single: Whether it is one vehicle.

    Returns:
        Number of ticks integrated; 0 where one of a block ends early, z and report then unchanged.
    """
    params = make_step_params(p)
    task = params.task
    N_z, added = yaw_share * task.yaw_scale, steer_share * task.authority
    n_run = n
    while True:
        motion, drive, tick = read(z, Z.motion), read(z, Z.drive), load_element(z, Z.clock.tick)
        car = apply_tyre_change(params.car, params.tyre_change, tick > params.tyre_change.tick)
        tyre_load = compute_static_load(drive, car, variant)
        refs, nominal_motion = read(z, Z.refs), read(z, Z.nominal_motion)
        state = StepState(
            motion, drive, tyre_load, load_element(z, Z.driver), car, refs, nominal_motion
        )
        for j in range(n_run):
            motion_before = state.motion
            draws, next_steer = read_draws(window, j), load_element(window, WINDOW.steer, j)
            state, measured = integrate_tick(
                params, N_z, added, state, tick, draws, next_steer, variant
            )
            tick = tick + 1.0
            write(rows[j], measured.row, FAST)
            write(window, state.motion, WINDOW.track, j)
            write(window, measured.cost_inputs, WINDOW.cost_inputs, j)
            is_lost = any_lane(measured.lost)
            if is_lost or any_lane(tick >= task.duration) or j + 1 == n_run:
                cost, done, failed = evaluate_cost(window, j + 1, 0.0 * N_z, params, variant)
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
                write_final_state(
                    z, report, state, measured, failure, beta, refs, tick, cost, task.duration
                )
                return j + 1


@inline
def write_final_state(
    z: Vector, report: Vector, state: StepState, measured: Measurements, failure: Scalar,
    beta: Scalar, refs: Vector, tick: Scalar, cost: Scalar, duration: Scalar,
) -> None:  # fmt: skip
    """Write the end of an env-step, but for the motion.

    Args:
        z: Packed state to write.
        report: Report to write.
        state: State at the end.
        measured: Measurements at the end.
        failure: Code of the failure.
        beta: Sideslip angle (rad).
        refs: (beta_ref, gamma_ref) (rad, rad/s).
        tick: Tick of the end.
        cost: Cost of the step.
        duration: Length of the episode (ticks).
    """
    write(z, state.drive, Z.drive)
    store_element(z, state.driver, Z.driver)
    write(z, refs, Z.refs)
    write(z, state.nominal_motion, Z.nominal_motion)
    store_element(z, tick, Z.clock.tick)
    store_element(z, failure, Z.clock.failure)
    remaining_cost = compute_failure_cost(duration, tick)
    store_element(report, cost + select(failure != RUNNING, remaining_cost, 0.0), REPORT.cost)
    store_element(report, beta, REPORT.beta)
    store_element(report, refs[0], REPORT.beta_ref)
    store_element(report, refs[1], REPORT.gamma_ref)
    store_element(report, measured.steer, REPORT.steer)
    store_element(report, measured.moment, REPORT.yaw_moment)
    store_element(report, select(tick >= duration, 1.0, 0.0), REPORT.ended)


@jit
def finish_step(row: EpisodeArrays, n: int, done: int, bounds: Matrix, window: Vector) -> None:
    """Do slow sensors, observation and report of one vehicle's step.

    Args:
        row: Arrays of the episode.
        n: Ticks of a control period.
        done: Ticks integrated in the step.
        bounds: Bounds of the observation, shape (2, k).
        window: Window of the step, shape (WINDOW_HEIGHT, columns).
    """
    finish_slow_sensors(row, done, _observe_step(row, n, done, bounds), bounds, window)


@noinline
def finish_slow_sensors(
    row: EpisodeArrays, done: int, k: int, bounds: Matrix, window: Vector
) -> None:
    """Do slow sensors and report of one vehicle's step.

    Args:
        row: Arrays of the episode.
        done: Ticks integrated in the step.
        k: Index of the slow sensors' first entry in the observation.
        bounds: Bounds of the observation, shape (2, k).
        window: Window of the step, shape (WINDOW_HEIGHT, columns).
    """
    _finish_report(row, k, sample_slow_ticks(row, 0, done, 0, done, window), bounds)


@jit
def _find_next_due(z: Vector, tick: Scalar) -> Scalar:
    """Find the first tick after this one at which a slow sensor captures or a packet arrives."""
    due = maximum(z[Z.clock.next_due], tick + 1.0)
    for sensor in range(len(Z.slow)):
        capture = z[Z.slow[sensor].next_capture]
        due = select(capture > tick, minimum(due, capture), due)
    return due


@jit
def sample_slow_ticks(
    row: EpisodeArrays, first: int, last: int, count: int, done: int, window: Vector
) -> int:
    """Sample the slow sensors at the ticks of a step's rows first to last - 1.

    Args:
        row: Arrays of the episode.
        first: First of the rows; row 0 is the step's first tick.
        last: The row behind the last one.
        count: Number of packets of the step that were delivered before.
        done: Ticks integrated in the step.
        window: Window of the step, shape (WINDOW_HEIGHT, columns).

    Returns:
        Number of packets of the step that are delivered by then.
    """
    z = row.z
    start_tick = z[Z.clock.tick] - done
    tick = _find_next_due(z, start_tick + first)
    while tick <= start_tick + last:
        j = int(tick - start_tick) - 1
        count = sample_slow_sensors(row, read(window, WINDOW.track, j), tick, count)
        tick = _find_next_due(z, tick)
    return count


@jit
def _observe_step(row: EpisodeArrays, n: int, done: int, bounds: Matrix) -> int:
    """Write the observation but for the slow sensors, whose first entry's index is returned."""
    report, rows = row.report, row.rows
    refs = (report[REPORT.beta_ref], report[REPORT.gamma_ref])
    n_rows = done
    if row.switches[FLAGS.all_samples]:  # the last one stands for the missing
        for j in range(done, n):
            copy_into(rows[done - 1], rows[j])
        n_rows = n
    return int(observe_fast(rows, n_rows, refs, bounds, row.switches, row.obs))


@jit
def finish_outputs(row: EpisodeArrays, n: int, done: int, count: int, bounds: Matrix) -> None:
    """Write observation and report of one vehicle's step.

    Args:
        row: Arrays of the episode.
        n: Ticks of a control period.
        done: Ticks integrated in the step.
        count: Number of packets.
        bounds: Bounds of the observation, shape (2, k).
    """
    _finish_report(row, _observe_step(row, n, done, bounds), count, bounds)


@jit
def _finish_report(row: EpisodeArrays, k: int, count: int, bounds: Matrix) -> None:
    """Write the report, and the observation of the slow sensors from entry k on."""
    report = row.report
    observe_slow(row, k, count, bounds)
    write_report(report, row.z)
    report[REPORT.reward] = -report[REPORT.cost]
    report[REPORT.packets] = count


@jit
def clip_action(action: Vector) -> tuple[float, float]:
    """Clip an action to +-1; NaN where it is not finite.

    Args:
        action: Fractions of full scale, shape (1,) or (2,).

    Returns:
        (yaw moment, added steering) as fractions of full scale.
    """
    # in plain Python a float32 would make float32 of all that follows
    yaw_share = float(action[0])
    steer_share = float(action[1]) if len(action) > 1 else 0.0
    total = yaw_share + steer_share
    if total - total != 0.0:  # not finite
        return total - total, total - total
    return clip(yaw_share, -1.0, 1.0), clip(steer_share, -1.0, 1.0)


@jit
def check_action_range(action: Vector) -> int:
    """Check whether a number of an action is finite and beyond WILD_LIMIT.

    Args:
        action: Fractions of full scale, shape (1,) or (2,).

    Returns:
        WILD where one is, else 0.
    """
    for share in action:
        if (share > WILD_LIMIT or share < -WILD_LIMIT) and share - share == 0.0:
            return WILD
    return 0


@jit
def reject_action(row: EpisodeArrays) -> int:
    """Refuse an action that is not finite, or end the episode as a failure (`fail_bad`).

    Args:
        row: Arrays of the episode.

    Returns:
        REFUSED, or 0: no tick was done.
    """
    z, report = row.z, row.report
    if row.switches[FLAGS.fail_bad] == 0:
        return REFUSED
    z[Z.clock.failure] = BAD_ACTION
    report[REPORT.failure] = BAD_ACTION
    report[REPORT.cost] = compute_failure_cost(row.p[P.task.duration], z[Z.clock.tick])
    report[REPORT.reward] = -report[REPORT.cost]
    report[REPORT.packets] = 0.0
    return 0


@noinline
def step_vehicle(row: EpisodeArrays, action: Vector, n: int, bounds: Matrix, window: Matrix) -> int:
    """Step one vehicle by n ticks, fewer where the episode ends.

    Args:
        row: Arrays of the episode.
        action: Fractions of full scale of the yaw moment and, if there are two, the added steering.
        n: Ticks of a control period.
        bounds: Bounds of the observation, shape (2, k).
        window: Window of the step, shape (WINDOW_HEIGHT, columns).

    Returns:
        Ticks integrated; for an action that is not finite REFUSED, or 0 with `fail_bad`.
    """
    p, z = row.p, row.z
    yaw_share, steer_share = clip_action(action)
    if yaw_share != yaw_share:
        return int(reject_action(row))
    variant = make_step_variant(p, row.switches)
    precompute_window(p, z, n, variant.has_driver, window)
    done = integrate_step(
        p, z, variant, yaw_share, steer_share, n, row.rows, row.report, window, True
    )
    finish_step(row, n, done, bounds, window)
    return int(done)


@jit
def step_workspace(workspace: Vector, action: Vector) -> int:
    """Step the vehicle of a workspace.

    Args:
        workspace: Arrays of an episode in one vector, as `split_workspace` reads it.
        action: Fractions of full scale, shape (1,) or (2,).

    Returns:
        As `step_vehicle`, with WILD added for an action beyond its limit.
    """
    row, bounds, window = split_workspace(workspace)
    done = int(step_vehicle(row, action, len(row.rows), bounds, window))
    return done + check_action_range(action) if done > 0 else done
