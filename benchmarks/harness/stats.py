"""Intervals over seeds, 95 %, paired where two columns share their seeds.

Their coverage on skewed costs is tested by simulation.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import bootstrap, norm
from scipy.stats import t as student

from ...envs.record import Array

LEVEL = 0.95
RESAMPLES = 2000
_DRAWS = 1000  # of a ratio of sums
WORST = 0.05
"""The share of the episodes that `worst` takes the mean of."""
_TAIL = 0.5 * (1.0 - LEVEL)
_LEAST = 25  # episodes in the tail, with fewer the interval of `worst` covers too rarely


class Estimate(NamedTuple):
    """A number with its 95 % interval; NaN bounds where there is none."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def half_width(self) -> float:
        """Half the interval."""
        return 0.5 * (self.high - self.low)

    def text(self, scale: float = 1.0, digits: str = ".3f") -> tuple[str, str]:
        """The number and its interval, as two cells of a table."""
        value, low, high = (f"{scale * each:{digits}}" for each in self)
        return value, f"{low} .. {high}"


def root_mean(squares: Array, axis: int = -1) -> Array:
    """The square root of the mean: RMSE from each seed's mean squared error."""
    return np.asarray(np.sqrt(np.mean(squares, axis=axis)))


def mean(values: Array, axis: int = -1) -> Array:
    """The mean, a statistic of `interval`."""
    return np.asarray(np.mean(values, axis=axis))


def interval(
    values: Array, statistic: Callable[..., Array] = mean, paired: Array | None = None
) -> Estimate:
    """A statistic over seeds with its 95 % bootstrap interval.

    values: (n,) one number a seed. paired: (n,), resampled together with values and handed to the
    statistic as its second argument. Fewer than two different values: the estimate three times.
    The random numbers are fixed, so the same values give the same interval.
    """
    data = (values,) if paired is None else (values, paired)
    estimate = float(statistic(*data, axis=-1))
    if len(values) < 2 or all(np.ptp(column) == 0.0 for column in data):
        return Estimate(estimate, estimate, estimate)
    result = bootstrap(
        data,
        statistic,
        paired=paired is not None,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    low, high = result.confidence_interval
    return Estimate(estimate, float(low), float(high))


def ratio_of_roots(squares: Array, reference: Array, axis: int = -1) -> Array:
    """RMSE over the RMSE of a reference on the same seeds."""
    return np.asarray(root_mean(squares, axis) / root_mean(reference, axis))


def ratio_of_means(values: Array, reference: Array, axis: int = -1) -> Array:
    """The mean over the mean of a reference on the same seeds."""
    return np.asarray(mean(values, axis) / mean(reference, axis))


def average(*strata: Array) -> Estimate:
    """The mean over strata of the means of their numbers (n_i,), with Student's interval.

    NaN of none, and where a number is.
    """
    there = [each for each in strata if len(each)]
    if not there:
        return Estimate(math.nan)
    middle = float(np.mean([each.mean() for each in there]))
    if min(map(len, there)) < 2:
        return Estimate(middle)
    variance = sum(float(each.var(ddof=1)) / len(each) for each in there) / len(there) ** 2
    freedom = sum(map(len, there)) - len(there)
    reach = float(student.isf(_TAIL, freedom)) * math.sqrt(variance)
    return Estimate(middle, middle - reach, middle + reach)


def geometric_mean(*strata: Array) -> Estimate:
    """exp of the `average` of logarithms of paired ratios: strata of one weight."""
    return Estimate(*(math.exp(each) for each in average(*strata)))


def share(hits: npt.ArrayLike) -> Estimate:
    """The mean of (n,) numbers that are 0 or 1, a tie one half, with Wilson's interval.

    NaN where one is, or of none.
    """
    values, z = np.asarray(hits, np.float64), float(norm.isf(_TAIL))
    n = len(values)
    value = float(np.mean(values)) if n else math.nan
    if math.isnan(value):
        return Estimate(value)
    middle = (value + z * z / (2.0 * n)) / (1.0 + z * z / n)
    reach = z * math.sqrt(value * (1.0 - value) / n + (0.5 * z / n) ** 2) / (1.0 + z * z / n)
    return Estimate(value, max(middle - reach, 0.0), min(middle + reach, 1.0))


def won(costs: Array, others: Array) -> Estimate:
    """The share of episodes that cost less than the other's on the same seed, a tie one half."""
    return share(np.where(costs == others, 0.5, np.less(costs, others)))


def profile(values: Array, levels: Array) -> tuple[Array, Array, Array]:
    """The share of (n,) numbers that are at most each level (k,), with Wilson's interval: a
    performance profile (Dolan and Moré 2002). (k,) each: value, low, high; NaN counts as above."""
    value, low, high = np.array([share(values <= level) for level in levels]).T
    return value, low, high


def worst(costs: Array) -> Estimate:
    """The mean of the largest `WORST` of positive numbers (n,): the conditional value at risk.

    Its interval is Student's for the logarithm, from the influence of each number on the tail's
    mean; there is none where the tail has fewer than 25.
    """
    if len(costs) == 0 or np.isnan(costs).any():
        return Estimate(math.nan)
    count = max(1, round(WORST * len(costs)))
    ordered = np.sort(costs)
    value = float(ordered[-count:].mean())
    if count < _LEAST or value <= 0.0:
        return Estimate(value)
    beyond = np.maximum(costs - ordered[-count], 0.0)
    error = math.sqrt(len(costs)) * float(np.std(beyond, ddof=1)) / count
    reach = math.exp(float(student.isf(_TAIL, count - 1)) * error / value)
    return Estimate(value, value / reach, value * reach)


def ratio_of_sums(tops: Sequence[Array], bottoms: Sequence[Array]) -> Estimate:
    """Sum over strata of the mean top / that of the mean bottom, tops and bottoms paired (n_i,).

    The interval is a bootstrap within the strata, in which an episode's top and bottom stay
    together; its percentiles are widened for small strata (Hesterberg, What Teachers Should Know
    about the Bootstrap). NaN without strata or where a sum of bottoms is not positive.
    """
    if not tops or min(map(len, tops)) == 0:
        return Estimate(math.nan)
    above, below = (sum(float(np.mean(each)) for each in side) for side in (tops, bottoms))
    if not below > 0.0:
        return Estimate(math.nan)
    least = min(map(len, tops))
    if least < 2:
        return Estimate(above / below)
    sums = np.zeros((_DRAWS, 2))
    for i, pair in enumerate(zip(tops, bottoms, strict=True)):
        sums += _weights(i, len(pair[0])) @ np.column_stack(pair)
    freedom = sum(map(len, tops)) - len(tops)
    reach = float(student.isf(_TAIL, freedom)) * math.sqrt(least / (least - 1.0))
    ends = norm.cdf([-reach, reach])
    low, high = np.quantile(sums[:, 0] / sums[:, 1], ends)
    return Estimate(above / below, float(low), float(high))


@lru_cache(maxsize=32)
def _weights(stratum: int, n: int) -> Array:
    """(_DRAWS, n) how often a resample of a stratum has each of its n, over n; the same for all."""
    rng = np.random.default_rng([stratum, n])
    counts = rng.multinomial(n, np.full(n, 1.0 / n), _DRAWS)
    return np.asarray(counts / n)


def chance_of_no_less(logs: Array) -> float:
    """One-sided p of Student's test that the mean of (n,) paired differences is not below 0."""
    spread = float(np.std(logs, ddof=1)) if len(logs) > 1 else math.nan
    middle = float(np.mean(logs)) if len(logs) else math.nan
    if not spread > 0.0:
        return 1.0
    return float(student.cdf(middle * math.sqrt(len(logs)) / spread, len(logs) - 1))


def holm(chances: Sequence[float], level: float = 1.0 - LEVEL) -> list[bool]:
    """Which of several p values are significant at a family-wise level, by Holm's step-down."""
    found, order = [False] * len(chances), np.argsort(chances)
    for rank, i in enumerate(order):
        if not chances[i] <= level / (len(chances) - rank):
            break
        found[i] = True
    return found
