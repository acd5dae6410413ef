"""A verdict: a suite's answer in at most five lines of plain words, from its own numbers."""

import math
from collections.abc import Mapping, Sequence

from .stats import Estimate

LINES = 5
LETTERS = 110
"""Of a line with our names; a user's may make one longer."""
_NAMES = 2  # of those that tie
_SURE = 0.995  # a ratio below it is a lead, one above it none to a reader


def verdict(*lines: str) -> str:
    """The lines that are not empty, one below the other; ValueError for more than LINES."""
    found = [line for line in lines if line]
    if len(found) > LINES:
        raise ValueError(f"a verdict has at most {LINES} lines, got {len(found)}: {found}")
    return "\n".join(found)


def leader(name: str, over: Mapping[str, Estimate], verb: str) -> str:
    """Who is first, by how much before the next, or with whom it ties.

    over: what it has over each rival's, 1 for as much, the closest rival first. verb: what is
    better done little, "err". A rival ties whose interval all but reaches 1.

    >>> leader("lqr", {"esc": Estimate(0.71, 0.65, 0.77)}, "cost")
    'lqr costs least, 71 % [65, 77] as much as esc'
    >>> leader("lqr", {"esc": Estimate(0.98, 0.9, 1.05)}, "cost")
    'lqr and esc cost least, too close to tell apart'
    """
    ties = [rival for rival, ratio in over.items() if not ratio.high < _SURE]
    if ties:
        return f"{some([name, *ties])} {verb} least, too close to tell apart"
    second = [f", {percent(ratio)} as much as {rival}" for rival, ratio in over.items()]
    return f"{name} {verb}s least{''.join(second[:1])}"


def percent(ratio: Estimate) -> str:
    """A ratio in percent with its interval, if it has one.

    >>> percent(Estimate(0.71, 0.65, 0.77)), percent(Estimate(0.5))
    ('71 % [65, 77]', '50 %')
    """
    value, low, high = (f"{100.0 * each:.0f}" for each in ratio)
    return f"{value} % [{low}, {high}]" if math.isfinite(ratio.low) else f"{value} %"


def some(names: Sequence[str], most: int = _NAMES) -> str:
    """Names in a sentence, the later ones counted.

    >>> some(["a"]), some(["a", "b"]), some(["a", "b", "c", "d"])
    ('a', 'a and b', 'a, b and 2 more')
    """
    shown = list(names[:most])
    if len(names) > most:
        return f"{', '.join(shown)} and {len(names) - most} more"
    return " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]])) if shown else "nobody"
