"""Rows of vehicles: the loops around `step_vehicle` and `reset_vehicle`; compiled."""

from typing import Any

from .backend import jit
from .kernel import step_vehicle
from .restart import reset_vehicle
from .switches import REFUSED, REPORT, RUNNING, Switches

_FAIL_BAD = Switches._fields.index("fail_bad")


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
) -> int:
    """One env-step of every row, and how many episodes ended; every array has a row for each.

    over: rows whose episode had ended stand still, with reward 0, and do not end again; then those
    that ended in this step. Returns REFUSED, and steps nothing, where an action that is not to
    fail its row is not finite.
    """
    for i in range(len(over)):
        if switches[i, _FAIL_BAD] == 0 and not over[i]:
            for share in actions[i]:
                if float(share) - float(share) != 0.0:
                    return REFUSED
    ended = 0
    for i in range(len(over)):
        rewards[i], terminated[i], truncated[i] = 0.0, False, False
        if over[i]:
            over[i] = False
            continue
        report = reports[i]
        done = step_vehicle(
            params[i],
            states[i],
            switches[i],
            actions[i],
            n,
            bounds,
            obs[i],
            rows[i],
            packets[i],
            report,
        )
        if done <= 0:
            obs[i, :] = 0.0
        ticks_done[i] = done
        delivered[i] = int(report[REPORT.packets])
        rewards[i] = -report[REPORT.cost]
        terminated[i] = report[REPORT.failure] != RUNNING
        truncated[i] = report[REPORT.ended] == 1.0 and not terminated[i]
        over[i] = terminated[i] or truncated[i]
        if over[i]:
            ended += 1
    return ended


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
            final_rows[i, j, :] = rows[i, j, :]
        for j in range(delivered[i]):
            final_packets[i, j, :] = packets[i, j, :]
        final_ticks_done[i], final_delivered[i] = ticks_done[i], delivered[i]
        switches[i, :] = kinds[t, :]
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
