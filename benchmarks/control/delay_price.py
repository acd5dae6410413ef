"""The price of delay: cost against how late the sensors are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from ...envs.record import Array
from ..harness.stats import Estimate, geometric_mean
from .cells import REFERENCE_CONTROLLER, REFERENCE_FILTER, Cell
from .contests import NOMINAL, ORACLES, PARAMETERS, STATE, YAW, Contest
from .run import Results, measure
from .scores import gains, survived

DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)  # s, of camera and GPS alike, beside what the seed draws
FRAME = 0.05  # s: so slow that a camera's frames 0.3 s late find room under way
PRICE_CONTEST = Contest("1", YAW, "coms", "zero-slip", "coms-random")
CONTESTANTS = (
    *((NOMINAL, ""), (ORACLES[PARAMETERS][0], ""), (ORACLES[STATE][0], "")),
    *((REFERENCE_CONTROLLER, each) for each in (REFERENCE_FILTER, "multirate-kf", "bicycle-kf")),
)


@dataclass
class Price:
    """A contestant's cost over that of nominal with sensors in time, at each delay."""

    cell: Cell
    over: list[Estimate]


def late_cells(delay: float) -> list[Cell]:
    """The contestants with camera (every FRAME) and GPS a delay (s) late."""
    late = {"camera_delays": [delay], "camera_jitter": 0.0, "gps_delays": [delay]}
    scenario = {"base": PRICE_CONTEST.scenario, **late}
    options = {"scenario": scenario, "camera": {"period": FRAME}}
    return [Cell(PRICE_CONTEST, estimator, who, options) for who, estimator in CONTESTANTS]


def price_of_delay(
    seeds: Sequence[int],
    *,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
) -> tuple[list[Price], list[Results]]:
    """Every contestant at each of DELAYS, all on the same seeds, and the results by delay."""
    found = [measure(late_cells(d), seeds, jobs=jobs, console=console, keep=keep) for d in DELAYS]
    in_time = found[0].of(PRICE_CONTEST, NOMINAL)
    prices = []
    for who, estimator in CONTESTANTS:
        price = Price(Cell(PRICE_CONTEST, estimator, who), [])
        for results in found:
            driven = results.of(PRICE_CONTEST, who, estimator)
            there = survived(in_time)[: len(driven.costs)]
            wrong = driven.error or in_time.error
            logs = np.empty(0) if wrong else -gains(in_time.costs[: len(there)], driven)[there]
            price.over.append(geometric_mean(logs))
        prices.append(price)
    return prices, found


def lines(prices: Sequence[Price]) -> Mapping[str, tuple[Array, Array, Array]]:
    """name to (value, low, high) over the delays, of those that were driven at all of them."""
    return {
        price.cell.label: (*np.array(price.over).T,)
        for price in prices
        if np.isfinite(price.over).all()
    }
