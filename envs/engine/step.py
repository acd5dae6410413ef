"""One env-step of one vehicle: n plant ticks, sensors, delivery, cost, observation; compiled.

Order of tick k: sensors sample the state at k; packets with arrival k are delivered, ordered by
(captured tick, sensor). The control of tick k acts until k+1. A step from tick k returns the
ticks k+1 .. k+n; a reset returns tick 0 alone.

An env-step is three parts. `foresee` writes the numbers that do not depend on the car into a
window array, `drive_on` moves the car tick by tick, `conclude` handles the slow sensors, the
observation and the report.
"""

from typing import Any

from ..backend.arrays import at, put, read, write
from ..backend.decorators import apart, copied, inlined, jit
from ..backend.elementary import clip
from ..backend.primitives import anywhere, select
from ..record import FAST
from ..scenarios.steering import DRIVER
from ..task.cost import rest_of_cost
from ..task.failures import BAD_ACTION, FAR, REFUSED, RUNNING, WILD, failure_of
from ..task.info import REPORT
from ..vehicle.tyres import shifts
from .arrays import Row, Start, parts_of
from .layout import FLAGS, P, Z
from .observe import observe_fast, observe_slow, write_report
from .packets import next_due, sense_slow
from .tick import Fixed, Kind, Moving, Seen, advance, changed, standing_load
from .window import VERDICT, WINDOW, chance_at, foresee, judged


@jit
def fixed_of(p: Any) -> Fixed:
    """Parameters that are constant within an env-step."""
    return Fixed(
        car=read(p, P.car),
        road=read(p, P.road),
        motor=read(p, P.motor),
        steering=read(p, P.steering),
        wind=read(p, P.wind),
        pace=read(p, P.pace),
        target=read(p, P.target),
        disturbance=read(p, P.disturbance),
        task=read(p, P.task),
        noise=read(p, P.noise),
        person=read(p, P.driver),
        path=read(p, P.path),
        change=read(p, P.change),
        leader=read(p, P.leader),
    )


@jit
def kind_of(p: Any, switches: Any) -> Kind:
    """Integers that choose the text of one vehicle's ticks."""
    flags = read(switches, FLAGS)
    lag = int(p[P.motor.start] > 0.0) + int(p[P.steering.start] > 0.0)
    follows = int(flags.steering == DRIVER)
    shifting = shifts(flags.small_angle, flags.law, flags.roll)
    return Kind(
        flags.small_angle,
        flags.law,
        flags.reference,
        flags.roll,
        follows,
        lag,
        shifting,
        flags.road,
    )


def kind_in(start: Start) -> Kind:
    """The same of an episode's start."""
    return Kind(*map(int, kind_of(start.params, start.switches)))


@jit
def drive_on(
    p: Any,
    z: Any,
    kind: Kind,
    share: Any,
    turn: Any,
    n: int,
    rows: Any,
    report: Any,
    window: Any,
    alone: bool,
) -> int:
    """The plant and the fast sensors for n ticks, fewer where the episode ends; returns how many.

    share, turn: of the yaw moment and the added steering, within +-1. rows: filled with the fast
    sensors. p, z, report: vectors, or matrices with a column for each vehicle of a block;
    rows and window have one axis more then. alone: whether it is one vehicle; where one of several
    fails or ends before the others, 0 is returned and z and report are as they were.
    """
    fixed = fixed_of(p)
    task = fixed.task
    N_z, added = share * task.yaw_scale, turn * task.authority
    last = n
    while True:
        motion, drive, tick = read(z, Z.motion), read(z, Z.drive), at(z, Z.clock.tick)
        car = changed(fixed.car, fixed.change, tick > fixed.change.tick)
        load, refs, lead = standing_load(drive, car, kind), read(z, Z.refs), read(z, Z.lead)
        now = Moving(motion, drive, load, at(z, Z.driver), car, refs, lead)
        for j in range(last):
            before = now.motion
            chance, ahead = chance_at(window, j), at(window, WINDOW.ahead, j)
            now, seen = advance(fixed, N_z, added, now, tick, chance, ahead, kind)
            tick = tick + 1.0
            write(rows[j], seen.row, FAST)
            write(window, now.motion, WINDOW.track, j)
            write(window, seen.past, WINDOW.past, j)
            lost = anywhere(seen.lost)
            if lost or anywhere(tick >= task.duration) or j + 1 == last:
                cost, done, failed = judged(window, j + 1, 0.0 * N_z, fixed, kind)
                if not alone and (lost or failed or done < n):
                    return 0
                last = done
                if done <= j:  # the car was no longer running: once more, and only so far
                    break
                verdict = read(window, VERDICT, j)
                motion, beta, refs = now.motion, verdict.beta, seen.refs
                if lost:  # the last that is fit for `info`
                    motion, beta, refs = before, 0.0 * cost, (0.0 * cost, 0.0 * cost)
                write(z, motion, Z.motion)
                failure = failure_of(seen.lost, verdict.spun != 0.0, verdict.off != 0.0)
                write_end(z, report, now, seen, failure, beta, refs, tick, cost, task.duration)
                return j + 1


@inlined
def write_end(
    z: Any,
    report: Any,
    now: Moving,
    seen: Seen,
    failure: Any,
    beta: Any,
    refs: Any,
    tick: Any,
    cost: Any,
    duration: Any,
) -> None:
    """Write the end of an env-step into z, but for the motion, and into its report."""
    write(z, now.drive, Z.drive)
    put(z, now.driver, Z.driver)
    write(z, refs, Z.refs)
    write(z, now.lead, Z.lead)
    put(z, tick, Z.clock.tick)
    put(z, failure, Z.clock.failure)
    rest = rest_of_cost(duration, tick)
    put(report, cost + select(failure != RUNNING, rest, 0.0), REPORT.cost)
    put(report, beta, REPORT.beta)
    put(report, refs[0], REPORT.beta_ref)
    put(report, refs[1], REPORT.gamma_ref)
    put(report, seen.steer, REPORT.steer)
    put(report, seen.moment, REPORT.yaw_moment)
    put(report, select(tick >= duration, 1.0, 0.0), REPORT.ended)


@jit
def conclude(row: Row, n: int, done: int, bounds: Any, window: Any) -> None:
    """The slow sensors along `done` ticks of one vehicle, its observation and its report."""
    conclude_slow(row, done, observe_step(row, n, done, bounds), bounds, window)


@apart
def conclude_slow(row: Row, done: int, k: int, bounds: Any, window: Any) -> None:
    """The same where all but the slow sensors is in the observation; their entries begin at k."""
    _finish(row, k, sense_ticks(row, 0, done, 0, done, window), bounds)


@jit
def sense_ticks(row: Row, first: int, last: int, count: int, done: int, window: Any) -> int:
    """The slow sensors at the ticks first to last - 1 of the `done` of a step; returns how many
    packets there are then, of `count` before."""
    z = row.z
    before = z[Z.clock.tick] - done
    tick = next_due(z, before + first)
    while tick <= before + last:
        j = int(tick - before) - 1
        count = sense_slow(row, read(window, WINDOW.track, j), tick, count)
        tick = next_due(z, tick)
    return count


@jit
def observe_step(row: Row, n: int, done: int, bounds: Any) -> int:
    """The observation of a step of `done` ticks but for the slow sensors, whose entries begin where
    it returns."""
    report, rows = row.report, row.rows
    refs = (report[REPORT.beta_ref], report[REPORT.gamma_ref])
    shown = done
    if row.switches[FLAGS.all_samples]:  # the last one stands for the missing
        for j in range(done, n):
            copied(rows[done - 1], rows[j])
        shown = n
    return int(observe_fast(rows, shown, refs, bounds, row.switches, row.obs))


@jit
def sum_up(row: Row, n: int, done: int, count: int, bounds: Any) -> None:
    """The observation and the report of a step of `done` ticks and `count` packets."""
    _finish(row, observe_step(row, n, done, bounds), count, bounds)


@jit
def _finish(row: Row, k: int, count: int, bounds: Any) -> None:
    report = row.report
    observe_slow(row, k, count, bounds)
    write_report(report, row.z)
    report[REPORT.reward] = -report[REPORT.cost]
    report[REPORT.packets] = count


@jit
def shares_of(action: Any) -> tuple[float, float]:
    """(yaw moment, added steering) of an action as they are taken, within +-1; NaN where the
    action is not finite."""
    share = float(action[0])  # in plain Python a float32 would make float32 of all that follows
    turn = float(action[1]) if len(action) > 1 else 0.0
    both = share + turn
    if both - both != 0.0:
        return both - both, both - both
    return clip(share, -1.0, 1.0), clip(turn, -1.0, 1.0)


@jit
def wild_of(action: Any) -> int:
    """WILD where a number of an action is finite and beyond FAR, else 0."""
    for share in action:
        if (share > FAR or share < -FAR) and share - share == 0.0:
            return WILD
    return 0


@jit
def refuse(row: Row) -> int:
    """Refuse an action that is not finite, or end the episode as a failure (`fail_bad`)."""
    z, report = row.z, row.report
    if row.switches[FLAGS.fail_bad] == 0:
        return REFUSED
    z[Z.clock.failure] = BAD_ACTION
    report[REPORT.failure] = BAD_ACTION
    report[REPORT.cost] = rest_of_cost(row.p[P.task.duration], z[Z.clock.tick])
    report[REPORT.reward] = -report[REPORT.cost]
    report[REPORT.packets] = 0.0
    return 0


@apart
def step_vehicle(
    p: Any,
    z: Any,
    switches: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    report: Any,
    action: Any,
    n: int,
    bounds: Any,
    window: Any,
) -> int:
    """n ticks of one vehicle, fewer where the episode ends; returns how many.

    The first seven are a `Row`: from Python they come one by one, since numba takes 0.2 us for
    every array within a tuple. action: the share of the yaw moment and, if there are two, that of
    the added steering; one that is not finite does nothing and returns REFUSED, or fails the
    episode (`fail_bad`). window: what `window_of` gives.
    """
    row = Row(p, z, switches, obs, rows, packets, report)
    share, turn = shares_of(action)
    if share != share:
        return int(refuse(row))
    kind = kind_of(p, switches)
    foresee(p, z, n, kind.follows, window)
    done = drive_on(p, z, kind, share, turn, n, rows, report, window, True)
    conclude(row, n, done, bounds, window)
    return int(done)


@jit
def step_packed(work: Any, action: Any) -> int:
    """`step_vehicle` of the episode whose arrays lie in a workspace, and WILD."""
    row, bounds, window = parts_of(work)
    n = len(row.rows)
    done = int(
        step_vehicle(
            row.p, row.z, row.switches, row.obs, row.rows, row.packets, row.report, action, n,
            bounds, window,
        )
    )  # fmt: skip
    return done + wild_of(action) if done > 0 else done
