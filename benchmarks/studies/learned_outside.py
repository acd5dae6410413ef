"""The suite `learned-outside`: what learned policies cost in a car whose equations are not ours.

CommonRoad's models of a BMW 320i take the place of the passenger car, on a straight road, with our
sensors and references. Controllers, filters and references are designed from that car, as far as
our `Vehicle` describes it; the policies were trained on another one.
"""

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ...agents.rollout import iterate_steps
from ...envs.outside.plants import OUTSIDE_PLANTS
from ...envs.scenarios.manoeuvres import make_scenario
from ...estimators.registry import describe_error
from ..control.entries import ADAPTIVE, LEARNED, ControlEntry, make_cars
from ..control.run import NUMBERS, Chunk, DriveResult, measure
from ..control.score import compute_log_ratios, survival_mask
from ..control.tasks import (
    NOMINAL,
    STEERING,
    ControlTask,
    list_scored_tasks,
    make_salt,
    make_task_seeds,
    vary_scenario,
)
from ..harness.results import ResultTable, Suite
from ..harness.stats import geometric_mean, share
from ..harness.verdict import format_verdict
from .learned import EPISODES as EPISODES
from .learned import QUICK_EPISODES as QUICK_EPISODES
from .learned import TransferResult, add_figures, add_tables, collect_results, list_entries

_NAME = "learned-outside"
OUTSIDE_ID = "sideslip/Outside-v0"
KINDS = tuple(kind for kind in LEARNED if kind.startswith("car-"))
"""Classes whose car is about as large and as fast as the BMW."""
MANOEUVRE = "any-friction-sine-with-dwell"
"""The scenario of every class that ends with the initial heading, as a straight road needs."""
_RIVALS = (NOMINAL, ADAPTIVE["joint, friction"])
"""Controllers by whose costs all costs are divided: no gap between oracles scales scores here."""
_TEXT = (
    "The passenger car's policies on CommonRoad's single-track, drift and multi-body models of a "
    "BMW 320i, beside controllers on the same late sensors that are designed for it. No training "
    "met it."
)
_NOT_INSTALLED = " Left out: pip install 'sideslip[outside]'."


@dataclass(frozen=True)
class _OutsideTask(ControlTask):
    """A class's task with a model of `OutsideEnv` on a straight road."""

    model: str = "drift"  # name of the outside plant
    like: str = STEERING  # env id whose actuators the car has

    @property
    def kind(self) -> str:
        """Class of the tuned options."""
        return f"car-{'steering' if self.like == STEERING else 'yaw'}"

    @property
    def seed_text(self) -> str:
        """JSON from which the seeds are drawn: that of a task, with `model` and `like`."""
        return json.dumps(json.loads(super().seed_text) | {"model": self.model, "like": self.like})

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env; of the task's cars only the friction that a designer expects."""
        friction = dict(make_scenario(self.scenario).nominal)["friction"]
        flat = {"road": "straight", "bank": 0.0, "vehicle": {}, "nominal": {"friction": friction}}
        return {
            "model": self.model,
            "scenario": vary_scenario(self, flat),
            "reference": self.reference,
            "steering": self.like == STEERING,
        }


def make_outside_task(kind: str, model: str) -> _OutsideTask:
    """Make a class's task of `MANOEUVRE` with a model as the car.

    Args:
        kind: Class of tasks.
        model: Name of the model.

    Returns:
        Task.
    """
    tasks = (task for task in list_scored_tasks() if task.scenario == MANOEUVRE)
    like = next(task for task in tasks if task.kind == kind)
    return _OutsideTask("", OUTSIDE_ID, "", like.reference, MANOEUVRE, model, like.env_id)


def _run_chunk(chunk: Chunk) -> DriveResult:
    """Drive cars that are stepped one by one; all metrics but cost and failure are NaN."""
    start_time, numbers = time.process_time(), np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
    try:
        env, agent = make_cars(chunk.entry, len(chunk.seeds))
        costs, failures = np.zeros((2, len(chunk.seeds)))
        for step in iterate_steps(env, agent, list(chunk.seeds)):
            costs -= np.where(step.running, step.reward, 0.0)
            failures = np.where(step.running, step.info["failure"], failures)
        env.close()
    except Exception as error:
        return DriveResult(numbers, np.nan, error=describe_error(error))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, NUMBERS.index("failure")] = failures
    return DriveResult(numbers, time.process_time() - start_time)


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    quick: bool = False,
    salt: str = "",
) -> Suite:
    """Run every class of `KINDS` on every model.

    Args:
        episodes: Episodes of each model.
        jobs: Processes, None for all processors.
        console: Console of the progress bar, None for none.
        keep: Folder in which finished cases stay.
        quick: Whether to run the drift model alone.
        salt: Salt of the seeds, "" for `make_salt`'s.

    Returns:
        Suite of all classes, empty where the models are not installed.

    Raises:
        ValueError: An entry cannot drive.
    """
    suite = Suite(_NAME, "Learned policies in cars that are not ours", _TEXT)
    if find_spec("vehiclemodels") is None:
        suite.text += _NOT_INSTALLED
        return suite
    models = ["drift"] if quick else list(OUTSIDE_PLANTS)
    entries = [
        ControlEntry(make_outside_task(kind, model), *pair)
        for model in models
        for kind in KINDS
        for pair in list_entries(kind)
    ]
    salt = salt or make_salt()
    seeds = make_task_seeds(salt, episodes)
    results = measure(
        entries, seeds, jobs=jobs, console=console, keep=keep, runner=_run_chunk, title=_NAME
    )
    transfers = [TransferResult(kind, salt=salt) for kind in KINDS]
    for item, model in product(transfers, models):
        task = make_outside_task(item.kind, model)
        item.drives[model] = [collect_results(results, task, model)]
    note = "Other seeds on each model. No training met any."
    for item in transfers:
        title = f"{item.kind} in a BMW"
        add_tables(suite, item, title, OUTSIDE_ID, f"{MANOEUVRE} on a straight road", note)
        suite.tables.insert(-1, _make_ratio_table(item, title))
    suite.verdict = _compose_verdict(transfers)
    add_figures(suite, transfers)
    return suite


def _compose_verdict(transfers: Sequence[TransferResult]) -> str:
    """Compose the verdict: the cost of each class's policies over their rivals' on all models."""
    lines = []
    for transfer in transfers:
        for _, policy in LEARNED[transfer.kind]:
            models = transfer.drives
            ratios = {x: _format_cost_ratio(transfer, policy, x, models) for x in _RIVALS}
            costs = ", ".join(f"{ratio} % of {rival}'s" for rival, ratio in ratios.items())
            fails = 100.0 * share(transfer.select("failure", policy) != 0.0).value
            lines.append(f"{policy} costs {costs}; {fails:.0f} % fail.")
    return format_verdict("On CommonRoad's BMW, known to all but the policies:", *lines)


def _format_cost_ratio(
    transfer: TransferResult, controller: str, rival: str, models: Iterable[str]
) -> str:
    """Geometric mean (%) of the cost over a rival's, paired, where the rival survives."""
    logs = []
    for (results,) in (transfer.drives[model] for model in models):
        mask = survival_mask(results[rival])
        logs.append(-compute_log_ratios(results[rival].costs, results[controller])[mask])
    return geometric_mean(*logs).inline(100.0, ".0f")


def _make_ratio_table(transfer: TransferResult, title: str) -> ResultTable:
    """Table of what everybody costs on each model over `_RIVALS`."""
    pairs, cells = list(product(transfer.drives, _RIVALS)), []
    for _, name in list_entries(transfer.kind):
        ratios = (name != x and _format_cost_ratio(transfer, name, x, [m]) for m, x in pairs)
        cells.append([name, *(ratio or "" for ratio in ratios)])
    header = [f"{model}, % of {rival}" for model, rival in pairs]
    note = "Geometric means, paired, where the one compared with survives; a failure counts 20."
    return ResultTable(f"{title}: cost over others'", ("controller", *header), cells, note)
