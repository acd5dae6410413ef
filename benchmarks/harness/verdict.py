"""Verdicts in words, and explorers: time series of which two are shown beside each other.

A verdict is a suite's answer in at most five lines of plain words, from its own numbers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ...envs.record import Array
from .stats import Estimate

LINES, LETTERS = 5, 110  # lines of a verdict, letters of a line with the package's names
_MAX_NAMES = 2  # names in a sentence; the others are counted
MAX_NIS = 3.0  # mean squared innovation over its variance, beyond which a filter is lost
_MIN_TIE = 0.995  # a ratio below it is a lead


@dataclass(frozen=True)
class Panel:
    """One of the plots above each other."""

    label: str  # quantity with its unit
    lines: Sequence[tuple[str, str]]  # signals and legend; the first has the entry's colour


@dataclass
class Explorer:
    """Time series of which two are shown beside each other."""

    title: str
    menus: Sequence[str]  # labels of the parts of a cell's key but the last one, which is the entry
    # signals (n,) by key, with time "t" (s); with X, Y (m) and psi (rad) a cell is shown in motion
    cells: Mapping[tuple[str, ...], Mapping[str, Array]]
    panels: Sequence[Panel]
    caption: str = ""  # caption, a sentence
    pair: tuple[str, str] = ("", "")  # the two entries at the start
    # length and width of the car (m) by the shared part of the key
    bodies: Mapping[tuple[str, ...], tuple[float, float]] = field(default_factory=dict)


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


def summarise_names(names: Sequence[str], limit: int = _MAX_NAMES) -> str:
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
