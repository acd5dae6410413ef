"""The skeleton of a suite: a study is data, and every study is run in the same way.

`measure` drives and returns results, `add_tables` makes rows and tables of them, `compose_verdict`
their answer in words, `add_figures` pictures. Lines of a table are records, as of a DataFrame.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Generic, TypeVar

from rich.console import Console

from ..harness.parallel import run_cases, split_seeds
from ..harness.results import Suite

Case = TypeVar("Case")
Condition = TypeVar("Condition")
Result = TypeVar("Result")
Results = TypeVar("Results")


@dataclass(frozen=True)
class Request:
    """The options of a run."""

    quick: bool = False  # whether few seeds are run
    jobs: int | None = None  # processes, None for all processors
    console: Console | None = None  # where progress is shown
    episodes: int | None = None  # of a cell of the matrix, or seeds; None for the suite's number
    keep: Path | None = None  # folder of finished cases, so that a stopped run goes on
    clairvoyant: Path | None = None  # file of `sideslip calibrate`, None for the package's
    data: Path | None = None  # folder of downloaded logs, for the suite logs
    salt: str = ""  # of the seeds of salted suites, "" for the one of the entries' sources

    def run_cases(
        self, function: Callable[[Case], Result], cases: Sequence[Case], title: str
    ) -> list[Result]:
        """Run a function on every case, in processes.

        Args:
            function: Function of a case, importable by workers.
            cases: Arguments of the function, one for each call.
            title: Title of the progress bar.
        """
        return run_cases(function, cases, title, self.jobs, self.console)

    def run_seeds(
        self,
        function: Callable[[tuple[Condition, Sequence[int]]], Sequence[Result]],
        conditions: Sequence[Condition],
        seeds: int,
        chunk: int,
        title: str,
    ) -> list[list[Result]]:
        """Run a function that gives a result a seed in every condition.

        Args:
            function: Function of a condition and some seeds, importable by workers.
            conditions: Conditions, which share the seeds 0 .. seeds-1.
            seeds: Number of seeds.
            chunk: Maximum of seeds in a call.
            title: Title of the progress bar.
        """
        chunks = split_seeds(seeds, chunk)
        cases = list(product(conditions, chunks))
        results = iter(self.run_cases(function, cases, title))
        return [[item for _ in chunks for item in next(results)] for _ in conditions]


@dataclass(frozen=True)
class Study(Generic[Results]):
    """A suite of the benchmark."""

    name: str
    title: str  # question that it answers
    text: str  # what was measured, and how; paragraphs are separated by an empty line
    seeds: tuple[int, int]  # of a usual and of a quick run, in place of a request's None
    measure: Callable[[Request], Results]  # drives, and returns the results
    add_tables: Callable[[Suite, Results], None]  # adds rows and tables of the results to a suite
    compose_verdict: Callable[[Results], str]  # composes the answer from the results
    # adds pictures of the results with `report.figures`, its last argument
    add_figures: Callable[[Suite, Results, ModuleType], None] | None = None
    needs: tuple[str, str] = ("", "")  # optional module, and the verdict where it is not installed

    def run(self, request: Request) -> Suite:
        """Make the study's suite: rows, tables, verdict, and figures if plotly is installed.

        Args:
            request: Options of the run.
        """
        suite = Suite(self.name, self.title, self.text)
        module, absence = self.needs
        if module and find_spec(module) is None:
            suite.verdict = absence
            return suite
        count = request.episodes or self.seeds[request.quick]
        results = self.measure(replace(request, episodes=count))
        self.add_tables(suite, results)
        suite.verdict = self.compose_verdict(results)
        if self.add_figures is not None and find_spec("plotly") is not None:
            self.add_figures(suite, results, import_module(".figures", __package__))
        return suite
