"""`sideslip.score`: an entry's score as a Python object."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ...envs.backend.extras import require_extra
from ..control.cells import REFERENCE_FILTER
from ..harness.stats import Estimate
from .challenge import EPISODES, ComparisonRequest, UserEntry, choose_estimator
from .compare import compare
from .verdict import make_sentence
from .worker import LIMIT

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, repr=False)
class Score:
    """The score of an entry between nominal, 0, and oracle-state, 1.

    Attributes:
        agent: Name of the agent.
        estimator: Name of the estimator.
        score: Score; like the next three an `Estimate` with its 95 % interval, NaN where unknown.
        cost: Cost over nominal's.
        won: Fraction of the episodes that cost less than nominal's.
        failures: Fraction of all episodes that failed.
        n: Episodes that count.
        contests: A row for each task with the same numbers.
        error: Reason why no task was driven, "" otherwise.
        text: Sentence of the benchmark.
    """

    agent: str
    estimator: str
    score: Estimate
    cost: Estimate
    won: Estimate
    failures: Estimate
    n: int
    contests: tuple[dict[str, Any], ...]
    error: str
    text: str

    def __repr__(self) -> str:
        return f"<{self.text}>"

    def to_pandas(self) -> "pd.DataFrame":
        """Make a table with one row for each task (needs pandas)."""
        with require_extra("report", "to_pandas needs pandas"):
            import pandas as pd

        return pd.DataFrame(list(self.contests))


_NONE = Estimate(float("nan"))
_COLUMNS = {
    "score": "score",
    "cost": "cost_vs_nominal",
    "won": "share_won",
    "failures": "failure_rate",
}


def score(
    agent: Any,
    env_id: str = "",
    *,
    scenarios: Sequence[Any] = (),
    vehicle: Any = None,
    estimator: Any = None,
    episodes: int = EPISODES,
    seeds: Sequence[int] | None = None,
    fresh: bool = False,
    limit: float = LIMIT,
    trust: bool = False,
    jobs: int | None = None,
) -> Score:
    """Score a controller, a policy or a filter as `sideslip bench control` does.

    A file drives in a process of its own, an object in this one. An error while it drives becomes
    the result's `error`.

    Args:
        agent: Name, file's class ("my.py:MyController") or path, as for `make_agent`; or an agent,
            its class or another factory.
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

    Returns:
        Score over all tasks, and that of each task.
    """
    is_single = isinstance(scenarios, str | os.PathLike | Mapping)
    scenario_list = (scenarios,) if is_single else tuple(scenarios)
    chosen = None if seeds is None else tuple(map(int, seeds))
    if estimator is None:
        estimator = choose_estimator(agent) if isinstance(agent, str) else REFERENCE_FILTER
    entry = UserEntry(agent, estimator, trust)
    request = ComparisonRequest(
        (entry,), vehicle, scenario_list, env_id, episodes, chosen, fresh=fresh, limit=limit
    )
    comparison = compare(request, jobs)
    standing = comparison.select(entry)
    rows = []
    for task, result in standing.results.items():
        numbers = standing.by_task.get(task, {})
        row: dict[str, Any] = {
            "tier": task.tier, "env_id": task.env_id, "scenario": task.scenario
        }  # fmt: skip
        for name, metric in _COLUMNS.items():
            number = numbers.get(metric, _NONE)
            row |= {name: number.value, f"{name}_low": number.low, f"{name}_high": number.high}
        pairs = standing.pairs.get(task)
        rows.append(row | {"n": len(pairs[0]) if pairs else 0, "error": result.error})
    overall = {name: standing.overall.get(metric, _NONE) for name, metric in _COLUMNS.items()}
    errors = [row["error"] for row in rows]
    return Score(
        standing.entry.controller,
        standing.entry.estimator,
        **overall,
        n=standing.n,
        contests=tuple(rows),
        error=errors[0] if all(errors) else "",
        text=make_sentence(standing),
    )
