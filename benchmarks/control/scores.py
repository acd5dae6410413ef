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

from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ..harness.stats import Estimate, ratio_of_sums
from .episodes import DriveResult

MIN_GAP = 0.05
"""A mean gap below which there is nothing to win."""
_CLIP = 3.0
FAILURE_RATIO = 20.0  # times nominal's cost, of an episode that ends by a failure


def survival_mask(result: DriveResult) -> npt.NDArray[np.bool_]:
    """(seeds,) whether an episode ended by no failure."""
    return np.asarray(result["failure"] == 0.0)


def compute_log_ratios(nominal: Array, result: DriveResult) -> Array:
    """(n,) r of the first n episodes; nominal: (n,) costs of the same seeds."""
    n = len(nominal)
    with np.errstate(invalid="ignore"):
        r = np.log(compute_cost_ratios(nominal, result.costs[:n]))
    return np.where(survival_mask(result)[:n], np.clip(r, -_CLIP, _CLIP), -math.log(FAILURE_RATIO))


@dataclass(frozen=True)
class ScoreScale:
    """What 0 and 1 are in a contest: the episodes of `nominal` and `oracle-state`.

    Raises ValueError with the reason where one of them was not driven.
    """

    nominal: DriveResult
    oracle: DriveResult

    def __post_init__(self) -> None:
        for name, oracle in (("nominal", self.nominal), ("oracle-state", self.oracle)):
            if oracle.error:
                raise ValueError(f"{name}: {oracle.error}")

    def mark_compared(self, n: int) -> npt.NDArray[np.bool_]:
        """(m,) of at most n episodes: which of them both survive."""
        n = min(n, len(self.nominal.costs), len(self.oracle.costs))
        return survival_mask(self.nominal)[:n] & survival_mask(self.oracle)[:n]

    def compute_paired_ratios(self, result: DriveResult) -> tuple[Array, Array]:
        """(r of a contestant, r of the oracle) on the same episodes, those that count."""
        compared = self.mark_compared(len(result.costs))
        nominal = self.nominal.costs[: len(compared)]
        return compute_log_ratios(nominal, result)[compared], compute_log_ratios(
            nominal, self.oracle
        )[compared]

    @property
    def gap(self) -> float:
        """The oracle's mean r; NaN where no episode counts."""
        _, oracle_ratios = self.compute_paired_ratios(self.oracle)
        return float(oracle_ratios.mean()) if len(oracle_ratios) else math.nan


def score(pairs: Sequence[tuple[Array, Array]]) -> Estimate:
    """The score over contests from each one's `ScoreScale.paired`, those that have no episode left
    out; NaN where nothing is to be won."""
    filled = [pair for pair in pairs if len(pair[0])]
    if not filled or np.mean([oracle_ratios.mean() for _, oracle_ratios in filled]) < MIN_GAP:
        return Estimate(math.nan)
    return ratio_of_sums([r for r, _ in filled], [oracle_ratios for _, oracle_ratios in filled])
