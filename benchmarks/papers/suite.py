"""The papers' claims: one or two modules a paper, with its simulations, claims and figures.

Question: which claims of the five papers hold? Every claim, what was measured, its verdict, and
the papers' figures redrawn.
"""

from collections import Counter

from rich.console import Console

from ... import __version__
from ..harness.parallel import run_cases
from ..harness.results import VERDICTS, ResultRow, ResultTable, Suite
from ..harness.stats import Estimate
from ..harness.study import format_verdict as format_verdict
from ..harness.study import summarise_names
from . import dakf_stability, double_layer, dual_rate, theory, tie_vision_control, uneven_delay
from . import tie_vision_estimation as tie_vision
from . import tie_vision_theory as tie_vision_convergence
from .ledger import (
    Claim,
    MeasuredPart,
    Results,
    Simulation,
    SimulationResult,
    evaluate_claim,
    join_results,
    measure_parts,
)
from .manoeuvres import PaperFigure

_MODULES = (
    tie_vision,
    tie_vision_control,
    tie_vision_convergence,
    uneven_delay,
    double_layer,
    dual_rate,
    theory,
    dakf_stability,
)

SIMULATIONS: dict[str, Simulation] = {
    simulation.name: simulation for module in _MODULES for simulation in module.SIMULATIONS
}
CLAIMS: tuple[Claim, ...] = tuple(claim for module in _MODULES for claim in module.CLAIMS)
FIGURES: tuple[PaperFigure, ...] = tuple(f for module in _MODULES for f in module.FIGURES)


SEEDS = 20
QUICK_SEEDS = 4
NAME = "papers"

_TEXT = (
    "The five papers' claims, each measured on the paper's own simulation or worked out exactly. "
    "A part of a claim is one number a seed. `reproduced`: all parts are as the paper states, each "
    "in nine of ten seeds. `not reproduced`: no part is, even in the median over the seeds. "
    "`partly`: anything between. `report only`: the paper states nothing that could be false. "
    "Thresholds are what an honest implementation reaches (docs/PAPERS.md section 3); the median "
    "has to meet them. No paper prints its noise or its tuning: both are ours, and filters are "
    "tuned on other seeds than these. A twin is a road test's simulation with everything that the "
    "plant has: Fiala tyres, lags, roll, wandering HDOP."
)

Case = tuple[str, tuple[int, ...]]
Ledger = list[tuple[Claim, tuple[MeasuredPart, ...]]]


def measure(case: Case) -> SimulationResult:
    """One simulation on a few of its seeds."""
    name, seeds = case
    return SIMULATIONS[name].measure(seeds)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Every simulation once, then every claim on what it gave."""
    results = simulate(seeds, jobs, console)
    ledger = [(claim, measure_parts(claim, results)) for claim in CLAIMS]
    suite = Suite(NAME, "Which claims of the papers hold", _TEXT)
    suite.verdict = compose_verdict(ledger)
    suite.tables = [_make_verdict_table(ledger), _make_note_table(ledger)]
    suite.tables += [
        _make_number_table(ledger, paper) for paper in dict.fromkeys(c.paper for c in CLAIMS)
    ]
    suite.rows = [
        _make_row(claim, result, evaluate_claim(parts))
        for claim, parts in ledger
        for result in parts
    ]
    _draw_figures(suite, results)
    return suite


def compose_verdict(ledger: Ledger) -> str:
    """The verdict: how many claims hold, which do not."""
    verdicts = [(claim, evaluate_claim(parts)) for claim, parts in ledger]
    counted = Counter(item for _, item in verdicts)
    papers = dict.fromkeys(claim.paper for claim, _ in verdicts)
    whole = {
        paper: [item for claim, item in verdicts if claim.paper == paper and item != VERDICTS[-1]]
        for paper in papers
    }
    held = [
        f"{p} {paper_verdicts.count(VERDICTS[1])} of {len(paper_verdicts)}"
        for p, paper_verdicts in whole.items()
        if paper_verdicts
    ]
    failed = [_format_source(claim) for claim, item in verdicts if item == "not reproduced"]
    missed = sum(item.meets_threshold is False for _, parts in ledger for item in parts)
    counts = ", ".join(f"{counted[name]} {name}" for name in VERDICTS if counted[name])
    return format_verdict(
        f"{len(ledger)} claims of {len(papers)} papers: {counts}.",
        f"Reproduced: {'; '.join(held)}.",
        f"Not reproduced: {summarise_names(failed, 3)}. Reasons stand in the table Why."
        if failed
        else "",
        f"{missed} of our own thresholds are missed." if missed else "All our thresholds are met.",
        "Not covered: the papers' own noise and tuning, which none of them prints.",
    )


def simulate(seeds: int, jobs: int | None = None, console: Console | None = None) -> Results:
    """The results of every simulation and analysis, by name."""
    cases = [
        (name, chunk)
        for name, simulation in SIMULATIONS.items()
        for chunk in simulation.chunks(seeds)
    ]
    parts: dict[str, list[SimulationResult]] = {name: [] for name in SIMULATIONS}
    done = run_cases(measure, cases, NAME, jobs, console)
    for (name, _), measured in zip(cases, done, strict=True):
        parts[name].append(measured)
    return {name: join_results(chunks) for name, chunks in parts.items()}


def _make_verdict_table(ledger: Ledger) -> ResultTable:
    """One line a claim."""
    cells = [
        [_format_source(claim), claim.text, evaluate_claim(parts), _format_checks(parts)]
        for claim, parts in ledger
    ]
    return ResultTable(
        "The claims and what became of them",
        ("paper", "claim", "verdict", "thresholds"),
        cells,
        keyed=False,
    )


def _make_number_table(ledger: Ledger, paper: str) -> ResultTable:
    """One line a part of a paper's claims."""
    cells = [
        [
            f"{claim.source}: {result.part.label}",
            _format_range(result),
            _format_stated(result),
            _format_check(result),
        ]
        for claim, parts in ledger
        for result in parts
        if claim.paper == paper
    ]
    return ResultTable(
        f"{paper}: what was measured",
        ("number", "median [range]", "paper states", "threshold"),
        cells,
        "The range is over seeds, tunings or speeds; behind what the paper states stands the share "
        "of them in which it is so.",
        keyed=False,
    )


def _make_note_table(ledger: Ledger) -> ResultTable:
    """Remarks on some claims."""
    cells = [[_format_source(claim), claim.note] for claim, _ in ledger if claim.note]
    return ResultTable("Why", ("paper", "what was found"), cells, keyed=False)


def _format_source(claim: Claim) -> str:
    return f"{claim.paper} {claim.source}"


def _format_range(result: MeasuredPart) -> str:
    if result.low == result.high:
        return _format_number(result.median)
    median, low, high = map(_format_number, (result.median, result.low, result.high))
    return f"{median} [{low}, {high}]"


def _format_number(value: float) -> str:
    """Three digits; of rounding errors the order of magnitude is enough."""
    return f"{value:.0e}" if 0.0 < abs(value) < 1e-6 else f"{value:.3g}"


def _format_stated(result: MeasuredPart) -> str:
    stated = result.part.stated
    return "" if stated is None else f"{stated} ({100.0 * result.agreement:.0f} %)"


def _format_check(result: MeasuredPart) -> str:
    met = {True: "met", False: "MISSED"}
    return (
        ""
        if result.meets_threshold is None
        else f"{result.part.threshold} {met[result.meets_threshold]}"
    )


def _format_checks(parts: tuple[MeasuredPart, ...]) -> str:
    """Whether a claim's thresholds are met, or how many are not."""
    checked = [result.meets_threshold for result in parts if result.meets_threshold is not None]
    if not checked:
        return ""
    return "met" if all(checked) else f"{checked.count(False)} of {len(checked)} MISSED"


def _make_row(claim: Claim, result: MeasuredPart, judged: str) -> ResultRow:
    """low and high are the range over the seeds."""
    number = Estimate(result.median, result.low, result.high)
    where = {"suite": NAME, "scenario": result.part.scenario, "estimator": result.part.label}
    paper = f"{_format_source(claim)}: {claim.text}"
    common = {"salt": "fixed", "env_version": __version__, "verdict": judged, "paper": paper}
    return ResultRow.from_estimate(
        result.part.metric, number, n=len(result.values), **where, **common
    )


def _draw_figures(suite: Suite, results: Results) -> None:
    """The papers' figures; nothing where plotly is not installed."""
    try:
        from ..report import figures  # noqa: F401
    except ModuleNotFoundError:
        return
    for figure in FIGURES:
        example = results[figure.scenario].example
        if example is not None:
            title = f"{figure.paper} {figure.title}"
            suite.figures.append((title, figure.draw(example), figure.caption))
