"""Question: which process and measurement noise makes an estimator most accurate?

Searched on training seeds, judged on test seeds. `task` has what is searched and what counts as
error, `study` searches, `file` stores what was found.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from ...envs.record import Array
from ...estimators.design.tunings import TUNINGS
from ..harness.drives import LoggedEpisode
from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate, interval, ratio_of_roots, root_mean
from .task import SAMPLERS, STORAGE, EstimatorTuning, compute_squares, simulate

_EDGE = 1.25  # times an end of its range or less: the number counts as being there


def run(
    task: EstimatorTuning,
    trials: int = 200,
    test_seeds: int = 20,
    storage: str = STORAGE,
    sampler: str = SAMPLERS[0],
    seed: int = 0,
    jobs: int | None = None,
    console: Console | None = None,
) -> tuple[Suite, dict[str, float]]:
    """Search on the task's seeds, judge on the seeds 0 .. test_seeds-1; a suite and the numbers.

    Raises ValueError for no trials or test seeds, and as `create_study` and `search`.
    """
    from .study import create_study, search

    if trials < 1:
        raise ValueError(f"trials must be at least 1, got {trials}")
    if not 1 <= test_seeds <= task.seeds[0]:
        raise ValueError(f"test seeds are 1 to {task.seeds[0]}, got {test_seeds}")
    study = create_study(task, storage, sampler, seed)
    training = simulate(task, task.seeds, "training drives", jobs, console)
    numbers = search(study, task, training, trials, jobs, console)
    test = simulate(task, range(test_seeds), "test drives", jobs, console)
    suite = Suite(
        "tune",
        f"Tuning {task.estimator} on {task.subject}",
        f"RMSE of {task.target} from 2 s on in {task.unit}, with 95 % intervals; "
        f"{trials} trials. The default is make_estimator with no more than what is held "
        "fixed. Several scenarios count alike: the search makes the geometric mean of their RMSE "
        "least.",
        tables=[
            *_make_comparisons(task, training, test, numbers),
            make_result_table(numbers, task.search),
        ],
    )
    return suite, numbers


def _make_comparisons(
    task: EstimatorTuning,
    training: Sequence[LoggedEpisode],
    test: Sequence[LoggedEpisode],
    numbers: dict[str, float],
) -> list[ResultTable]:
    """A table a scenario."""
    default = [_compute_squares(task, drives, {}) for drives in (training, test)]
    tuned = [_compute_squares(task, drives, numbers) for drives in (training, test)]
    tables = []
    for i, scenario in enumerate(task.scenarios):
        before, after = [values[i] for values in default], [values[i] for values in tuned]
        ratio = (
            interval(after[1], ratio_of_roots, before[1])
            if np.isfinite(before[1]).all() and np.isfinite(after[1]).all()
            else Estimate(math.nan)
        )
        tables.append(
            ResultTable(
                f"{task.estimator} on {scenario} ({task.env_id})",
                ("tuning", f"{before[0].size} training seeds", f"{before[1].size} test seeds"),
                [["default", *map(_format_spread, before)], ["found", *map(_format_spread, after)]],
                f"Found over default on the test seeds: {ratio.inline(digits='.3f')}.",
            )
        )
    return tables


def _compute_squares(
    task: EstimatorTuning, drives: Sequence[LoggedEpisode], numbers: dict[str, float]
) -> Array:
    """`squares`, infinite where the estimator diverges."""
    try:
        return compute_squares(task, drives, numbers)
    except ValueError:
        return np.full((len(task.scenarios), len(drives) // len(task.scenarios)), np.inf)


def _format_spread(errors: Array) -> str:
    if not np.isfinite(errors).all():
        return "diverges"
    return interval(errors, root_mean).inline(digits=".4g")


def make_result_table(
    numbers: Mapping[str, float], search: Mapping[str, tuple[float, float]]
) -> ResultTable:
    """The numbers that were found; one at the end of its range is marked."""
    cells = []
    for name, (low, high) in search.items():
        value = numbers[name]
        remark = "at its end" if min(value / low, high / value) < _EDGE else ""
        cells.append([name, f"{value:g}", f"{low:g} .. {high:g}", remark])
    note = "A number at the end of its range: the optimum does without it, or lies beyond."
    return ResultTable("Found", ("option", "value", "range", ""), cells, note, keyed=False)


def make_entry(
    task: EstimatorTuning, numbers: dict[str, float], command: str, note: str = ""
) -> dict[str, Any]:
    """The tuning that was found, as an entry of a tunings file."""
    used = task.options | numbers
    q = {key.removeprefix("q_"): value for key, value in used.items() if key.startswith("q_")}
    q = TUNINGS.get((task.estimator, task.sensors), {}) | q
    noise = {key: value for key, value in numbers.items() if not key.startswith("q_")}
    result = {"estimator": task.estimator, "sensors": task.sensors, "command": command}
    return result | {"q": q, "noise": noise} | ({"note": note} if note else {})
