"""What a comparison says: a sentence a contestant, a table, and what it does not say."""

import math

from ..control.cells import REFERENCE_FILTER
from ..control.contests import NOMINAL
from ..control.tables import Standing
from ..harness.results import ResultTable
from ..harness.stats import Estimate, geometric_mean
from ..harness.verdict import format_percent
from .compare import Comparison

_MAX_SENTENCES = 4  # contestants with a sentence


def compose_verdict(comparison: Comparison) -> list[str]:
    """At most five lines: the contestants, the best first, then how far to trust them."""
    labels = {entry.label for entry in comparison.request.entries}
    user_standings = [standing for standing in comparison.overall if standing.label in labels]
    places = {standing.label: place for place, standing in enumerate(comparison.overall, 1)}
    count = len(comparison.overall)
    lines = [
        f"Place {places[standing.label]} of {count}: {make_sentence(standing)}."
        for standing in user_standings[:_MAX_SENTENCES]
    ]
    if len(user_standings) > _MAX_SENTENCES:
        lines[-1] = f"{len(user_standings) - _MAX_SENTENCES + 1} more stand in the table."
    return [*lines, _describe_trust(comparison)]


def make_sentence(standing: Standing) -> str:
    """Where a contestant stands."""
    cost = standing.overall.get("cost_vs_nominal")
    errors = [f"{c.name}: {r.error}" for c, r in standing.results.items() if r.error]
    if cost is None or not math.isfinite(cost.value):
        yards = "nominal and oracle-state leave no episode to compare"
        return (
            f"{standing.label}: not driven: {errors[0]}" if errors else f"{standing.label}: {yards}"
        )
    names = dict.fromkeys(task.tier for task in standing.pairs)
    tiers = [f"tier {tier}: {100.0 * _compute_cost(standing, tier):.0f}" for tier in names if tier]
    failed = standing.overall["failure_rate"]
    nominal = [standing.scales[task].nominal for task in standing.drives if task in standing.scales]
    nominal_failures = sum(float((run["failure"] != 0.0).sum()) for run in nominal)
    episodes = sum(len(run.costs) for run in nominal)
    parts = [
        f"{format_percent(cost)} of nominal's cost"
        + (f" ({', '.join(tiers)})" if tiers[1:] else ""),
        f"wins {100.0 * standing.overall['share_won'].value:.0f} % of the episodes",
        f"fails in {100.0 * failed.value:.1f} % (nominal "
        f"{100.0 * nominal_failures / episodes:.1f} %)",
        _describe_gap(standing.overall["score"]),
    ]
    text = f"{standing.label}: {', '.join(parts)}"
    if errors:
        text += f"; not driven in {len(errors)} of {len(standing.results)} contests: {errors[0]}"
    return text


def _compute_cost(standing: Standing, tier: str) -> float:
    """Cost over nominal's in a tier."""
    logs = [-r for task, (r, _) in standing.pairs.items() if task.tier == tier]
    return geometric_mean(*logs).value


def _describe_gap(score: Estimate) -> str:
    """How much of the way from nominal to oracle-state."""
    if not math.isfinite(score.value):
        return "and nothing is to be won here"
    if score.low > 0.0:
        return f"closes {format_percent(score)} of the gap to oracle-state"
    if score.high < 0.0:
        return f"and is behind nominal (score {score.value:.2f}, oracle-state 1)"
    return f"and is not told apart from nominal (score {score.value:.2f}, oracle-state 1)"


def _describe_trust(comparison: Comparison) -> str:
    """On what the numbers rest, and what they do not say."""
    request = comparison.request
    n = len(request.seeds or range(request.episodes))
    count = len(comparison.tasks)
    where = f"{count} contest{'s' if count > 1 else ''} x {n} episodes"
    if request.fresh:
        files = ", ".join(path.name for path in request.files)
        return (
            f"Publishable: {where} on seeds drawn after {files} were hashed; --salt "
            f"{comparison.salt} "
            "repeats them. Everybody driven anew. Not said: other cars, manoeuvres and sensors."
        )
    whose = "the given" if request.salt else "the package's own"
    seeds = f"of {whose} salt {comparison.salt}" if comparison.salt else "of the caller's choice"
    rows = "on file, a sample driven again" if comparison.on_file else "driven now"
    return (
        f"Not publishable: {where} on seeds {seeds}, which a contestant can be tuned on; --fresh "
        f"draws new ones. Baselines {rows}. Not said: other cars, manoeuvres and sensors."
    )


def make_table(comparison: Comparison) -> ResultTable:
    """Everybody over all contests, the best first; the user's own are marked."""
    labels, cells = {entry.label for entry in comparison.request.entries}, []
    for standing in comparison.overall:
        numbers = [standing.overall.get(name) for name in ("cost_vs_nominal", "share_won", "score")]
        cost, won, score = (Estimate(math.nan) if n is None else n for n in numbers)
        cells.append(
            [
                f"> {standing.label}"
                if standing.label in labels
                else _label_baseline(standing.label),
                _format_text(cost, 100.0, ".0f"),
                _format_text(Estimate(won.value), 100.0, ".0f"),
                _format_text(Estimate(standing.overall["failure_rate"].value), 100.0, ".1f"),
                _format_text(score, 1.0, ".2f"),
                str(standing.n),
            ]
        )
    header = ("contestant", "cost, % [95 %]", "won, %", "fails, %", "score [95 %]", "episodes")
    note = (
        "> yours. Cost in percent of nominal's, the paired geometric mean of the episodes that "
        "nominal and oracle-state survive. won: cheaper than nominal. score: 0 nominal, an LQG "
        "that knows the nominal car, 1 oracle-state, which knows state and car."
    )
    return ResultTable("Your contestants and the package's", header, cells, note)


def _label_baseline(label: str) -> str:
    return f"{label} (lqr on {REFERENCE_FILTER})" if label == NOMINAL else label


def _format_text(number: Estimate, scale: float, digits: str) -> str:
    return number.inline(scale, digits) if math.isfinite(number.value) else ""
