"""Rows of vehicles: the loops around `step_vehicle` and `reset_vehicle`; compiled."""

from typing import Any

from ..backend.arrays import abreast
from ..backend.decorators import copied, jit
from ..task.failures import REFUSED, RUNNING
from ..task.info import REPORT
from .lanes import step_block
from .layout import FLAGS
from .reset import reset_vehicle
from .step import kind_of, shares_of, step_vehicle

_FEW = 2  # up to so many vehicles are stepped one by one


@jit
def step_rows(
    params: Any,
    states: Any,
    switches: Any,
    actions: Any,
    n: int,
    bounds: Any,
    over: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    reports: Any,
    ticks_done: Any,
    delivered: Any,
    rewards: Any,
    terminated: Any,
    truncated: Any,
    scratch: Any,
    block: Any,
) -> int:
    """One env-step of every row, and how many episodes ended; every array has a row for each.

    over: rows whose episode had ended stand still, with reward 0, and do not end again; then those
    that ended in this step. Returns REFUSED, and steps nothing, where an action that is not to
    fail its row is not finite. scratch: what `scratch_of` gives. block: what rows that are computed
    together need, a `Block`.
    """
    for i in range(len(over)):
        if switches[i, FLAGS.fail_bad] == 0 and not over[i]:
            for share in actions[i]:
                if float(share) - float(share) != 0.0:
                    return REFUSED
    every = (params, states, switches, actions, obs, rows, packets, reports)
    waiting, last = 0, len(over) - 1
    for m in range(len(over)):
        i = block.order[m]
        if not over[i]:
            share, _ = shares_of(actions[i])
            if share != share:
                ticks_done[i] = _step_alone(i, every, n, bounds, scratch)
                obs[i, :] = 0.0
            else:
                block.members[waiting] = i
                waiting += 1
        if waiting and (waiting == abreast() or m == last or _kinds_differ(m, every, block)):
            together = False
            if waiting > _FEW:
                together = step_block(waiting, every, n, bounds, block)
            for lane in range(waiting):
                row = block.members[lane]
                ticks_done[row] = n if together else _step_alone(row, every, n, bounds, scratch)
            waiting = 0
    ended = 0
    for i in range(len(over)):
        if over[i]:
            rewards[i], terminated[i], truncated[i], over[i] = 0.0, False, False, False
            continue
        report = reports[i]
        delivered[i] = int(report[REPORT.packets])
        rewards[i] = -report[REPORT.cost]
        terminated[i] = report[REPORT.failure] != RUNNING
        truncated[i] = report[REPORT.ended] == 1.0 and not terminated[i]
        over[i] = terminated[i] or truncated[i]
        if over[i]:
            ended += 1
    return ended


@jit
def _kinds_differ(m: int, every: Any, block: Any) -> bool:
    """Whether the next row in order has another text than this one."""
    params, switches = every[0], every[2]
    i, j = block.order[m], block.order[m + 1]
    return bool(kind_of(params[i], switches[i]) != kind_of(params[j], switches[j]))


@jit
def _step_alone(i: int, every: Any, n: int, bounds: Any, scratch: Any) -> int:
    params, states, switches, actions, obs, rows, packets, reports = every
    return int(
        step_vehicle(
            params[i],
            states[i],
            switches[i],
            actions[i],
            n,
            bounds,
            obs[i],
            rows[i],
            packets[i],
            reports[i],
            scratch,
        )
    )


@jit
def reset_rows(
    chosen: Any,
    of: Any,
    templates: Any,
    low: Any,
    high: Any,
    kinds: Any,
    starts: Any,
    drawn: Any,
    keys: Any,
    bounds: Any,
    params: Any,
    states: Any,
    switches: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    reports: Any,
    ticks_done: Any,
    delivered: Any,
    final_rows: Any,
    final_packets: Any,
    final_ticks_done: Any,
    final_delivered: Any,
) -> None:
    """Reset the chosen rows (M,), whose records are first kept in the final_... ones.

    of: (M,), each one's place in templates, low, high, kinds (their switches) and starts.
    keys: (M, 2), two words of 32 bits.
    """
    for m in range(len(chosen)):
        i, t = chosen[m], of[m]
        for j in range(ticks_done[i]):
            copied(rows[i, j], final_rows[i, j])
        for j in range(delivered[i]):
            copied(packets[i, j], final_packets[i, j])
        final_ticks_done[i], final_delivered[i] = ticks_done[i], delivered[i]
        copied(kinds[t], switches[i])
        reset_vehicle(
            templates[t],
            low[t],
            high[t],
            kinds[t],
            starts[t],
            drawn,
            int(keys[m, 0]),
            int(keys[m, 1]),
            bounds,
            params[i],
            states[i],
            obs[i],
            rows[i],
            packets[i],
            reports[i],
        )
        ticks_done[i] = 1
        delivered[i] = int(reports[i, REPORT.packets])
