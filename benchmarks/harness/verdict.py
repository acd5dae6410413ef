"""A verdict: a suite's answer in at most five lines of plain words, from its own numbers."""

import math
from collections.abc import Mapping, Sequence

from .stats import Estimate

LINES = 5
LETTERS = 110
"""Letters of a line with the package's names; a user's may make one longer."""
_NAMES = 2  # of those that tie
_SURE = 0.995  # a ratio below it is a lead, one above it none to a reader


def format_verdict(*lines: str) -> str:
    """Join the lines that are not empty.

    Args:
        lines: Lines, of which at most LINES are not empty.

    Returns:
        Text of the lines.

    Raises:
        ValueError: There are more lines.
    """
    filled = [line for line in lines if line]
    if len(filled) > LINES:
        raise ValueError(f"a verdict has at most {LINES} lines, got {len(filled)}: {filled}")
    return "\n".join(filled)


def describe_leader(name: str, ratios: Mapping[str, Estimate], verb: str) -> str:
    """Describe the first entry and its lead, or with which others it ties.

    A rival ties where the interval reaches, or nearly reaches, 1.

    Args:
        name: Name of the first.
        ratios: Its number over each rival's, the closest rival first.
        verb: Verb for what is better done little, such as "err".

    Returns:
        Clause without a full stop.

    >>> describe_leader("lqr", {"esc": Estimate(0.71, 0.65, 0.77)}, "cost")
    'lqr costs least, 71 % [65, 77] as much as esc'
    >>> describe_leader("lqr", {"esc": Estimate(0.98, 0.9, 1.05)}, "cost")
    'lqr and esc cost least, too close to tell apart'
    """
    ties = [rival for rival, ratio in ratios.items() if not ratio.high < _SURE]
    if ties:
        return f"{summarise_names([name, *ties])} {verb} least, too close to tell apart"
    second = [f", {format_percent(ratio)} as much as {rival}" for rival, ratio in ratios.items()]
    return f"{name} {verb}s least{''.join(second[:1])}"


def format_percent(ratio: Estimate) -> str:
    """Format a ratio in percent with its interval, if it has one.

    Args:
        ratio: Ratio, 1 for 100 %.

    Returns:
        Text of both.

    >>> format_percent(Estimate(0.71, 0.65, 0.77)), format_percent(Estimate(0.5))
    ('71 % [65, 77]', '50 %')
    """
    value, low, high = (f"{100.0 * number:.0f}" for number in ratio)
    return f"{value} % [{low}, {high}]" if math.isfinite(ratio.low) else f"{value} %"


def summarise_names(names: Sequence[str], limit: int = _NAMES) -> str:
    """Join names for a sentence, with a count of the later ones.

    Args:
        names: Names.
        limit: Maximum of names that are shown.

    Returns:
        Text of the names.

    >>> summarise_names(["a"]), summarise_names(["a", "b"]), summarise_names(["a", "b", "c", "d"])
    ('a', 'a and b', 'a, b and 2 more')
    """
    shown = list(names[:limit])
    if len(names) > limit:
        return f"{', '.join(shown)} and {len(names) - limit} more"
    return " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]])) if shown else "nobody"
