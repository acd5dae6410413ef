"""The open benchmark: a user's entries and the package's on the same episodes, and their scores.

`sideslip.score` gives an entry's score as a Python object; `STUDY` makes the suite.
"""

import hashlib
import math
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...envs.numerics import require_extra
from ..control.entries import QUICK_EPISODES, REFERENCE_CONTROLLER, REFERENCE_FILTER, ControlCase
from ..control.run import Chunk, measure
from ..control.score import Matrix, Standing
from ..control.tables import make_failure_tables, make_main_table, make_task_table
from ..control.tasks import make_salt, make_task_seeds, make_tuning_seeds
from ..harness.results import Suite
from ..harness.stats import Estimate
from ..report.study import Request, Study, format_percent, format_verdict
from .challenge import (
    EPISODES,
    ComparisonRequest,
    choose_estimator,
    find_baselines,
    make_baseline_cases,
    make_user_entry,
)
from .worker import LIMIT, IsolatedDrive, run_user_chunk

if TYPE_CHECKING:
    import pandas as pd

_NONE = Estimate(math.nan)
_COLUMNS = dict(score="score", cost="cost_vs_nominal", won="share_won", failures="failure_rate")
_MAX_SENTENCES = 4  # entries with a sentence
_REHEARSED = 2  # episodes of a task in which entries show what they open


@dataclass(frozen=True, kw_only=True)
class Comparison(Matrix):
    """The episodes of a request; salt: "" for the caller's seeds."""

    request: ComparisonRequest
    on_file: bool  # whether the baselines are


def _compare(request: Request) -> Comparison:
    """Drive a request: names and files in processes of their own, objects in this one."""
    assert isinstance(request, ComparisonRequest)
    entries, tasks = request.entries, request.tasks
    progress: dict[str, Any] = {"jobs": request.jobs, "console": request.console}
    shared = progress | {"keep": request.keep}
    controllers = any(entry.agent != REFERENCE_CONTROLLER for entry in entries)
    filters = any(entry.agent == REFERENCE_CONTROLLER for entry in entries)
    rivals = make_baseline_cases(tasks, controllers, filters)
    cases = [ControlCase(task, entry) for task in tasks for entry in entries]
    isolated = [case for case in cases if not case.entry.objects]
    objects = [case for case in cases if case.entry.objects]
    known = find_baselines(rivals, request.n, **shared) if request.is_as_shipped else None
    allowed: frozenset[str] | None = None
    salt = known[0] if known else request.salt or make_salt()
    if request.fresh:
        allowed = _find_opened_files(request, isolated)
        digests = [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in sorted(allowed)]
        salt = make_salt(*digests, secrets.token_hex(16))
    seeds = request.seeds or make_task_seeds(salt, request.n)
    results = known[1] if known else measure(rivals, seeds, title="baselines", **shared)
    runner = IsolatedDrive(request.limit, allowed)
    results |= measure(isolated, seeds, title="entrants", runner=runner, **progress)
    results |= measure(objects, seeds, jobs=1, runner=run_user_chunk)
    salt = "" if request.seeds else salt
    return Comparison(results, salt, request=request, on_file=bool(known))


def _find_opened_files(request: ComparisonRequest, cases: Sequence[ControlCase]) -> frozenset[str]:
    """Find the files that entries open, theirs included, by a drive on tuning seeds."""
    chunks = [Chunk(*case, tuple(make_tuning_seeds(_REHEARSED))) for case in cases]
    opened = request.run_cases(IsolatedDrive(request.limit).rehearse, chunks, "rehearsal")
    return frozenset().union(*opened, map(os.path.realpath, request.files))


def _add_tables(suite: Suite, comparison: Comparison) -> None:
    ranked, request = comparison.overall, comparison.request
    suite.tables = [
        make_main_table("Your entries and the package's", ranked, request.entries),
        make_task_table("Task by task", ranked, request.tasks),
        *make_failure_tables(comparison.results),
    ]
    comparison.add_rows(suite)


def _compose_verdict(comparison: Comparison) -> str:
    """Compose the verdict: the user's entries, the best first, and how far to trust them."""
    entries = comparison.request.entries
    placed = [(i, x) for i, x in enumerate(comparison.overall, 1) if x.entry in entries]
    count, more = len(comparison.overall), len(placed) - _MAX_SENTENCES
    lines = [f"Place {i} of {count}: {_make_sentence(x)}." for i, x in placed[:_MAX_SENTENCES]]
    if more > 0:
        lines[-1] = f"{more + 1} more stand in the table."
    return format_verdict(*lines, _describe_trust(comparison))


def _make_sentence(standing: Standing) -> str:
    """Make the sentence that says where an entry stands."""
    score = standing.overall.get("score")
    errors = [f"{c.name}: {r.error}" for c, r in standing.results.items() if r.error]
    if score is None:
        why = f"not driven: {errors[0]}" if errors else "nominal is not driven"
        return f"{standing.entry.label}: {why}"
    below = "surely below" if score.high < 0.0 else "not told apart from"
    where = "surely above" if score.low > 0.0 else below
    finished = np.concatenate([x.finished for x in standing.pairs.values()], axis=1)
    lost = 100.0 * (1.0 - finished.mean(axis=1))
    parts = [
        f"score {score.inline()}, {where} nominal's 0",
        f"loses {lost[0]:.1f} % of the cars (nominal {lost[1]:.1f} %)"
        + (", surely more" if standing.loses_more else ""),
    ]
    if "cost_vs_nominal" in standing.overall:
        won = 100.0 * standing.overall["share_won"].value
        cost = format_percent(standing.overall["cost_vs_nominal"])
        parts += [f"costs {cost} of nominal where both finish", f"and wins {won:.0f} % of these"]
    text = f"{standing.entry.label}: {', '.join(parts)}"
    if errors:
        text += f"; not driven in {len(errors)} of {len(standing.results)} tasks: {errors[0]}"
    return text


def _describe_trust(comparison: Comparison) -> str:
    """Sentence on what the numbers rest, and what they do not say."""
    request = comparison.request
    count = len(request.tasks)
    where = f"{count} task{'s' if count > 1 else ''} x {request.n} episodes"
    if request.fresh:
        files = ", ".join(path.name for path in request.files)
        return (
            f"Publishable: {where} on seeds drawn after {files} were hashed; --salt "
            f"{comparison.salt} repeats them. Everybody driven anew. "
            "Not said: other cars, manoeuvres and sensors."
        )
    whose = "the given" if request.salt else "the package's own"
    seeds = f"of {whose} salt {comparison.salt}" if comparison.salt else "of the caller's choice"
    rows = "on file, a sample driven again" if comparison.on_file else "driven now"
    return (
        f"Not publishable: {where} on seeds {seeds}, which an entry can be tuned on; --fresh "
        f"draws new ones. Baselines {rows}. Not said: other cars, manoeuvres and sensors."
    )


@dataclass(frozen=True, repr=False)
class Score:
    """The score of an entry, 0 as nominal; oracle-state's stands in the table.

    Attributes:
        agent: Name of the agent.
        estimator: Name of the estimator.
        score: Mean r; like the next three an `Estimate` with its 95 % interval, NaN where unknown.
        cost: Cost over nominal's, of the episodes that both finish.
        won: Fraction of these that cost less than nominal's.
        failures: Fraction of all episodes that failed.
        n: Episodes that count.
        tasks: A row for each task with the same numbers.
        error: Reason why a task was not driven, "" where all were.
        text: Sentence of the benchmark.
    """

    agent: str
    estimator: str
    score: Estimate
    cost: Estimate
    won: Estimate
    failures: Estimate
    n: int
    tasks: tuple[dict[str, Any], ...]
    error: str
    text: str

    def __repr__(self) -> str:
        return f"<{self.text}>"

    def to_pandas(self) -> "pd.DataFrame":
        """Make a table with one row for each task (needs pandas)."""
        with require_extra("report", "to_pandas needs pandas"):
            import pandas as pd

        return pd.DataFrame(list(self.tasks))


def score(
    agent: object, env_id: str = "", *, scenarios: Sequence[Any] = (), vehicle: Any = None,
    estimator: object = None, episodes: int = EPISODES, seeds: Sequence[int] | None = None,
    fresh: bool = False, limit: float = LIMIT, trust: bool = False, jobs: int | None = None,
) -> Score:  # fmt: skip
    """Score a controller, a policy or a filter as `sideslip bench control` does.

    A file drives in a process of its own, an object in this one. An error while it drives becomes
    the result's `error`.

    Args:
        agent: Name, file's class ("my.py:MyController"), path, agent or factory, as `make_agent`.
        env_id: Id whose tasks are driven; "": both ids of the matrix.
        scenarios: Names, files or mappings, or one of them; empty: a task or two of every tier.
        vehicle: Name, file or mapping instead of the tasks' cars.
        estimator: Name, file's class or factory in front of the agent, "" for none; None: the one
            of the policy's training, or nominal's. A filter is scored under "lqr".
        episodes: Episodes of each task.
        seeds: Seeds instead of the benchmark's, whose baselines are on file.
        fresh: As in `ComparisonRequest`, whose errors it raises.
        limit: As in `ComparisonRequest`.
        trust: Whether a policy's zip may be read, which can run code.
        jobs: Number of processes, None for all processors.
    """
    is_single = isinstance(scenarios, str | os.PathLike | Mapping)
    scenario_list = (scenarios,) if is_single else tuple(scenarios)
    chosen = None if seeds is None else tuple(map(int, seeds))
    if estimator is None:
        estimator = choose_estimator(agent) if isinstance(agent, str) else REFERENCE_FILTER
    entry = make_user_entry(agent, estimator, trust)
    where = vehicle, scenario_list, env_id, chosen
    comparison = _compare(
        ComparisonRequest((entry,), *where, fresh, limit, episodes=episodes, jobs=jobs)
    )
    standing = next(item for item in comparison.overall if item.entry == entry)
    rows = []
    for task, result in standing.results.items():
        numbers = standing.by_task.get(task, {})
        row: dict[str, Any] = {key: getattr(task, key) for key in ("tier", "env_id", "scenario")}
        for name, metric in _COLUMNS.items():
            number = numbers.get(metric, _NONE)
            row |= {name: number.value, f"{name}_low": number.low, f"{name}_high": number.high}
        pairs = standing.pairs.get(task)
        rows.append(row | {"n": pairs.n if pairs else 0, "error": result.error})
    total, cost, won, failures = (standing.overall.get(x, _NONE) for x in _COLUMNS.values())
    error = next((row["error"] for row in rows if row["error"]), "")
    return Score(
        entry.agent, entry.estimator, total, cost, won, failures,
        standing.n, tuple(rows), error, _make_sentence(standing),
    )  # fmt: skip


STUDY = Study(
    "control", "Your own beside the package's",
    "Everybody drives the same episodes; an agent of yours on nominal's filter, or on yours.",
    (EPISODES, QUICK_EPISODES), _compare, _add_tables, _compose_verdict,
)  # fmt: skip
