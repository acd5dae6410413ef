"""Question: in how many CPU-seconds does a training reach a well-designed LQG?

    sideslip train ... --out run-0; python -m sideslip.benchmarks.curves run-0 run-1 ...

Reads the evaluations of finished or running trainings and has `nominal` drive their seeds. What the
evaluations cost is not counted.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ..agents.rollout import costs_of
from ..agents.rungs import NOMINAL, make_rung
from ..agents.training.keeper import CURVE, evaluation_seeds
from ..agents.training.train import Task, task_in


def nominal_cost(task: Task) -> float:
    """Mean cost of `nominal` on the seeds of a training's evaluations.

    Raises ValueError for a mixture, of whose scenarios a rung is built for one only.
    """
    if task.scenarios:
        raise ValueError("nominal is designed for one scenario, and this training is of a mixture")
    env, agent = make_rung(NOMINAL, task.env_id, task.n_eval_envs, **task.env_options)
    return float(costs_of(env, agent, evaluation_seeds(task.n_eval_envs)).mean())


def table_of(folders: Sequence[str | Path]) -> Table:
    """Mean cost over nominal's by CPU-seconds: the best evaluation so far, a column a folder.

    Raises ValueError for trainings that were evaluated on different tasks, and what `task_in`
    raises.
    """
    tasks = [task_in(folder) for folder in folders]
    judged = [(each.env_id, each.env_options, each.n_eval_envs) for each in tasks]
    if any(each != judged[0] for each in judged):
        raise ValueError("these trainings were evaluated on different tasks")
    nominal = nominal_cost(tasks[0])
    curves = [_curve(Path(folder), nominal) for folder in folders]
    table = Table("CPU-s", *map(str, folders), title=f"mean cost / nominal's {nominal:.4g}")
    last = max(curve[-1][0] for curve in curves)
    for share in (1 / 12, 1 / 6, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 5 / 6, 1.0):
        known = [[ratio for spent, ratio in curve if spent <= share * last] for curve in curves]
        table.add_row(
            f"{share * last:.0f}", *(f"{min(each):.2f}" if each else "" for each in known)
        )
    return table


def _curve(folder: Path, nominal: float) -> list[tuple[float, float]]:
    """(CPU-seconds, cost over nominal's) of each evaluation."""
    lines = map(json.loads, (folder / CURVE).read_text().splitlines())
    return [(line["cpu_seconds"], line["cost"] / nominal) for line in lines]


if __name__ == "__main__":
    Console().print(table_of(sys.argv[1:]))
