"""The skeleton of a suite: a study is data, and every study is run in the same way; its verdict.

Lines of a table are records, as of a DataFrame. A verdict is a suite's answer in at most five lines
of plain words, from its own numbers.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Generic, TypeVar

from rich.console import Console

from ..harness.parallel import run_cases
from ..harness.results import Suite
from ..harness.stats import Estimate

LINES, LETTERS = 5, 110  # lines of a verdict, letters of a line with the package's names
MAX_NIS = 3.0  # mean squared innovation over its variance, beyond which a filter is lost
_MIN_TIE = 0.995  # a ratio below it is a lead

Case = TypeVar("Case")
Condition = TypeVar("Condition")
Result = TypeVar("Result")
Results = TypeVar("Results")


@dataclass(frozen=True, kw_only=True)
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
        seeds: int | Sequence[int],
        chunk: int,
        title: str,
    ) -> list[list[Result]]:
        """Run a function that gives a result a seed in every condition.

        Args:
            function: Function of a condition and some seeds, importable by workers.
            conditions: Conditions; each has the seeds 0 .. seeds-1.
            seeds: Number of seeds, of all or of each.
            chunk: Maximum of seeds in a call.
            title: Title of the progress bar.
        """
        counts = [seeds] * len(conditions) if isinstance(seeds, int) else seeds
        chunks = [[range(k, min(k + chunk, n)) for k in range(0, n, chunk)] for n in counts]
        cases = [(x, part) for x, parts in zip(conditions, chunks, strict=True) for part in parts]
        results = iter(self.run_cases(function, cases, title))
        return [[item for _ in parts for item in next(results)] for parts in chunks]


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


def format_verdict(*lines: str) -> str:
    """Join the lines of a verdict; ValueError for more than LINES of them.

    Args:
        lines: Lines, of which empty ones are left out.
    """
    filled = [line for line in lines if line]
    if len(filled) > LINES:
        raise ValueError(f"a verdict has at most {LINES} lines, got {len(filled)}: {filled}")
    return "\n".join(filled)


def describe_leader(name: str, ratios: Mapping[str, Estimate], verb: str) -> str:
    """Describe the first entry and its lead, or those that it ties with.

    A rival ties where the ratio's interval reaches 1, or nearly.

    Args:
        name: Name of the first.
        ratios: Its number over each rival's, the closest rival first.
        verb: Verb for what is better done little, such as "err".

    >>> describe_leader("lqr", {"esc": Estimate(0.71, 0.65, 0.77)}, "cost")
    'lqr costs least, 71 % [65, 77] as much as esc'
    >>> describe_leader("lqr", {"esc": Estimate(0.98, 0.9, 1.05)}, "cost")
    'lqr and esc cost least, too close to tell apart'
    """
    ties = [rival for rival, ratio in ratios.items() if not ratio.high < _MIN_TIE]
    if ties:
        return f"{summarise_names([name, *ties])} {verb} least, too close to tell apart"
    second = [f", {format_percent(ratio)} as much as {rival}" for rival, ratio in ratios.items()]
    return f"{name} {verb}s least{''.join(second[:1])}"


def describe_innovations(nis: Mapping[str, float]) -> str:
    """Describe whether slow samples surprise each filter as it expects; "" without innovations.

    Args:
        nis: Mean squared innovation over its variance, of a value of a packet, by filter.
    """
    lost = [f"{name} ({mean:.1f})" for name, mean in nis.items() if mean > MAX_NIS]
    if not nis:
        return ""
    judged = "nobody is lost" if not lost else f"do not believe {', '.join(lost)}"
    return f"By squared innovations over their variance, which should be 1: {judged}."


def format_percent(ratio: Estimate) -> str:
    """Format a ratio in percent with its interval, if it has one.

    Args:
        ratio: Ratio and bounds of its interval.

    >>> format_percent(Estimate(0.71, 0.65, 0.77)), format_percent(Estimate(0.5))
    ('71 % [65, 77]', '50 %')
    """
    value, low, high = (f"{100.0 * number:.0f}" for number in ratio)
    return f"{value} % [{low}, {high}]" if math.isfinite(ratio.low) else f"{value} %"


def summarise_names(names: Sequence[str], limit: int = 2) -> str:
    """Join names for a sentence; of many the later ones are counted.

    Args:
        names: Names in the order of the sentence.
        limit: Number of names up to which none is counted.

    >>> summarise_names(["a"]), summarise_names(["a", "b"]), summarise_names(["a", "b", "c", "d"])
    ('a', 'a and b', 'a, b and 2 more')
    """
    shown = list(names[:limit])
    if len(names) > limit:
        return f"{', '.join(shown)} and {len(names) - limit} more"
    return " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]])) if shown else "nobody"
