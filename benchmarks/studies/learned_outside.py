"""The suite `learned-outside`: what learned policies cost in a car whose equations are not ours.

CommonRoad's models of a BMW 320i take the place of the passenger car, on a straight road, with our
sensors and references. Controllers, filters and references are designed from that car, as far as
our `Vehicle` describes it; the policies were trained on another one.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ...agents.rollout import iterate_steps
from ...envs.outside.plants import OUTSIDE_PLANTS
from ...envs.scenarios.manoeuvres import make_scenario
from ...estimators.registry import describe_error
from ..control.entries import LEARNED
from ..control.run import NUMBERS, Chunk, DriveResult, measure
from ..control.tasks import (
    NOMINAL,
    STEERING,
    YAW,
    ControlTask,
    make_salt,
    make_task_seeds,
    vary_scenario,
)
from ..harness.results import Column, Line, ResultTable, Suite
from ..harness.stats import share
from ..harness.verdict import format_verdict
from ..report.study import Request, Study
from .learned import (
    EPISODES,
    TransferResult,
    add_figures,
    add_tables,
    collect_results,
    list_entries,
)

OUTSIDE_ID = "sideslip/Outside-v0"
KINDS = tuple(kind for kind in LEARNED if kind.startswith("car-"))
"""Classes whose car is about as large and as fast as the BMW."""
MANOEUVRE = "any-friction-sine-with-dwell"
"""The scenario of every class that ends with the initial heading, as a straight road needs."""
_RIVALS = (NOMINAL, "adaptive-nmpc")
"""Controllers by whose costs all costs are divided: no gap between oracles scales scores here."""


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


def _make_outside_task(kind: str, model: str) -> _OutsideTask:
    """Make a class's task of `MANOEUVRE` with a model as the car."""
    like = STEERING if kind.endswith("steering") else YAW
    return _OutsideTask("", OUTSIDE_ID, "", "lagged", MANOEUVRE, model, like)


def _run_chunk(chunk: Chunk) -> DriveResult:
    """Drive cars that are stepped one by one; all metrics but cost and failure are NaN."""
    start_time, numbers = time.process_time(), np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
    try:
        env, agent = chunk.entry.make(chunk.task, len(chunk.seeds))
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


def _measure(request: Request) -> list[TransferResult]:
    """Run every class of `KINDS` on every model; ValueError: an entry cannot drive."""
    models, salt = request.choose(list(OUTSIDE_PLANTS), ["drift"]), request.salt or make_salt()
    cases = [
        (_make_outside_task(kind, model), entry)
        for model in models
        for kind in KINDS
        for entry in list_entries(kind)
    ]
    results = measure(
        cases, make_task_seeds(salt, request.episodes or 0), jobs=request.jobs,
        console=request.console, keep=request.keep, runner=_run_chunk, title="learned-outside",
    )  # fmt: skip
    remark, scenarios = "No training met any.", f"{MANOEUVRE} on a straight road"
    transfers = []
    for kind in KINDS:
        tasks = {model: _make_outside_task(kind, model) for model in models}
        drives = {x: [collect_results(results, task, x)] for x, task in tasks.items()}
        where = (OUTSIDE_ID, f"{kind} in a BMW", scenarios, f"Other seeds on each model. {remark}")
        transfers.append(TransferResult(kind, drives, salt, *where))
    return transfers


def _add_tables(suite: Suite, transfers: Sequence[TransferResult]) -> None:
    """Add each class's rows and tables, those of costs over `_RIVALS` first: they need no gap."""
    for transfer in transfers:
        add_tables(suite, [transfer])
        suite.tables.insert(-2, _make_ratio_table(transfer))


def _compose_verdict(transfers: Sequence[TransferResult]) -> str:
    """Compose the verdict: the cost of each class's policies over their rivals' on all models."""
    lines = []
    for transfer in transfers:
        for policy in (entry.agent for entry in LEARNED[transfer.kind]):
            models = transfer.drives
            ratios = {x: transfer.compute_cost_ratio(policy, x, models) for x in _RIVALS}
            texts = (f"{ratio.inline(100.0, '.0f')} % of {x}'s" for x, ratio in ratios.items())
            fails = 100.0 * share(transfer.select("failure", policy) != 0.0).value
            lines.append(f"{policy} costs {', '.join(texts)}; {fails:.0f} % fail.")
    return format_verdict("On CommonRoad's BMW, known to all but the policies:", *lines)


def _make_ratio_table(transfer: TransferResult) -> ResultTable:
    """Table of what everybody costs on each model over `_RIVALS`."""
    pairs, records = list(product(transfer.drives, _RIVALS)), list[Line]()
    columns = [Column(f"{model}, % of {x}", scale=100.0, form=".0f") for model, x in pairs]
    for name in (entry.agent for entry in list_entries(transfer.kind)):
        keyed = zip(columns, pairs, strict=True)
        ratios = {
            column.key: transfer.compute_cost_ratio(name, x, [model])
            for column, (model, x) in keyed
            if x != name
        }
        records.append({"controller": name} | ratios)
    note = "Geometric means, paired, where the one compared with survives; a failure counts 20."
    title = f"{transfer.title}: cost over others'"
    return ResultTable(title, ("controller", *columns), records, note)


STUDY = Study(
    "learned-outside",
    "Learned policies in cars that are not ours",
    "The passenger car's policies on CommonRoad's single-track, drift and multi-body models of a "
    "BMW 320i, beside controllers on the same late sensors that are designed for it. No training "
    "met it.",
    EPISODES,
    _measure,
    _add_tables,
    _compose_verdict,
    add_figures,
    ("vehiclemodels", "Left out: pip install 'sideslip[outside]'."),
)
