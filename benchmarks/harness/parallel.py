"""Independent cases in processes or on Ray, with a bar; engine and workers change no result."""

import io
import math
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from threading import Event, Thread
from typing import Any, TypeVar

import joblib
from gymnasium.error import Error as GymnasiumError
from rich import progress
from rich.console import Console
from rich.markup import escape

from ...envs.numerics import require_extra
from ...envs.validation import check_choice

Case = TypeVar("Case")
Result = TypeVar("Result")

PROCESSES, _RAY = _ENGINES = ("processes", "ray")
RETRIES = 3  # deaths of its worker or node that a case outlives on a cluster
_EVERY = 15.0  # s between two lines where no bar can be drawn
_CLUSTER: ContextVar[Any] = ContextVar("cluster", default=None)


@contextmanager
def use_engine(name: str = PROCESSES, address: str = "") -> Iterator[None]:
    """Use an engine for the cases within; ValueError for an unknown engine or cluster.

    Args:
        name: Name, `PROCESSES` or "ray"; ModuleNotFoundError where Ray is not installed.
        address: Existing Ray cluster, "host:port", "" for this machine's; it must run this version.
    """
    check_choice("engine", name, _ENGINES)
    if name == PROCESSES:
        if address:
            raise ValueError(f"an address is of a Ray cluster (engine {_RAY!r}), got {address!r}")
        yield
        return
    with require_extra("scale", "the engine 'ray' needs ray"):
        import ray
    quiet = {"env_vars": {"SIDESLIP_QUIET": "1", "OPENBLAS_NUM_THREADS": "1"}}
    try:
        if address:  # Ray itself asks for minutes, then ends the process
            host, _, port = address.removeprefix("ray://").rpartition(":")
            socket.create_connection((host, int(port)), timeout=5.0).close()
        ray.init(address or "auto", runtime_env=quiet, log_to_driver=False, logging_level="error")
    except (OSError, ValueError, RuntimeError) as error:
        where = f"at {address}" if address else "on this machine (`ray start --head`)"
        raise ValueError(f"there is no Ray cluster {where}: {error}") from None
    token = _CLUSTER.set(ray)
    try:
        yield
    finally:
        _CLUSTER.reset(token)
        ray.shutdown()


def _execute_cases(
    function: Callable[[Case], Result], cases: Sequence[Case], jobs: int | None = None
) -> Iterator[tuple[int, Result]]:
    """Execute cases and yield index and result; a cluster does in the order of their ends."""
    ray = _CLUSTER.get()
    if ray is None:
        # the number asked for is left alone: another one would end the processes of the last call
        n_jobs = jobs or max(min(joblib.cpu_count(), len(cases)), 1)
        pool = joblib.Parallel(n_jobs, return_as="generator")
        yield from enumerate(pool(joblib.delayed(function)(case) for case in cases))
        return
    remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)  # a dead node's cases run again
    function_ref = ray.put(function)
    waiting = {remote.remote(function_ref, case): place for place, case in enumerate(cases)}
    while waiting:
        (done,), _ = ray.wait(list(waiting), num_returns=1)
        yield waiting.pop(done), ray.get(done)


def _call(function: Callable[[Case], Result], case: Case) -> Result:
    return function(case)


class Bar(progress.Progress):
    """A progress bar, or where none can be drawn a line on standard error every `_EVERY`.

    Args:
        console: Console of the bar; None: nothing is shown.
    """

    def __init__(self, console: Console | None) -> None:
        hidden = console is None or not console.is_interactive
        text, count = progress.TextColumn("{task.description}"), progress.MofNCompleteColumn()
        times = progress.TimeElapsedColumn(), progress.TimeRemainingColumn()
        columns = (text, progress.BarColumn(20), count, *times)
        # the pace is that of the whole work, but for the first step: what a stopped run has done
        super().__init__(*columns, console=console, disable=hidden, speed_estimate_period=math.inf)
        self._speaks, self._over = console is not None and hidden, Event()

    def start(self) -> None:
        """Start to draw or to print lines."""
        super().start()
        if self._speaks:
            Thread(target=self._speak, daemon=True).start()

    def stop(self) -> None:
        """Stop the bar."""
        self._over.set()
        super().stop()

    def _speak(self) -> None:
        while not self._over.wait(_EVERY):
            self.report()

    def report(self) -> None:
        """Print how far the newest task is where no bar is drawn."""
        for task in self.tasks[-1:] if self._speaks else ():
            text = ""
            if task.total is not None:
                text = f"{task.completed:,.0f} of {task.total:,.0f} {task.fields['unit']}, "
            if left := task.time_remaining:
                text += f"{left:.0f} s left, "
            line = f"{task.description}: {text}{task.elapsed or 0.0:.0f} s".lstrip(": ")
            Console(stderr=True, soft_wrap=True).print(line, highlight=False, markup=False)


_SHARED: ContextVar[Bar | None] = ContextVar("shared", default=None)


@contextmanager
def use_shared_bar(
    console: Console | None, title: str, unit: str = "cases", total: int | None = None
) -> Iterator[Bar]:
    """Show one progress bar for the work inside; every `run_cases` shows its cases in it.

    Args:
        console: Console of the bar; None: nothing is shown.
        title: First title.
        unit: Unit of the count.
        total: Total of the count, None if unknown.

    Yields:
        The progress bar.
    """
    with Bar(console) as bar:
        bar.add_task(title, total=total, unit=unit)
        bar.report()
        token = _SHARED.set(bar)
        try:
            yield bar
        finally:
            _SHARED.reset(token)


def run_cases(
    function: Callable[[Case], Result],
    cases: Sequence[Case],
    title: str = "",
    jobs: int | None = None,
    console: Console | None = None,
) -> list[Result]:
    """Run a function on every case, and return the results in the order of the cases.

    Args:
        function: Function of a case, importable by workers.
        cases: Arguments of the function, one for each call.
        title: Title of the progress bar.
        jobs: Number of processes, None for one a processor, 1 for this process.
        console: Console of the progress bar outside of `use_shared_bar`; None: nothing is shown.
    """
    shared, results = _SHARED.get(), dict[int, Result]()
    with Bar(console) if shared is None else nullcontext(shared) as bar:
        for before in bar.task_ids:
            bar.remove_task(before)
        task = bar.add_task(title, total=len(cases), unit="cases")
        bar.report()
        for place, result in _execute_cases(function, cases, jobs):
            results[place] = result
            bar.advance(task)
    return [results[place] for place in range(len(cases))]


_USER_ERRORS = (
    ValueError, TypeError, ModuleNotFoundError, OSError, RecursionError, GymnasiumError,
    FloatingPointError,
)  # fmt: skip

_MAX_LETTERS = 1000  # of a message


@contextmanager
def report_user_errors() -> Iterator[None]:
    """End the process with exit status 2 and the message of a user's error, no traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # unencodable characters do not raise
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
    except _USER_ERRORS as error:
        text, half = str(error), _MAX_LETTERS // 2
        text = text if len(text) <= _MAX_LETTERS else f"{text[:half]} ... {text[-half:]}"
        console = Console(stderr=True, soft_wrap=True)
        console.print("[bold red]error:[/]", escape(text), highlight=False)
        sys.exit(2)
