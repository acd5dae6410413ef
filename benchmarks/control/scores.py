"""From episode costs to scores: 0 is the uncontrolled car, 1 the clairvoyant optimum.

score = (mean J_none - J) / (mean J_none - mean J_clairvoyant), so that the mean of the episodes'
scores is the score of the mean cost. Aggregates over manoeuvres are the mean and rliable's
interquartile mean with its stratified bootstrap (Agarwal et al., Deep Reinforcement Learning at the
Edge of the Statistical Precipice): seeds are drawn anew within each manoeuvre, the same ones for
everybody, the uncontrolled car included.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import trim_mean

from ..harness.stats import Estimate

Array = npt.NDArray[np.float64]

RESAMPLES = 400
_TAIL = 2.5  # percent on either side of a 95 % interval
_QUARTER = 0.25


@dataclass(frozen=True)
class Ceiling:
    """mean: J_clairvoyant of a scenario. error: its standard error."""

    mean: float
    error: float


class Resampled:
    """The same bootstrap draws for everybody in a table.

    seeds: episodes of a manoeuvre. manoeuvres: how many. Everything is deterministic.
    """

    def __init__(self, seeds: int, manoeuvres: int) -> None:
        rng = np.random.default_rng(0)
        self.draws = rng.integers(0, seeds, (RESAMPLES, manoeuvres, seeds))
        self.normal = rng.standard_normal((RESAMPLES, manoeuvres))

    def score(self, none: Array, costs: Array, ceiling: Ceiling, which: int) -> Estimate:
        """The score of one manoeuvre; none, costs: (seeds,) of the same episodes."""
        value = float(normalised(none, costs, ceiling).mean())
        picked = self.draws[:, which, :]
        top = ceiling.mean + ceiling.error * self.normal[:, which]
        base = none[picked].mean(axis=1)
        return _estimate(value, (base - costs[picked].mean(axis=1)) / (base - top))

    def over(self, costs: Array, others: Array, which: int) -> Estimate:
        """mean(costs) / mean(others) on the same episodes."""
        picked = self.draws[:, which, :]
        spread = costs[picked].mean(axis=1) / others[picked].mean(axis=1)
        return _estimate(float(costs.mean() / others.mean()), spread)

    def mean(self, values: Array, which: int) -> Estimate:
        """The mean over seeds."""
        return _estimate(float(values.mean()), values[self.draws[:, which, :]].mean(axis=1))

    def aggregate(self, none: Array, costs: Array, tops: list[Ceiling]) -> dict[str, Estimate]:
        """{"score", "iqm"} over manoeuvres; none, costs: (manoeuvres, seeds)."""
        own = np.array([normalised(*each) for each in zip(none, costs, tops, strict=True)])
        means, middles = np.empty(RESAMPLES), np.empty(RESAMPLES)
        rows = np.arange(len(none))[:, None]
        for b, picked in enumerate(self.draws[:, : len(none)]):
            again, against = costs[rows, picked], none[rows, picked]
            drawn = np.array(
                [
                    normalised(n, c, Ceiling(t.mean + t.error * self.normal[b, i], 0.0))
                    for i, (n, c, t) in enumerate(zip(against, again, tops, strict=True))
                ]
            )
            means[b], middles[b] = drawn.mean(), trim_mean(drawn, _QUARTER, axis=None)
        return {
            "score": _estimate(float(own.mean()), means),
            "iqm": _estimate(float(trim_mean(own, _QUARTER, axis=None)), middles),
        }


def normalised(none: Array, costs: Array, ceiling: Ceiling) -> Array:
    """(seeds,) each episode's share of what could be gained on average."""
    base = none.mean()
    return np.asarray((base - costs) / (base - ceiling.mean))


def improvement(costs: Array, others: Array) -> float:
    """Probability that an episode of the one costs less than one of the other, ties half: rliable's
    probability of improvement, the Mann-Whitney statistic. costs (n,), others (m,); NaN if one is.
    """
    if not (np.isfinite(costs).all() and np.isfinite(others).all()):
        return float("nan")
    ordered = np.sort(others)
    after = np.searchsorted(ordered, costs, side="right")
    ties = after - np.searchsorted(ordered, costs)
    return float(np.mean(len(ordered) - after + 0.5 * ties)) / len(ordered)


def _estimate(value: float, spread: Array) -> Estimate:
    low, high = np.percentile(spread, [_TAIL, 100.0 - _TAIL])
    return Estimate(value, float(low), float(high))
