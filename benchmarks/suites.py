"""The suites by name, each loaded when it is asked for."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from .harness.results import Suite


@dataclass(frozen=True)
class Wish:
    """How a suite shall be run.

    quick: few seeds. jobs: processes, None for all processors. episodes: of a cell of the matrix,
    None for the suite's own number. keep: a folder for finished cases.
    """

    quick: bool = False
    jobs: int | None = None
    console: Console | None = None
    episodes: int | None = None
    keep: Path | None = None


def _estimation(wish: Wish) -> Suite:
    from . import estimation

    seeds = estimation.QUICK_SEEDS if wish.quick else estimation.SEEDS
    return estimation.run(seeds, wish.jobs, console=wish.console)


def _control(wish: Wish) -> Suite:
    from .control import suite as control
    from .control.cells import EPISODES, QUICK_EPISODES

    usual = QUICK_EPISODES if wish.quick else EPISODES
    return control.run(wish.episodes or usual, wish.jobs, wish.console, wish.keep)


def _papers(wish: Wish) -> Suite:
    from .papers import suite as papers

    seeds = papers.QUICK_SEEDS if wish.quick else papers.SEEDS
    return papers.run(seeds, wish.jobs, console=wish.console)


def _following(wish: Wish) -> Suite:
    from . import following

    if wish.quick:
        return following.run(
            following.QUICK_SEEDS, following.QUICK_CARS, wish.jobs, console=wish.console
        )
    return following.run(jobs=wish.jobs, console=wish.console)


def _procedures(wish: Wish) -> Suite:
    from .procedures import suite

    return suite.run(wish.quick, wish.jobs, console=wish.console)


def _speed(wish: Wish) -> Suite:
    from .speed import suite

    return suite.run(wish.quick, wish.console)


SUITES: dict[str, Callable[[Wish], Suite]] = {
    "estimation": _estimation,
    "control": _control,
    "papers": _papers,
    "following": _following,
    "procedures": _procedures,
    "speed": _speed,
}
