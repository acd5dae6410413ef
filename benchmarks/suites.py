"""The suites by name, each loaded when it is asked for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

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


class _SuiteModule(Protocol):
    run: Callable[..., Suite]


_Run = Callable[[_SuiteModule, Request], Suite]


def _make_run(*numbers: str) -> _Run:
    """Make the run of a suite with its numbers of that name, QUICK_... in a quick run."""

    def run(suite: _SuiteModule, r: Request) -> Suite:
        chosen = [getattr(suite, f"QUICK_{name}" if r.quick else name) for name in numbers]
        if len(numbers) == 1 and r.episodes:
            chosen = [r.episodes]
        return suite.run(*chosen, r.jobs, r.console)

    return run


def _run_control(suite: _SuiteModule, r: Request) -> Suite:
    from .control.entries import EPISODES, QUICK_EPISODES

    if r.comparison is not None:
        from .entrants.score import run as run_comparison

        return run_comparison(r.comparison, r.jobs, r.console, r.keep)
    usual = QUICK_EPISODES if r.quick else EPISODES
    return suite.run(r.episodes or usual, r.jobs, r.console, r.keep, r.quick, r.clairvoyant, r.salt)


def _run_learned(suite: _SuiteModule, r: Request) -> Suite:
    episodes = r.episodes or getattr(suite, "QUICK_EPISODES" if r.quick else "EPISODES")
    return suite.run(episodes, r.jobs, r.console, r.keep, r.quick, r.salt)


def _run_quick(suite: _SuiteModule, r: Request) -> Suite:
    return suite.run(r.quick, r.jobs, r.console)


SUITES: dict[str, tuple[str, _Run]] = {
    "estimation": (".studies.estimation", _make_run("SEEDS")),
    "unknown": (".studies.unknown", _make_run("SEEDS")),
    "control": (".control.suite", _run_control),
    "learned": (".studies.learned", _run_learned),
    "learned-outside": (".studies.learned_outside", _run_learned),
    "memory": (
        ".studies.recurrent",
        lambda suite, r: suite.run(r.quick, r.episodes, r.jobs, r.console, r.keep),
    ),
    "papers": (".papers.suite", _make_run("SEEDS")),
    "following": (".studies.coordinated_control", _make_run("SEEDS", "CARS")),
    "highway": (".studies.traffic", _make_run("SEEDS", "DRIVES")),
    "recovery": (".studies.recovery_region", _run_quick),
    "procedures": (".procedures.suite", _run_quick),
    "speed": (".speed.suite", lambda suite, r: suite.run(r.quick, r.console)),
}
"""The module of each suite, and how a request runs it."""
SALTED = ("control", "learned", "learned-outside")
"""The suites whose test seeds follow the contestants' sources."""


def check_salt(salt: str, names: Sequence[str]) -> None:
    """Check the salt of a request.

    Args:
        salt: Salt, "" for none.
        names: Names of the suites.

    Raises:
        ValueError: It is not hexadecimal, or no suite takes it.
    """
    if salt and not {*SALTED} & {*names}:
        raise ValueError(f"--salt goes with {', '.join(SALTED)}, got {', '.join(names)}")
    if salt:
        from .control.tasks import make_salted_seeds

        make_salted_seeds(salt, 1)


def run_suites(names: Sequence[str], request: Request) -> list[Suite]:
    """Run suites one after the other, with one progress bar for all of them.

    Args:
        names: Names in `SUITES`.
        request: Options of the run.

    Returns:
        Results.
    """
    with use_shared_bar(request.console, f"bench {' '.join(names)}"):
        return [_run_suite(name, request) for name in names]


def _run_suite(name: str, request: Request) -> Suite:
    """Run a suite."""
    module, run = SUITES[name]
    return run(cast(_SuiteModule, import_module(module, __package__)), request)
