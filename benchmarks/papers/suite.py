"""Which claims of the five papers hold? Each with what was measured, and its verdict."""

from collections import Counter
from itertools import product
from types import ModuleType

from ..harness.results import VERDICTS, Column, Line, ResultTable, Suite
from ..report.study import Request, Study, format_verdict, summarise_names
from . import dakf_stability, double_layer, dual_rate, tie_vision, tie_vision_theory, uneven_delay
from .ledger import (
    CHUNK,
    Claim,
    MeasuredClaim,
    MeasuredPart,
    SeedResult,
    Simulation,
    join_numbers,
    run_simulation,
)

_MODULES = (tie_vision, tie_vision_theory, uneven_delay, double_layer, dual_rate, dakf_stability)

SIMULATIONS: dict[str, Simulation] = {x.name: x for y in _MODULES for x in y.SIMULATIONS}
CLAIMS: list[tuple[str, Claim]] = [(y.PAPER, x) for y in _MODULES for x in y.CLAIMS]

NAME = "papers"

_TEXT = (
    "The five papers' claims, each measured on the paper's own simulation or worked out exactly. "
    "A part of a claim is one number a seed. `reproduced`: all parts are as the paper states, each "
    "in nine of ten seeds. `not reproduced`: no part is, even in the median over the seeds. "
    "`partly`: anything between. `report only`: the paper states nothing that could be false. "
    "Thresholds are what an honest implementation reaches; the median "
    "has to meet them. No paper prints its noise or its tuning: both are ours, and filters are "
    "tuned on other seeds than these. A twin is a road test's simulation with everything that the "
    "plant has: Fiala tyres, lags, roll, wandering HDOP."
)


LedgerResults = tuple[list[MeasuredClaim], dict[str, SeedResult]]  # the first seeds' by simulation


def _measure(request: Request) -> LedgerResults:
    seeds = request.episodes or 0
    counts = [max(1, round(x.share * seeds)) for x in SIMULATIONS.values()]
    runs = request.run_seeds(run_simulation, list(SIMULATIONS.values()), counts, CHUNK, NAME)
    by_name = dict(zip(SIMULATIONS, runs, strict=True))
    results = {name: join_numbers(run) for name, run in by_name.items()}
    ledger = [
        MeasuredClaim(paper, claim, [part.measure(results) for part in claim.parts])
        for paper, claim in CLAIMS
    ]
    return ledger, {name: run[0] for name, run in by_name.items()}


def _compose_verdict(results: LedgerResults) -> str:
    ledger, _ = results
    counted = Counter(entry.verdict for entry in ledger)
    papers = dict.fromkeys(entry.paper for entry in ledger)
    held = []
    for paper in papers:
        items = [entry.verdict for entry in ledger if entry.paper == paper]
        if stated := [item for item in items if item != VERDICTS[-1]]:
            held.append(f"{paper} {stated.count(VERDICTS[1])} of {len(stated)}")
    failed = [entry.source for entry in ledger if entry.verdict == "not reproduced"]
    missed = sum(item.meets_threshold is False for entry in ledger for item in entry.parts)
    counts = ", ".join(f"{counted[name]} {name}" for name in VERDICTS if counted[name])
    reasons = f"Not reproduced: {summarise_names(failed, 3)}. Reasons stand in the table Why."
    return format_verdict(
        f"{len(ledger)} claims of {len(papers)} papers: {counts}.",
        f"Reproduced: {'; '.join(held)}.",
        reasons if failed else "",
        f"{missed} of our own thresholds are missed." if missed else "All our thresholds are met.",
        "Not covered: the papers' own noise and tuning, which none of them prints.",
    )


_RANGE_NOTE = (
    "The range is over seeds, tunings or speeds; behind what the paper states stands the share "
    "of them in which it is so."
)


def _add_tables(suite: Suite, results: LedgerResults) -> None:
    verdicts, remarks, numbers = [], [], dict[str, list[Line]]()
    for entry in results[0]:
        claim = entry.claim
        columns = {"verdict": entry.verdict, "paper": f"{entry.source}: {claim.text}"}
        for item in entry.parts:
            record = {"scenario": item.part.scenario, "estimator": item.part.label, **columns}
            suite.add_rows([{**record, "n": len(item.values), item.part.metric: item.number}])
        met = [x.meets_threshold for x in entry.parts if x.meets_threshold is not None]
        missed = f"{met.count(False)} of {len(met)} MISSED"
        checks = missed if False in met else "met" if met else ""
        verdicts.append([entry.source, claim.text, entry.verdict, checks])
        remarks += [[entry.source, claim.note]] if claim.note else []
        lines = [_make_line(claim.source, item) for item in entry.parts]
        numbers.setdefault(entry.paper, []).extend(lines)
    title = "The claims and what became of them"
    header = ("paper", "claim", "verdict", "thresholds")
    suite.tables.append(ResultTable(title, header, verdicts, keyed=False))
    suite.tables.append(ResultTable("Why", ("paper", "what was found"), remarks, keyed=False))
    heads = ("number", Column("median [range]", form=".3g"), "paper states", "threshold")
    for paper, lines in numbers.items():
        title = f"{paper}: what was measured"
        suite.tables.append(ResultTable(title, heads, lines, _RANGE_NOTE, keyed=False))


def _make_line(source: str, item: MeasuredPart) -> Line:
    part, number = item.part, item.number
    met = "met" if item.meets_threshold else "MISSED"
    return {
        "number": f"{source}: {part.label}",
        "median [range]": number if number.low < number.high else number.value,
        "paper states": part.stated and f"{part.stated} ({100.0 * item.agreement:.0f} %)",
        "threshold": part.threshold and f"{part.threshold} {met}",
    }


_SIGNALS = {"beta": "sideslip angle / rad", "yaw_moment": "yaw moment / (N m)"}


def _add_figures(suite: Suite, results: LedgerResults, draw: ModuleType) -> None:
    """Draw the signals of the first seed of each simulation."""
    for (name, first), (signal, label) in product(results[1].items(), _SIGNALS.items()):
        curves = first.curves.items()
        if series := {subject: x[signal] for subject, x in curves if signal in x}:
            figure = draw.draw_time_series(first.time, series, label)
            suite.figures.append((f"{name}: {label.partition(' /')[0]}", figure, ""))


STUDY = Study(
    NAME, "Which claims of the papers hold", _TEXT, (20, 4),
    _measure, _add_tables, _compose_verdict, _add_figures,
)  # fmt: skip
