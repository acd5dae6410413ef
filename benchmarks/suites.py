"""The suites by name, each loaded when it is asked for."""

from collections.abc import Callable, Sequence
from importlib import import_module

from .harness.parallel import use_shared_bar
from .harness.results import Suite
from .report.study import Request

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
}  # the module of each suite, whose `STUDY` it is, loaded when it is asked for

SALTED = ("control",)  # the suites whose test seeds follow the entries' sources


def run_suites(
    names: Sequence[str], request: Request, run: Callable[[Request], Suite] | None = None
) -> list[Suite]:
    """Run suites one after the other, with one progress bar for all of them.

    Args:
        names: Names in `SUITES`.
        request: Options of the run.
        run: Function that is run instead of these suites, such as another study's `run`.
    """
    with use_shared_bar(request.console, f"bench {' '.join(names)}"):
        if run is not None:
            return [run(request)]
        return [import_module(SUITES[name], __package__).STUDY.run(request) for name in names]
