"""Question: in how many CPU-seconds does a training reach a well-designed LQG?

    sideslip train ... --out run-0; python -m sideslip.benchmarks.curves run-0 run-1 ...

Reads the evaluations of finished or running trainings and has `nominal` drive their seeds; then
both drive seeds on which nothing was chosen. What the evaluations cost is not counted.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from ..agents.learned.files import load_policy
from ..agents.learned.policy import Learned
from ..agents.rollout import cost_ratios, costs_of
from ..agents.rungs import NOMINAL, make_rung
from ..agents.training.keeper import CURVE, POLICY, evaluation_seeds
from ..agents.training.train import Task, task_in
from ..envs.record import Array
from .harness.errors import one_line
from .harness.stats import geometric_mean, interval, ratio_of_means, won

EPISODES = 4096
"""On as many drives a mean is known to half a percent; on 1,024, sets of seeds differ by two."""
_AT_ONCE = 1024
FURTHER = 8_000_000
"""First of the seeds on which neither a policy nor a setting was chosen."""


def nominal_costs(task: Task, seeds: Sequence[int]) -> Array:
    """Cost of `nominal` on each seed of a training's task.

    Raises ValueError for a mixture, of whose scenarios a rung is built for one only.
    """
    if task.scenarios:
        raise ValueError("nominal is designed for one scenario, and this training is of a mixture")
    at_once = min(len(seeds), _AT_ONCE)
    env, agent = make_rung(NOMINAL, task.env_id, at_once, **task.env_options)
    return _driven(env, agent, seeds)


def _driven(env: Any, agent: Any, seeds: Sequence[int]) -> Array:
    """Cost of each seed, as many drives at once as the env has rows."""
    rows = env.num_envs
    whole = [*seeds, *seeds[: -len(seeds) % rows]]
    costs = [costs_of(env, agent, whole[at : at + rows]) for at in range(0, len(whole), rows)]
    return np.concatenate(costs)[: len(seeds)]


def further(folders: Sequence[str | Path], episodes: int = EPISODES) -> Table:
    """The best policy of each training beside `nominal` on seeds that chose nothing.

    Level are those that are not surely dearer: the interval of their mean's ratio reaches 1. Raises
    as `table_of`.
    """
    tasks = _tasks_of(folders)
    seeds = range(FURTHER, FURTHER + episodes)
    nominal = nominal_costs(tasks[0], seeds)
    table = Table("training", "CPU-s", "mean", "geometric mean", "better")
    level = 0
    for folder, own in zip(map(Path, folders), tasks, strict=True):
        env = own.vector_env(min(episodes, _AT_ONCE))
        costs = _driven(env, Learned(env, load_policy(folder / POLICY)), seeds)
        ratio = interval(costs, ratio_of_means, nominal)
        logs = geometric_mean(np.log(cost_ratios(costs, nominal)))
        level += ratio.low <= 1.0
        spent = json.loads((folder / CURVE).read_text().splitlines()[-1])["cpu_seconds"]
        shown = (each.inline(digits=".3f") for each in (ratio, logs))
        better = f"{100.0 * won(costs, nominal).value:.0f} %"
        table.add_row(str(folder), f"{spent:.0f}", *shown, better)
    table.title = f"over nominal on {episodes} further seeds; {level} of {len(folders)} level"
    return table


def table_of(folders: Sequence[str | Path]) -> Table:
    """Mean cost over nominal's by CPU-seconds: the best evaluation so far, a row a training.

    Raises ValueError for trainings that were evaluated on different tasks, and what `task_in`
    raises.
    """
    task = _tasks_of(folders)[0]
    nominal = float(nominal_costs(task, evaluation_seeds(task.n_eval_envs)).mean())
    curves = [_curve(Path(folder), nominal) for folder in folders]
    last = max(curve[-1][0] for curve in curves)
    ends = [share * last for share in (1 / 12, 1 / 6, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 5 / 6, 1.0)]
    title = f"mean cost / nominal's {nominal:.4g} by CPU-seconds"
    table = Table("training", *(f"{end:.0f}" for end in ends), title=title)
    for folder, curve in zip(folders, curves, strict=True):
        known = [[ratio for spent, ratio in curve if spent <= end] for end in ends]
        table.add_row(str(folder), *(f"{min(each):.2f}" if each else "" for each in known))
    return table


def _tasks_of(folders: Sequence[str | Path]) -> list[Task]:
    """Each training's task; ValueError where they were not evaluated on the same drives."""
    tasks = [task_in(folder) for folder in folders]
    judged = [(each.env_id, each.env_options, each.scenarios, each.n_eval_envs) for each in tasks]
    if any(each != judged[0] for each in judged):
        raise ValueError("these trainings were evaluated on different tasks")
    return tasks


def _curve(folder: Path, nominal: float) -> list[tuple[float, float]]:
    """(CPU-seconds, cost over nominal's) of each evaluation."""
    lines = map(json.loads, (folder / CURVE).read_text().splitlines())
    return [(line["cpu_seconds"], line["cost"] / nominal) for line in lines]


def main(
    folders: Annotated[list[Path], typer.Argument(help="Of trainings of one task.")],
) -> None:
    """Print how soon trainings reach nominal's cost, and what they cost on further seeds."""
    for found in (table_of, further):
        Console().print(found(folders))


if __name__ == "__main__":
    with one_line():
        typer.run(main)
