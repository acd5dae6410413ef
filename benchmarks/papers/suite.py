"""Which claims of the five papers hold? Each claim, what was measured and its verdict; the figures.

Each paper has one to three modules with its simulations, claims and figures, which are data.
"""

from collections import Counter

from rich.console import Console

from ..harness.parallel import run_cases
from ..harness.results import VERDICTS, ResultTable, Suite
from ..harness.verdict import format_verdict, summarise_names
from ..report.study import add_rows, import_figures
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
    tie_vision, tie_vision_control, tie_vision_convergence, uneven_delay, double_layer, dual_rate,
    theory, dakf_stability,
)  # fmt: skip

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
    """Measure one simulation on a few of its seeds.

    Args:
        case: Name and seeds.

    Returns:
        Numbers of the seeds.
    """
    name, seeds = case
    return SIMULATIONS[name].measure(seeds)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Run every simulation once, then evaluate every claim.

    Args:
        seeds: Number of seeds.
        jobs: Number of processes; None: one a core.
        console: Console for the progress.

    Returns:
        The suite.
    """
    results = _simulate(seeds, jobs, console)
    ledger = [(claim, measure_parts(claim, results)) for claim in CLAIMS]
    suite = Suite(NAME, "Which claims of the papers hold", _TEXT)
    suite.verdict = compose_verdict(ledger)
    suite.tables = [_make_verdict_table(ledger), _make_note_table(ledger)]
    for paper in dict.fromkeys(claim.paper for claim in CLAIMS):
        suite.tables.append(_make_number_table(ledger, paper))
    for claim, parts in ledger:
        columns = {"verdict": evaluate_claim(parts)}
        columns["paper"] = f"{_format_source(claim)}: {claim.text}"
        for result in parts:
            part, n = result.part, len(result.values)
            where = {"scenario": part.scenario, "estimator": part.label}
            add_rows(suite, {part.metric: result.number}, n=n, **where, **columns)
    if import_figures() is None:
        return suite
    for figure in FIGURES:
        if (example := results[figure.scenario].example) is not None:
            title = f"{figure.paper} {figure.title}"
            suite.figures.append((title, figure.draw(example), figure.caption))
    return suite


def compose_verdict(ledger: Ledger) -> str:
    """Compose the verdict: how many claims hold, which do not.

    Args:
        ledger: Claims with their measured parts.

    Returns:
        Verdict.
    """
    verdicts = [(claim, evaluate_claim(parts)) for claim, parts in ledger]
    counted = Counter(item for _, item in verdicts)
    papers = dict.fromkeys(claim.paper for claim, _ in verdicts)
    held = []
    for paper in papers:
        items = [x for claim, x in verdicts if claim.paper == paper and x != VERDICTS[-1]]
        if items:
            held.append(f"{paper} {items.count(VERDICTS[1])} of {len(items)}")
    failed = [_format_source(claim) for claim, item in verdicts if item == "not reproduced"]
    missed = sum(item.meets_threshold is False for _, parts in ledger for item in parts)
    counts = ", ".join(f"{counted[name]} {name}" for name in VERDICTS if counted[name])
    reasons = f"Not reproduced: {summarise_names(failed, 3)}. Reasons stand in the table Why."
    return format_verdict(
        f"{len(ledger)} claims of {len(papers)} papers: {counts}.",
        f"Reproduced: {'; '.join(held)}.",
        reasons if failed else "",
        f"{missed} of our own thresholds are missed." if missed else "All our thresholds are met.",
        "Not covered: the papers' own noise and tuning, which none of them prints.",
    )


def _simulate(seeds: int, jobs: int | None, console: Console | None) -> Results:
    """Run every simulation and analysis; return the results by name."""
    cases = [(name, chunk) for name, x in SIMULATIONS.items() for chunk in x.split(seeds)]
    parts: dict[str, list[SimulationResult]] = {name: [] for name in SIMULATIONS}
    for (name, _), result in zip(
        cases, run_cases(measure, cases, NAME, jobs, console), strict=True
    ):
        parts[name].append(result)
    return {name: join_results(chunks) for name, chunks in parts.items()}


def _make_verdict_table(ledger: Ledger) -> ResultTable:
    """Make the table of verdicts, one line a claim."""
    cells = [
        [_format_source(claim), claim.text, evaluate_claim(parts), _format_checks(parts)]
        for claim, parts in ledger
    ]
    header = ("paper", "claim", "verdict", "thresholds")
    return ResultTable("The claims and what became of them", header, cells, keyed=False)


def _make_number_table(ledger: Ledger, paper: str) -> ResultTable:
    """Make the table of numbers, one line a part of a paper's claims."""
    cells = []
    for source, result in ((c.source, r) for c, parts in ledger if c.paper == paper for r in parts):
        label, part = f"{source}: {result.part.label}", result.part
        share = f" ({100.0 * result.agreement:.0f} %)"
        stated = "" if part.stated is None else f"{part.stated}{share}"
        met = "met" if result.meets_threshold else "MISSED"
        check = "" if part.threshold is None else f"{part.threshold} {met}"
        cells.append([label, _format_range(result), stated, check])
    header = ("number", "median [range]", "paper states", "threshold")
    note = (
        "The range is over seeds, tunings or speeds; behind what the paper states stands the share "
        "of them in which it is so."
    )
    return ResultTable(f"{paper}: what was measured", header, cells, note, keyed=False)


def _make_note_table(ledger: Ledger) -> ResultTable:
    """Make the table of remarks on claims."""
    cells = [[_format_source(claim), claim.note] for claim, _ in ledger if claim.note]
    return ResultTable("Why", ("paper", "what was found"), cells, keyed=False)


def _format_source(claim: Claim) -> str:
    return f"{claim.paper} {claim.source}"


def _format_range(result: MeasuredPart) -> str:
    median, low, high = map(_format_number, result.number)
    return median if result.number.low == result.number.high else f"{median} [{low}, {high}]"


def _format_number(value: float) -> str:
    """Format three digits; of rounding errors the order of magnitude is enough."""
    return f"{value:.0e}" if 0.0 < abs(value) < 1e-6 else f"{value:.3g}"


def _format_checks(parts: tuple[MeasuredPart, ...]) -> str:
    """Format whether a claim's thresholds are met, or how many are not."""
    checked = [result.meets_threshold for result in parts if result.meets_threshold is not None]
    if not checked:
        return ""
    return "met" if all(checked) else f"{checked.count(False)} of {len(checked)} MISSED"
