"""Whether the order of entries holds where a group of a world's errors is doubled or absent.

`python -m sideslip.benchmarks.control.robustness --keep cases` lists pairs of entries that are
surely ordered in the benchmark's world and surely the other way round in another. Designs are
told the ranges of the world that they drive in, as by a data sheet.
"""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from ...envs.scenarios.world import GROUPS, World, make_world
from ..harness.stats import Estimate, average
from .entries import ADAPTIVE, JOINT, ORACLE_NAMES, REFERENCE_CONTROLLER, REFERENCE_FILTER, Entry
from .run import Results, measure
from .score import rank_entries
from .tasks import QUICK_LEAD_IN, WORLD, list_scored_tasks, make_salt, make_task_seeds

_FILTERS = ("exact-kf, gps", "exact-kf, camera", "bicycle-kf", "dakf")
ENTRIES = (
    *map(Entry, (*ORACLE_NAMES, "none")),
    *(Entry(name, REFERENCE_FILTER) for name in ("esc", "two-dof")),
    *(Entry(name, JOINT) for name in ADAPTIVE),
    *(Entry(REFERENCE_CONTROLLER, name) for name in _FILTERS),
)  # the entries whose order is checked
FACTORS = (0.0, 2.0)  # of a group's ranges about the ideal


def _compare_scores(results: Results) -> dict[tuple[str, str], Estimate]:
    """Compute each entry's mean r less another's, paired by drive, by their labels in order."""
    ranked = sorted(rank_entries(results, None), key=lambda standing: standing.label)
    differences = {}
    for first, second in itertools.combinations(ranked, 2):
        common = [task for task in first.scores if task in second.scores]
        strata = (first.scores[task] - second.scores[task] for task in common)
        differences[first.label, second.label] = average(*strata)
    return differences


def _list_reversals(
    base: Mapping[tuple[str, str], Estimate], other: Mapping[tuple[str, str], Estimate]
) -> list[tuple[str, str]]:
    """List entries surely ordered, the better first, and surely the other way round elsewhere."""
    reversals = []
    for names, one in base.items():
        if one.low > 0.0 > other[names].high:
            reversals.append(names)
        elif one.high < 0.0 < other[names].low:
            reversals.append(names[::-1])
    return reversals


def _main(
    episodes: int = 16, tasks: int = 12, jobs: int | None = None, keep: Path | None = None
) -> None:
    """Drive all entries in the benchmark's world and in those of other ranges; list reversals."""
    console, scored = Console(), list_scored_tasks()
    chosen = [scored[i * len(scored) // tasks] for i in range(min(tasks, len(scored)))]
    seeds = make_task_seeds(make_salt(), episodes)

    def compare(world: World, title: str) -> dict[tuple[str, str], Estimate]:
        changes = {"lead_in": QUICK_LEAD_IN, "world": world.to_dict()}
        cases = [(replace(task, changes=changes), entry) for task in chosen for entry in ENTRIES]
        results = measure(cases, seeds, jobs=jobs, console=console, keep=keep, title=title)
        return _compare_scores(results)

    base = compare(make_world(WORLD), WORLD)
    sure = sum(x.low > 0.0 or x.high < 0.0 for x in base.values())
    console.print(f"{sure} of {len(base)} pairs are surely ordered.")
    for group, factor in itertools.product(GROUPS, FACTORS):
        other = compare(make_world(WORLD).scale(group, factor), f"{group} x {factor:g}")
        reversals = _list_reversals(base, other)
        texts = [f"{better} above {worse}" for better, worse in reversals]
        console.print(f"{group} x {factor:g}: reversed: {'; '.join(texts) or 'none'}")


if __name__ == "__main__":
    import typer

    typer.run(_main)
