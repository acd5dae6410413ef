"""A benchmark's work as a list of independent cases, run side by side with a progress bar."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from .engines import completed

Case = TypeVar("Case")
Result = TypeVar("Result")


def chunked(seeds: int, size: int) -> list[tuple[int, ...]]:
    """The seeds 0 .. seeds-1 in tuples of at most `size`."""
    return [tuple(range(k, min(k + size, seeds))) for k in range(0, seeds, size)]


def progress(console: Console | None) -> Progress:
    """A progress bar on a console, hidden without one."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), console=console, disable=console is None)


_SHARED: ContextVar[Progress | None] = ContextVar("shared", default=None)


@contextmanager
def one_bar(console: Console | None) -> Iterator[None]:
    """One progress bar for every `run_cases` inside, which shows the one that runs."""
    with progress(console) as bar:
        token = _SHARED.set(bar)
        try:
            yield
        finally:
            _SHARED.reset(token)


def run_cases(
    function: Callable[[Case], Result],
    cases: Sequence[Case],
    title: str = "",
    jobs: int | None = None,
    console: Console | None = None,
) -> list[Result]:
    """function(case) for every case, in the order of the cases.

    function: importable by workers. jobs: processes (default: the processors at hand; a cluster has
    its own); 1 runs in this process. console: where the progress bar goes, unless inside
    `one_bar`; None shows none.
    """
    shared, found = _SHARED.get(), dict[int, Result]()
    with progress(console) if shared is None else nullcontext(shared) as bar:
        for before in bar.task_ids:
            bar.remove_task(before)
        task = bar.add_task(title, total=len(cases))
        for place, result in completed(function, cases, jobs):
            found[place] = result
            bar.advance(task)
    return [found[place] for place in range(len(cases))]
