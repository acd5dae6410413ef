"""A benchmark's work as a list of independent cases, run side by side with a progress bar."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from threading import Event, Thread
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from .engines import completed

Case = TypeVar("Case")
Result = TypeVar("Result")

_EVERY = 15.0  # s between two lines


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


@contextmanager
def _lines(
    console: Console | None, title: str, count: int, found: Mapping[int, object]
) -> Iterator[None]:
    """Say on standard error how many cases are done, at once and every 15 s, without a bar."""
    if console is None or console.is_terminal or count < 2:
        yield
        return
    ended, begun, speech = Event(), time.monotonic(), Console(stderr=True)

    def speak() -> None:
        while True:
            passed = time.monotonic() - begun
            text = f"{title}: {len(found)} of {count} cases, {passed:.0f} s"
            speech.print(text.lstrip(": "), highlight=False, markup=False)
            if ended.wait(_EVERY):
                return

    speaker = Thread(target=speak, daemon=True)
    speaker.start()
    try:
        yield
    finally:
        ended.set()
        speaker.join()


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
    `one_bar`; None shows none. Where it is no terminal, standard error gets a line every 15 s.
    """
    shared, found = _SHARED.get(), dict[int, Result]()
    there = console if shared is None else shared.console
    shown = progress(console) if shared is None else nullcontext(shared)
    with shown as bar, _lines(None if bar.disable else there, title, len(cases), found):
        for before in bar.task_ids:
            bar.remove_task(before)
        task = bar.add_task(title, total=len(cases))
        for place, result in completed(function, cases, jobs):
            found[place] = result
            bar.advance(task)
    return [found[place] for place in range(len(cases))]
