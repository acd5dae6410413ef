"""What a comparison says: a sentence a contestant, a table, and what it does not say."""

import math

from ..control.cells import REFERENCE_FILTER
from ..control.contests import NOMINAL
from ..control.tables import Standing
from ..harness.results import Table
from ..harness.stats import Estimate, geometric_mean
from ..harness.verdict import percent
from .compare import Comparison

_MOST = 4  # contestants with a sentence


def verdict(found: Comparison) -> list[str]:
    """At most five lines: the contestants, the best first, then how far to trust them."""
    mine = {pair.label for pair in found.challenge.pairs}
    own = [each for each in found.overall if each.label in mine]
    places = {each.label: place for place, each in enumerate(found.overall, 1)}
    of = len(found.overall)
    lines = [f"Place {places[each.label]} of {of}: {sentence(each)}." for each in own[:_MOST]]
    if len(own) > _MOST:
        lines[-1] = f"{len(own) - _MOST + 1} more stand in the table."
    return [*lines, _trust(found)]


def sentence(each: Standing) -> str:
    """Where a contestant stands."""
    cost = each.overall.get("cost_vs_nominal")
    errors = [f"{c.name}: {r.error}" for c, r in each.results.items() if r.error]
    if cost is None or not math.isfinite(cost.value):
        yards = "nominal and oracle-state leave no episode to compare"
        return f"{each.label}: not driven: {errors[0]}" if errors else f"{each.label}: {yards}"
    names = dict.fromkeys(contest.tier for contest in each.pairs)
    tiers = [f"tier {tier}: {100.0 * _cost(each, tier):.0f}" for tier in names if tier]
    failed = each.overall["failure_rate"]
    nominal = [each.yards[contest].nominal for contest in each.driven if contest in each.yards]
    theirs = sum(float((run["failure"] != 0.0).sum()) for run in nominal)
    episodes = sum(len(run.costs) for run in nominal)
    parts = [
        f"{percent(cost)} of nominal's cost" + (f" ({', '.join(tiers)})" if tiers[1:] else ""),
        f"wins {100.0 * each.overall['share_won'].value:.0f} % of the episodes",
        f"fails in {100.0 * failed.value:.1f} % (nominal {100.0 * theirs / episodes:.1f} %)",
        _gap(each.overall["score"]),
    ]
    text = f"{each.label}: {', '.join(parts)}"
    if errors:
        text += f"; not driven in {len(errors)} of {len(each.results)} contests: {errors[0]}"
    return text


def _cost(each: Standing, tier: str) -> float:
    """Cost over nominal's in a tier."""
    logs = [-r for contest, (r, _) in each.pairs.items() if contest.tier == tier]
    return geometric_mean(*logs).value


def _gap(score: Estimate) -> str:
    """How much of the way from nominal to oracle-state."""
    if not math.isfinite(score.value):
        return "and nothing is to be won here"
    if score.low > 0.0:
        return f"closes {percent(score)} of the gap to oracle-state"
    if score.high < 0.0:
        return f"and is behind nominal (score {score.value:.2f}, oracle-state 1)"
    return f"and is not told apart from nominal (score {score.value:.2f}, oracle-state 1)"


def _trust(found: Comparison) -> str:
    """On what the numbers rest, and what they do not say."""
    challenge = found.challenge
    n = len(challenge.seeds or range(challenge.episodes))
    count = len(found.contests)
    where = f"{count} contest{'s' if count > 1 else ''} x {n} episodes"
    if challenge.fresh:
        files = ", ".join(path.name for path in challenge.files)
        return (
            f"Publishable: {where} on seeds drawn after {files} were hashed; --salt {found.salt} "
            "repeats them. Everybody driven anew. Not said: other cars, manoeuvres and sensors."
        )
    whose = "the given" if challenge.salt else "the package's own"
    seeds = f"of {whose} salt {found.salt}" if found.salt else "of the caller's choice"
    rows = "on file, a sample driven again" if found.on_file else "driven now"
    return (
        f"Not publishable: {where} on seeds {seeds}, which a contestant can be tuned on; --fresh "
        f"draws new ones. Baselines {rows}. Not said: other cars, manoeuvres and sensors."
    )


def table(found: Comparison) -> Table:
    """Everybody over all contests, the best first; the user's own are marked."""
    mine, cells = {pair.label for pair in found.challenge.pairs}, []
    for each in found.overall:
        numbers = [each.overall.get(name) for name in ("cost_vs_nominal", "share_won", "score")]
        cost, won, score = (Estimate(math.nan) if n is None else n for n in numbers)
        cells.append(
            [
                f"> {each.label}" if each.label in mine else _baseline(each.label),
                _text(cost, 100.0, ".0f"),
                _text(Estimate(won.value), 100.0, ".0f"),
                _text(Estimate(each.overall["failure_rate"].value), 100.0, ".1f"),
                _text(score, 1.0, ".2f"),
                str(each.n),
            ]
        )
    header = ("contestant", "cost, % [95 %]", "won, %", "fails, %", "score [95 %]", "episodes")
    note = (
        "> yours. Cost in percent of nominal's, the paired geometric mean of the episodes that "
        "nominal and oracle-state survive. won: cheaper than nominal. score: 0 nominal, an LQG "
        "that knows the nominal car, 1 oracle-state, which knows state and car."
    )
    return Table("Your contestants and the package's", header, cells, note)


def _baseline(label: str) -> str:
    return f"{label} (lqr on {REFERENCE_FILTER})" if label == NOMINAL else label


def _text(number: Estimate, scale: float, digits: str) -> str:
    return number.inline(scale, digits) if math.isfinite(number.value) else ""
