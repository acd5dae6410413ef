"""The price of delay: score and cost over informed against how late the sensors are."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from ...envs.record import Array
from ..harness.stats import Estimate
from .cells import INFORMED, YAW, Cell
from .run import Results, measure
from .scores import Ceiling, Resampled

DELAYS = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.25, 0.3)  # s, of camera and GPS alike
FRAME = 0.05  # s: so slow that a camera's frames 0.3 s late find room under way
SCENARIO = "random-steering"
CONTESTANTS = (
    *(("none", ""), (INFORMED, ""), ("two-dof", "multirate-kf"), ("two-dof", "exact-kf")),
    *(("lqr", "single-rate-kf"), ("lqr", "dakf"), ("lqr", "exact-kf")),
)


@dataclass
class Price:
    """A contestant's score and cost over informed at each delay."""

    cell: Cell
    score: list[Estimate]
    over: list[Estimate]


def late_cells(delay: float) -> list[Cell]:
    """The contestants with camera (every FRAME) and GPS a delay (s) late."""
    late = {"delays": [delay], "jitter": 0.0}
    options = {"camera": late | {"period": FRAME}, "gps": late}
    return [Cell(YAW, SCENARIO, estimator, who, options) for who, estimator in CONTESTANTS]


def price_of_delay(
    top: Ceiling | None,
    episodes: int,
    *,
    salt: str,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> tuple[list[Price], list[Results]]:
    """Every contestant at each of DELAYS, all on the same seeds, and the results by delay.

    top: the ceiling of SCENARIO, which needs no sensor; None leaves the scores out.
    """
    found: list[Results] = [
        measure(late_cells(d), episodes, salt=salt, jobs=jobs, console=console, keep=keep)
        for d in DELAYS
    ]
    draw = Resampled(episodes, 1)
    prices = []
    for controller, estimator in CONTESTANTS:
        price = Price(Cell(YAW, SCENARIO, estimator, controller), [], [])
        for results in found:
            costs = results.of(YAW, SCENARIO, controller, estimator).costs
            none = results.of(YAW, SCENARIO, "none").costs
            informed = results.of(YAW, SCENARIO, INFORMED).costs
            price.over.append(draw.over(costs, informed, 0))
            if top is not None:
                price.score.append(draw.score(none, costs, top, 0))
        if controller != "none":
            prices.append(price)
    return prices, found


def lines(prices: Sequence[Price], what: str) -> dict[str, tuple[Array, Array, Array]]:
    """name to (value, low, high) over the delays, of "score" or "over"."""
    found = {}
    for price in prices:
        each: list[Estimate] = getattr(price, what)
        if each:
            value, low, high = np.array(each).T
            found[price.cell.label] = value, low, high
    return found
