"""The suites by name, each loaded when it is asked for."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from .harness.parallel import use_shared_bar
from .harness.results import Suite
from .report.study import Request

if TYPE_CHECKING:
    from .entrants.challenge import ComparisonRequest

__all__ = ["SALTED", "SUITES", "Request", "run_suites"]

SUITES = {
    "estimation": ".studies.estimation",
    "conditions": ".studies.conditions",
    "control": ".control.suite",
    "papers": ".papers.suite",
    "highway": ".studies.traffic",
    "procedures": ".procedures.suite",
    "speed": ".speed.suite",
    "logs": ".studies.logs",
}  # the module of each suite, whose `STUDY` it is

SALTED = ("control",)  # the suites whose test seeds follow the entries' sources


def run_suites(
    names: Sequence[str], request: Request, comparison: "ComparisonRequest | None" = None
) -> list[Suite]:
    """Run suites one after the other, with one progress bar for all of them.

    Args:
        names: Names in `SUITES`.
        request: Options of the run.
        comparison: A user's entries, which drive instead of the matrix.
    """
    with use_shared_bar(request.console, f"bench {' '.join(names)}"):
        if comparison is not None:
            from .entrants.score import run

            return [run(comparison, request)]
        return [import_module(SUITES[name], __package__).STUDY.run(request) for name in names]
