"""Question: which claims of the five papers hold? Every claim, what was measured, its verdict, and
the papers' figures redrawn."""

from collections import Counter

from rich.console import Console

from ... import __version__
from ..harness.parallel import run_cases
from ..harness.results import VERDICTS, Row, Suite, Table
from ..harness.stats import Estimate
from ..harness.verdict import some
from ..harness.verdict import verdict as lines
from .claims import CLAIMS, FIGURES, SIMULATIONS
from .ledger.claim import Claim, Found, Measured, Results, find, verdict
from .ledger.simulations import joined

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
Ledger = list[tuple[Claim, tuple[Found, ...]]]


def measure(case: Case) -> Measured:
    """One simulation on a few of its seeds."""
    name, seeds = case
    return SIMULATIONS[name].measure(seeds)


def run(seeds: int = SEEDS, jobs: int | None = None, console: Console | None = None) -> Suite:
    """Every simulation once, then every claim on what it gave."""
    results = simulate(seeds, jobs, console)
    ledger = [(claim, find(claim, results)) for claim in CLAIMS]
    suite = Suite(NAME, "Which claims of the papers hold", _TEXT)
    suite.verdict = answer(ledger)
    suite.tables = [_verdicts(ledger), _notes(ledger)]
    suite.tables += [_numbers(ledger, paper) for paper in dict.fromkeys(c.paper for c in CLAIMS)]
    suite.rows = [_row(claim, each, verdict(found)) for claim, found in ledger for each in found]
    _draw(suite, results)
    return suite


def answer(ledger: Ledger) -> str:
    """The verdict: how many claims hold, which do not."""
    judged = [(claim, verdict(found)) for claim, found in ledger]
    counted = Counter(each for _, each in judged)
    papers = dict.fromkeys(claim.paper for claim, _ in judged)
    whole = {
        paper: [each for claim, each in judged if claim.paper == paper and each != VERDICTS[-1]]
        for paper in papers
    }
    held = [f"{p} {mine.count(VERDICTS[1])} of {len(mine)}" for p, mine in whole.items() if mine]
    failed = [_where(claim) for claim, each in judged if each == "not reproduced"]
    missed = sum(each.threshold_met is False for _, found in ledger for each in found)
    counts = ", ".join(f"{counted[name]} {name}" for name in VERDICTS if counted[name])
    return lines(
        f"{len(ledger)} claims of {len(papers)} papers: {counts}.",
        f"Reproduced: {'; '.join(held)}.",
        f"Not reproduced: {some(failed, 3)}. Reasons stand in the table Why." if failed else "",
        f"{missed} of our own thresholds are missed." if missed else "All our thresholds are met.",
        "Not covered: the papers' own noise and tuning, which none of them prints.",
    )


def simulate(seeds: int, jobs: int | None = None, console: Console | None = None) -> Results:
    """The results of every simulation and analysis, by name."""
    cases = [(name, chunk) for name, each in SIMULATIONS.items() for chunk in each.chunks(seeds)]
    parts: dict[str, list[Measured]] = {name: [] for name in SIMULATIONS}
    done = run_cases(measure, cases, NAME, jobs, console)
    for (name, _), measured in zip(cases, done, strict=True):
        parts[name].append(measured)
    return {name: joined(chunks) for name, chunks in parts.items()}


def _verdicts(ledger: Ledger) -> Table:
    """One line a claim."""
    cells = [[_where(claim), claim.text, verdict(found), _met(found)] for claim, found in ledger]
    return Table(
        "The claims and what became of them",
        ("paper", "claim", "verdict", "thresholds"),
        cells,
        keyed=False,
    )


def _numbers(ledger: Ledger, paper: str) -> Table:
    """One line a part of a paper's claims."""
    cells = [
        [f"{claim.source}: {each.part.label}", _spread(each), _stated(each), _checked(each)]
        for claim, found in ledger
        for each in found
        if claim.paper == paper
    ]
    return Table(
        f"{paper}: what was measured",
        ("number", "median [range]", "paper states", "threshold"),
        cells,
        "The range is over seeds, tunings or speeds; behind what the paper states stands the share "
        "of them in which it is so.",
        keyed=False,
    )


def _notes(ledger: Ledger) -> Table:
    """Remarks on some claims."""
    cells = [[_where(claim), claim.note] for claim, _ in ledger if claim.note]
    return Table("Why", ("paper", "what was found"), cells, keyed=False)


def _where(claim: Claim) -> str:
    return f"{claim.paper} {claim.source}"


def _spread(found: Found) -> str:
    if found.low == found.high:
        return _text(found.median)
    return f"{_text(found.median)} [{_text(found.low)}, {_text(found.high)}]"


def _text(value: float) -> str:
    """Three digits; of rounding errors the order of magnitude is enough."""
    return f"{value:.0e}" if 0.0 < abs(value) < 1e-6 else f"{value:.3g}"


def _stated(found: Found) -> str:
    stated = found.part.stated
    return "" if stated is None else f"{stated} ({100.0 * found.agreeing:.0f} %)"


def _checked(found: Found) -> str:
    met = {True: "met", False: "MISSED"}
    return (
        "" if found.threshold_met is None else f"{found.part.threshold} {met[found.threshold_met]}"
    )


def _met(found: tuple[Found, ...]) -> str:
    """Whether a claim's thresholds are met, or how many are not."""
    checked = [each.threshold_met for each in found if each.threshold_met is not None]
    if not checked:
        return ""
    return "met" if all(checked) else f"{checked.count(False)} of {len(checked)} MISSED"


def _row(claim: Claim, found: Found, judged: str) -> Row:
    """low and high are the range over the seeds."""
    number = Estimate(found.median, found.low, found.high)
    where = {"suite": NAME, "scenario": found.part.scenario, "estimator": found.part.label}
    paper = f"{_where(claim)}: {claim.text}"
    common = {"salt": "fixed", "env_version": __version__, "verdict": judged, "paper": paper}
    return Row.of(found.part.metric, number, n=len(found.values), **where, **common)


def _draw(suite: Suite, results: Results) -> None:
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
