"""Envs with an estimator in front, and recorded episodes for estimators.

Any two cells of a table side by side: over time, and in motion where the place is known.

A verdict: a suite's answer in at most five lines of plain words, from its own numbers.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import gymnasium as gym

from ...envs.record import Array, Log
from ...estimators.protocol import UnobservableWarning
from ...estimators.wrappers.estimate import EstimateObservation, make_spec
from .stats import Estimate

T = TypeVar("T")

SETTLED = 2.0  # s: errors of estimates count from here on


@dataclass(frozen=True)
class LoggedEpisode:
    """An episode's log, and the arguments of `make_estimator` that belong to it."""

    log: Log
    facts: dict[str, Any]


def make_filter_arguments(base: Any) -> dict[str, Any]:
    """Make the arguments of `make_estimator` from an env's running episode.

    Args:
        base: Unwrapped env.

    Returns:
        Fields of `EstimatorSpec`, and dt (s).
    """
    return make_spec(base)._asdict() | {"dt": base.dt}


def call_quietly(make: Callable[..., T], *args: Any, **options: Any) -> T:
    """Call a maker of a filter, or of an env with one, without `UnobservableWarning`.

    Args:
        make: Function to call.
        args: Positional arguments.
        options: Keyword arguments.

    Returns:
        What the maker returns.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnobservableWarning)
        return make(*args, **options)


def make_env(
    env_id: str, estimator: str = "", estimate: Mapping[str, Any] | None = None, **options: Any
) -> gym.Env[Any, Any]:
    """Make an env whose bad actions end the episode, with an estimator in front.

    Args:
        env_id: Id of the env.
        estimator: Name of the estimator, "" for none.
        estimate: Other arguments of `EstimateObservation`.
        options: Arguments of the env.

    Returns:
        Env, wrapped if there is an estimator.
    """
    env: gym.Env[Any, Any] = gym.make(env_id, **{"on_bad_action": "fail", **options})
    return (
        call_quietly(EstimateObservation, env, estimator, **(estimate or {})) if estimator else env
    )


@dataclass(frozen=True)
class Panel:
    """One of the plots above each other.

    Attributes:
        label: Quantity with its unit.
        lines: Names of signals and their texts in the legend; the first has the entry's colour, a
            "reference" is dashed.
    """

    label: str
    lines: Sequence[tuple[str, str]]


@dataclass
class Explorer:
    """Time series of which two are shown beside each other.

    Attributes:
        title: Title of the figure.
        menus: Label of each part of a cell's key but the last, for both sides; the last is the
            entry.
        cells: Signals of shape (n,) by key, with the time under "t" (s); with X, Y (m) and psi
            (rad) a cell is shown in motion.
        panels: Plots of the signals.
        caption: Caption, a sentence.
        pair: The two entries at the start.
        bodies: Length and width of the car (m) by the shared part of the key.

    Raises:
        ValueError: There are no cells, or a cell lacks a signal or a part of its key.
    """

    title: str
    menus: Sequence[str]
    cells: Mapping[tuple[str, ...], Mapping[str, Array]]
    panels: Sequence[Panel]
    caption: str = ""
    pair: tuple[str, str] = ("", "")
    bodies: Mapping[tuple[str, ...], tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.cells:
            raise ValueError(f"explorer {self.title!r} has no cells")
        for key, signals in self.cells.items():
            if len(key) != len(self.menus) + 1:
                raise ValueError(
                    f"cell {key} has {len(key)} names, {len(self.menus)} menus and a contestant "
                    f"make {len(self.menus) + 1}"
                )
            missing = {name for panel in self.panels for name, _ in panel.lines} - set(signals)
            if missing or "t" not in signals:
                raise ValueError(f"cell {key} lacks {', '.join(sorted(missing)) or 't'}")


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
