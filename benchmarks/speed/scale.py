"""Question: what do 10^9 episodes and 10^12 env-steps cost, and how fast are many workers?

`python -m sideslip.benchmarks.speed.scale --out docs/scale.md`
"""

import time
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ...envs.record import Array
from ..control.cells import REFERENCE_CONTROLLER, REFERENCE_FILTER, Cell
from ..control.contests import contests
from ..control.episodes import Chunk, drive
from ..harness.engines import cores
from ..harness.parallel import run_cases
from ..harness.results import check_writable, write_text

MANY, STEPS = 1e9, 1e12
SIZES = (10, 50, 250, 1000)
"""Episodes a case."""
ROUNDS = 3
_WHO = {"no control": ("", "none"), "lqr on exact-kf": (REFERENCE_FILTER, REFERENCE_CONTROLLER)}
ENV_ID, COUNTS = "sideslip/YawFusion-v0", tuple(4**k for k in range(11))
"""Of a batch of env-steps alone; 4^10 rows take 6 GB."""
PRICE = 0.04
"""Dollars for an hour of one core, about what clouds ask on demand in 2026: assumed."""
_TEXT = """\
# What a billion episodes and a trillion env-steps cost

Made by `python -m sideslip.benchmarks.speed.scale --out docs/scale.md` on a machine with {workers}
cores. A *case* is some episodes of a contest that drive side by side; cases are independent, so a
cluster's workers share them (`--engine ray`). CPU seconds of a case of `{contest}`, the median of
{rounds}, and the line through them, a seconds a case and b an episode:

{table}

A worker's share of time that is not its own work, measured with {cases} cases of {size} episodes on
1 and {workers} processes of one machine: {overhead}.

So 10^9 episodes in cases of 1000 take (a / 1000 + b) x 10^9 core-seconds, and on W cores that
divided by W, as long as there are many more cases than cores: a case of 1000 lasts seconds, so even
10,000 cores wait less than a minute for the last one. This is a model: no cluster of that size was
tried.

{costs}

## Env-steps alone

CPU time of an env-step of 10 ms of `{env_id}` in a batch of N, in microseconds: the
median of {rounds} rounds of at least a thousand env-steps, infos and records included.

{steps}

10^12 of them at N = {best} take {hours:,.0f} core-hours, and ${dollars:,.0f} at an assumed
${price} a core-hour: {days:,.1f} days on one core, {minutes:,.0f} minutes on 1000. With a process
on each of this machine's {workers} cores one takes {slower:.2f} times its time alone.
"""


def seconds_of(cell: Cell, size: int) -> float:
    """CPU seconds of a case, the median of `ROUNDS`."""
    taken = []
    for _ in range(ROUNDS):
        begun = time.process_time()
        drive(Chunk(cell, tuple(range(size))))
        taken.append(time.process_time() - begun)
    return float(np.median(taken))


def line_through(seconds: Array) -> tuple[float, float]:
    """(a, b): the line a + b episodes through the cases' seconds, relative errors squared."""
    sizes = np.array(SIZES, float)
    A = np.stack([np.ones(len(sizes)), sizes], axis=1) / seconds[:, None]
    (a, b), *_ = np.linalg.lstsq(A, np.ones(len(sizes)), rcond=None)
    return float(a), float(b)


def overhead(cell: Cell, cases: int, size: int, workers: int) -> tuple[float, float]:
    """The share of a process's wall time that its cases do not account for, on 1 and on more."""
    chunks, shares = [Chunk(cell, tuple(range(size)))] * cases, []
    for jobs in (1, workers):
        run_cases(drive, chunks[:jobs], jobs=jobs)  # processes start and load
        begun = time.perf_counter()
        driven = run_cases(drive, chunks, jobs=jobs)
        wall = time.perf_counter() - begun
        shares.append(1.0 - sum(each.seconds for each in driven) / (wall * jobs))
    return shares[0], shares[1]


def step_seconds(count: int) -> float:
    """CPU seconds of an env-step in a batch of `count`, the median of `ROUNDS`."""
    env = gym.make_vec(ENV_ID, num_envs=count)
    env.reset(seed=0)
    actions, taken = np.zeros((count, 1), np.float32), []
    repeats = max(1, 1024 // count)
    for _ in range(ROUNDS + 1):  # the first touches memory
        begun = time.thread_time()
        for _ in range(repeats):
            env.step(actions)
        taken.append((time.thread_time() - begun) / (repeats * count))
    return float(np.median(taken[1:]))


def beside(workers: int) -> float:
    """An env-step's time in each of `workers` processes at once over its time in one alone."""
    counts = [1024] * workers
    run_cases(step_seconds, counts, jobs=workers)
    alone = run_cases(step_seconds, counts[:1], jobs=1)
    return float(np.median(run_cases(step_seconds, counts, jobs=workers)) / alone[0])


def report() -> str:
    """The page, measured now."""
    times = {count: 1e6 * step_seconds(count) for count in COUNTS}
    best = min(times, key=times.__getitem__)
    hours = STEPS * times[best] * 1e-6 / 3600.0
    steps = [
        "| N | " + " | ".join(map(str, times)) + " |",
        "|---" * (len(times) + 1) + "|",
        "| us | " + " | ".join(f"{each:.3g}" for each in times.values()) + " |",
    ]
    contest, workers = contests()[0], cores()
    head = "| | " + " | ".join(f"{size} episodes" for size in SIZES) + " | a / s | b / ms |"
    lines, costs = [head, "|---" * (len(SIZES) + 3) + "|"], []
    for name, (estimator, controller) in _WHO.items():
        cell = Cell(contest, estimator, controller)
        drive(Chunk(cell, (0,)))  # compiles
        seconds = np.array([seconds_of(cell, size) for size in SIZES])
        a, b = line_through(seconds)
        shown = " | ".join(f"{each:.3g}" for each in seconds)
        lines.append(f"| {name} | {shown} | {a:.3g} | {1e3 * b:.3g} |")
        core_hours = MANY * (a / 1000.0 + b) / 3600.0
        costs.append(
            f"| {name} | {core_hours:,.0f} core-hours | {core_hours / 24.0:,.1f} days | "
            f"{core_hours * 60.0 / 1000.0:,.0f} minutes |"
        )
    alone, together = overhead(cell, 4 * workers, 250, workers)
    table = ["| 10^9 episodes | | on one core | on 1000 cores |", "|---|---|---|---|", *costs]
    return _TEXT.format(
        contest=contest.name,
        rounds=ROUNDS,
        table="\n".join(lines),
        cases=4 * workers,
        size=250,
        workers=workers,
        overhead=f"{100.0 * alone:.0f} and {100.0 * together:.0f} %",
        costs="\n".join(table),
        env_id=ENV_ID,
        steps="\n".join(steps),
        best=best,
        hours=hours,
        price=PRICE,
        dollars=hours * PRICE,
        days=hours / 24.0,
        minutes=hours * 60.0 / 1000.0,
        slower=beside(workers),
    )


def main(
    out: Annotated[Path | None, typer.Option(help="Write the page to this file.")] = None,
) -> None:
    """What a billion episodes and a trillion env-steps cost."""
    check_writable(out)
    text = report()
    Console().print(text, highlight=False, markup=False)
    if out is not None:
        write_text(out, text)


if __name__ == "__main__":
    typer.run(main)
