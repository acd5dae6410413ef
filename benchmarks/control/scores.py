"""From episode costs to scores: 0 is `nominal`, 1 is `oracle-state`, everything paired by episode.

r = log((J_nominal + 0.001) / (J + 0.001)), clipped to +-3, over the episodes that both rungs
survive; a contestant's failure there counts log(1 / 20). The score is the sum over contests of the
mean r over that of the oracle's: a ratio of sums, so that no small gap decides.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...agents.rollout import cost_ratios
from ..harness.stats import Estimate, ratio_of_sums
from .episodes import Array, Driven

NOTHING = 0.05
"""A mean gap below which there is nothing to win."""
_CLIP = 3.0
FAILED = 20.0  # times nominal's cost, of an episode that ends by a failure


def survived(driven: Driven) -> npt.NDArray[np.bool_]:
    """(seeds,) whether an episode ended by no failure."""
    return np.asarray(driven["failure"] == 0.0)


def gains(nominal: Array, driven: Driven) -> Array:
    """(n,) r of the first n episodes; nominal: (n,) costs of the same seeds."""
    n = len(nominal)
    with np.errstate(invalid="ignore"):
        r = np.log(cost_ratios(nominal, driven.costs[:n]))
    return np.where(survived(driven)[:n], np.clip(r, -_CLIP, _CLIP), -math.log(FAILED))


@dataclass(frozen=True)
class Yardstick:
    """What 0 and 1 are in a contest: the episodes of `nominal` and `oracle-state`.

    Raises ValueError with the reason where one of them was not driven.
    """

    nominal: Driven
    oracle: Driven

    def __post_init__(self) -> None:
        for name, rung in (("nominal", self.nominal), ("oracle-state", self.oracle)):
            if rung.error:
                raise ValueError(f"{name}: {rung.error}")

    def kept(self, n: int) -> npt.NDArray[np.bool_]:
        """(m,) of at most n episodes: which of them both survive."""
        n = min(n, len(self.nominal.costs), len(self.oracle.costs))
        return survived(self.nominal)[:n] & survived(self.oracle)[:n]

    def paired(self, driven: Driven) -> tuple[Array, Array]:
        """(r of a contestant, r of the oracle) on the same episodes, those that count."""
        kept = self.kept(len(driven.costs))
        nominal = self.nominal.costs[: len(kept)]
        return gains(nominal, driven)[kept], gains(nominal, self.oracle)[kept]

    @property
    def gap(self) -> float:
        """The oracle's mean r; NaN where no episode counts."""
        _, own = self.paired(self.oracle)
        return float(own.mean()) if len(own) else math.nan


def score(pairs: Sequence[tuple[Array, Array]]) -> Estimate:
    """The score over contests from each one's `Yardstick.paired`, those that have no episode left
    out; NaN where nothing is to be won."""
    there = [pair for pair in pairs if len(pair[0])]
    if not there or np.mean([own.mean() for _, own in there]) < NOTHING:
        return Estimate(math.nan)
    return ratio_of_sums([r for r, _ in there], [own for _, own in there])
