"""Rows of vehicles: the loops around `step_vehicle` and `reset_vehicle`; compiled."""

from typing import Any

from ..backend.arrays import lane_count
from ..backend.decorators import copied, jit
from ..task.failures import REFUSED, RUNNING
from ..task.info import REPORT
from .arrays import Records, Rows, Start, row_of, start_of
from .lanes import Block, step_block
from .layout import FLAGS
from .reset import reset_vehicle
from .step import kind_of, shares_of, step_vehicle, wild_of

_FEW = 2  # up to so many vehicles are stepped one by one


@jit
def step_rows(
    params: Any,
    states: Any,
    switches: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    reports: Any,
    ticks_done: Any,
    delivered: Any,
    over: Any,
    actions: Any,
    n: int,
    bounds: Any,
    rewards: Any,
    terminated: Any,
    truncated: Any,
    block: Block,
) -> int:
    """One env-step of every row, and how many episodes ended.

    The first ten are `Rows`, one by one as in `step_vehicle`. Rows whose episode is `over` stand
    still, with reward 0, and do not end again; then those that ended in this step are. Adds WILD
    for an action that is. Returns REFUSED, and steps nothing, where an action that is not to fail
    its row is not finite.
    """
    ended = 0
    every = Rows(params, states, switches, obs, rows, packets, reports, ticks_done, delivered, over)
    for i in range(len(over)):
        if switches[i, FLAGS.fail_bad] == 0 and not over[i]:
            for share in actions[i]:
                if float(share) - float(share) != 0.0:
                    return REFUSED
        if not over[i]:
            ended |= wild_of(actions[i])
    waiting, last = 0, len(over) - 1
    for m in range(len(over)):
        i = block.order[m]
        if not over[i]:
            share, _ = shares_of(actions[i])
            if share != share:
                ticks_done[i] = _step_alone(i, every, actions, n, bounds, block)
                obs[i, :] = 0.0
            else:
                block.members[waiting] = i
                waiting += 1
        if waiting and (waiting == lane_count() or m == last or _kinds_differ(m, every, block)):
            together = False
            if waiting > _FEW:
                together = step_block(waiting, every, actions, n, bounds, block)
            for lane in range(waiting):
                i = block.members[lane]
                done = n if together else _step_alone(i, every, actions, n, bounds, block)
                ticks_done[i] = done
            waiting = 0
    for i in range(len(over)):
        if over[i]:
            rewards[i], terminated[i], truncated[i], over[i] = 0.0, False, False, False
            continue
        report = reports[i]
        delivered[i] = int(report[REPORT.packets])
        rewards[i], terminated[i], truncated[i] = ends_of(report)
        over[i] = terminated[i] or truncated[i]
        if over[i]:
            ended += 1
    return ended


@jit
def ends_of(report: Any) -> tuple[float, bool, bool]:
    """(reward, terminated, truncated) of a step's report."""
    terminated = report[REPORT.failure] != RUNNING
    return -report[REPORT.cost], terminated, report[REPORT.ended] == 1.0 and not terminated


@jit
def _kinds_differ(m: int, rows: Rows, block: Block) -> bool:
    """Whether the next row in order has another text than this one."""
    i, j = block.order[m], block.order[m + 1]
    mine, next_one = rows.switches[i], rows.switches[j]
    return bool(kind_of(rows.params[i], mine) != kind_of(rows.params[j], next_one))


@jit
def _step_alone(i: int, rows: Rows, actions: Any, n: int, bounds: Any, block: Block) -> int:
    row = row_of(rows, i)
    return int(
        step_vehicle(
            row.p,
            row.z,
            row.switches,
            row.obs,
            row.rows,
            row.packets,
            row.report,
            actions[i],
            n,
            bounds,
            block.alone,
        )
    )


@jit
def reset_rows(
    chosen: Any, of: Any, starts: Start, keys: Any, bounds: Any, rows: Rows, final: Records
) -> None:
    """Reset the chosen rows (M,), whose records go into `final` before.

    of: (M,), each one's place in `starts`. keys: (M, 2), two words of 32 bits.
    """
    for m in range(len(chosen)):
        i, t = chosen[m], of[m]
        for j in range(rows.ticks_done[i]):
            copied(rows.rows[i, j], final.rows[i, j])
        for j in range(rows.delivered[i]):
            copied(rows.packets[i, j], final.packets[i, j])
        final.ticks_done[i], final.delivered[i] = rows.ticks_done[i], rows.delivered[i]
        key_low, key_high = int(keys[m, 0]), int(keys[m, 1])
        reset_vehicle(start_of(starts, t), key_low, key_high, bounds, row_of(rows, i))
        rows.ticks_done[i] = 1
        rows.delivered[i] = int(rows.reports[i, REPORT.packets])
