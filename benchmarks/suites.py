"""The suites by name, each loaded when it is asked for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from .harness.parallel import use_shared_bar
from .harness.results import Suite

if TYPE_CHECKING:
    from .entrants.challenge import ComparisonRequest


@dataclass(frozen=True)
class Request:
    """The options of a run.

    Attributes:
        quick: Whether few seeds are run.
        jobs: Processes, None for all processors.
        console: Where progress is shown.
        episodes: Episodes of a cell of the matrix, or seeds; None for the suite's number.
        keep: Folder of finished cases.
        clairvoyant: File of `sideslip calibrate`, None for the package's.
        comparison: A user's entries, which drive instead of the matrix.
        salt: Salt of the seeds of `SALTED`, "" for the one of the contestants' sources.
    """

    quick: bool = False
    jobs: int | None = None
    console: Console | None = None
    episodes: int | None = None
    keep: Path | None = None
    clairvoyant: Path | None = None
    comparison: "ComparisonRequest | None" = None
    salt: str = ""


_Run = Callable[[Any, Request], Suite]


def _run_seeds(suite: Any, r: Request) -> Any:
    usual = suite.QUICK_SEEDS if r.quick else suite.SEEDS
    return suite.run(r.episodes or usual, r.jobs, r.console)


def _run_control(suite: Any, r: Request) -> Any:
    from .control.entries import EPISODES, QUICK_EPISODES

    if r.comparison is not None:
        from .entrants.score import run as run_comparison

        return run_comparison(r.comparison, r.jobs, r.console, r.keep)
    usual = QUICK_EPISODES if r.quick else EPISODES
    return suite.run(r.episodes or usual, r.jobs, r.console, r.keep, r.quick, r.clairvoyant, r.salt)


def _run_learned(suite: Any, r: Request) -> Any:
    usual = suite.QUICK_EPISODES if r.quick else suite.EPISODES
    return suite.run(r.episodes or usual, r.jobs, r.console, r.keep, r.quick, r.salt)


def _run_following(suite: Any, r: Request) -> Any:
    numbers = (suite.QUICK_SEEDS, suite.QUICK_CARS) if r.quick else (suite.SEEDS, suite.CARS)
    return suite.run(*numbers, r.jobs, r.console)


def _run_highway(suite: Any, r: Request) -> Any:
    numbers = (suite.QUICK_SEEDS, suite.QUICK_DRIVES) if r.quick else (suite.SEEDS, suite.DRIVES)
    return suite.run(*numbers, r.jobs, r.console)


def _run_quick(suite: Any, r: Request) -> Any:
    return suite.run(r.quick, r.jobs, r.console)


SUITES: dict[str, tuple[str, _Run]] = {
    "estimation": (".studies.estimation", _run_seeds),
    "unknown": (".studies.unknown", _run_seeds),
    "control": (".control.suite", _run_control),
    "learned": (".studies.learned", _run_learned),
    "learned-outside": (".studies.learned_outside", _run_learned),
    "memory": (
        ".studies.recurrent",
        lambda suite, r: suite.run(r.quick, r.episodes, r.jobs, r.console, r.keep),
    ),
    "papers": (".papers.suite", _run_seeds),
    "following": (".studies.coordinated_control", _run_following),
    "highway": (".studies.traffic", _run_highway),
    "recovery": (".studies.recovery_region", _run_quick),
    "procedures": (".procedures.suite", _run_quick),
    "speed": (".speed.suite", lambda suite, r: suite.run(r.quick, r.console)),
}
"""The module of each suite, and how a request runs it."""
SALTED = ("control", "learned", "learned-outside")
"""The suites whose test seeds follow the contestants' sources."""


def check_salt(salt: str, names: Sequence[str]) -> None:
    """Raise ValueError for a salt that is not hexadecimal, or that no suite takes."""
    if salt and not {*SALTED} & {*names}:
        raise ValueError(f"--salt goes with {', '.join(SALTED)}, got {', '.join(names)}")
    if salt:
        from .control.tasks import make_salted_seeds

        make_salted_seeds(salt, 1)


def run_suites(names: Sequence[str], request: Request) -> list[Suite]:
    """Run suites of `SUITES` one after the other, with one progress bar for all of them."""
    with use_shared_bar(request.console, f"bench {' '.join(names)}"):
        return [run_suite(name, request) for name in names]


def run_suite(name: str, request: Request) -> Suite:
    """Run a suite of `SUITES`."""
    module, run = SUITES[name]
    return run(import_module(module, __package__), request)
