"""Question: what do 10^9 episodes cost, and how many workers make them how fast?

`python -m sideslip.benchmarks.speed.scale --out docs/scale.md`
"""

import time
from pathlib import Path
from typing import Annotated

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

MANY = 1e9
SIZES = (10, 50, 250, 1000)
"""Episodes a case."""
ROUNDS = 3
_WHO = {"no control": ("", "none"), "lqr on exact-kf": (REFERENCE_FILTER, REFERENCE_CONTROLLER)}
_TEXT = """\
# What a billion episodes cost

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


def report() -> str:
    """The page, measured now."""
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
    )


def main(
    out: Annotated[Path | None, typer.Option(help="Write the page to this file.")] = None,
) -> None:
    """What a billion episodes cost."""
    check_writable(out)
    text = report()
    Console().print(text, highlight=False, markup=False)
    if out is not None:
        write_text(out, text)


if __name__ == "__main__":
    typer.run(main)
