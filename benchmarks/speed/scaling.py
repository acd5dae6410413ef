"""What an env-step costs against the number of environments, and against ticks per step."""

import os
import tracemalloc
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from ..harness.results import Row, Suite, Table
from .contestants import absences, add_rows, rate
from .env_steps import COUNT, FUSION, FUSION_ID, batch, episode
from .timing import Contestant, Effort, Taken, interleaved, spread

COUNTS = (1, 2, 4, 8, 16, 64, 256, 1024, 4096, 16384, 65536)
QUICK_COUNTS = (1, 8, 64, 1024, 4096)
TICKS = (1, 2, 5, 10, 20, 50)
WORK = 2048  # env-steps in one call, at least
SHARE = 0.5  # of the memory that is free


def bytes_per_row(**arguments: Any) -> int:
    """Peak memory that one more environment of a batch takes, observations and infos included."""
    few, many, peaks = 64, 192, list[int]()
    for count in (few, few, many):  # the first one loads what is loaded once
        tracemalloc.start()
        env: Any = gym.make_vec(FUSION_ID, count, **arguments)
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape, np.float32))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return (peaks[2] - peaks[1]) // (many - few)


def free_memory() -> float:
    """Bytes; infinite where the system does not say."""
    try:
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError, AttributeError):
        return np.inf


def against_count(suite: Suite, effort: Effort, counts: tuple[int, ...]) -> None:
    """Rows, a table and a figure: batches of 1 to 65,536."""
    row, free, absent = bytes_per_row(), free_memory(), dict[str, str]()
    contestants: dict[str, Contestant] = {}
    held = 0
    for count in counts:
        held += count * row
        if held > SHARE * free:
            absent[_at_once(count)] = f"takes {held / 2**30:.1f} GiB, {free / 2**30:.1f} are free"
            break
        env: Any = gym.make_vec(FUSION_ID, count, info="ends")
        contestants[_at_once(count)] = batch(env, max(1, WORK // count))
    taken = interleaved(contestants, effort)
    suite.rows.append(Row(suite.name, f"{FUSION}, batch", "bytes_per_row", float(row)))
    for name, each in taken.items():
        add_rows(suite, name, each, "step")
    cells = [
        [f"{count:,}", f"{middle:.3g}", f"{low:.3g} .. {high:.3g}", rate(middle)]
        for count, (middle, low, high) in zip(counts, map(_cpu, taken.values()), strict=False)
    ]
    suite.tables.append(
        Table(
            "Cost of an env-step against environments at once",
            ("environments", "us per step", "range", "steps per CPU-second"),
            cells,
            f"{FUSION}, infos at ends. An environment takes {row / 1024:.1f} KiB, "
            f"{65536 * row / 2**30:.2f} GiB for 65,536." + absences(absent),
            keyed=False,
        )
    )
    x = np.array(counts[: len(taken)], float)
    line = {"a step of one environment": np.array([_cpu(each)[0] for each in taken.values()])}
    text = "A call's own cost is shared by all rows: the curve falls until the kernel is all."
    _draw(suite, "environments at once", x, line, text)


def against_ticks(suite: Suite, effort: Effort) -> None:
    """Rows, a table and a figure: control periods of 1 to 50 ticks."""
    contestants: dict[str, Contestant] = {}
    for n in TICKS:
        contestants[_ticks(n)] = episode(gym.make(FUSION_ID, control_period=n))
        many: Any = gym.make_vec(FUSION_ID, COUNT, info="ends", control_period=n)
        contestants[f"{FUSION} x {COUNT}, {n} ticks a step"] = batch(many, 2)
    taken = interleaved(contestants, effort)
    for name, each in taken.items():
        add_rows(suite, name, each, "step")
    single = np.array([_cpu(taken[_ticks(n)])[0] for n in TICKS])
    many_at = np.array([_cpu(taken[f"{FUSION} x {COUNT}, {n} ticks a step"])[0] for n in TICKS])
    cells = [
        [str(n), f"{one:.3g}", f"{one / n:.3g}", f"{each:.3g}", f"{each / n:.3g}"]
        for n, one, each in zip(TICKS, single, many_at, strict=True)
    ]
    suite.tables.append(
        Table(
            "Cost of an env-step against ticks per step",
            ("ticks", "us per step", "per tick", f"us per step, x {COUNT}", "per tick"),
            cells,
            f"{FUSION}; a tick is a millisecond. Infos of the batch at ends.",
            keyed=False,
        )
    )
    lines = {"gym.make": single, f"x {COUNT}": many_at}
    text = "What a step costs apart from its ticks is where a line ends on the left."
    _draw(suite, "ticks per step / ms", np.array(TICKS, float), lines, text)


def _at_once(count: int) -> str:
    return f"{FUSION} x {count}, infos at ends, scaling"


def _ticks(n: int) -> str:
    return f"{FUSION}, {n} ticks a step"


def _cpu(taken: Taken) -> tuple[float, float, float]:
    return spread(taken.cpu)


def _draw(suite: Suite, x_label: str, x: Any, lines: Mapping[str, Any], text: str) -> None:
    """Nothing where plotly is not installed."""
    try:
        from ..report.figures import curves
    except ModuleNotFoundError:
        return
    figure = curves(x, lines, x_label, "CPU time of an env-step / us", "xy")
    title = f"Cost of an env-step against {x_label.partition(' /')[0]}"
    suite.figures.append((title, figure, text))
