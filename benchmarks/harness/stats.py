"""Statistics over seeds with 95 % intervals, paired where two columns share their seeds.

Intervals are Student's, on a logarithmic scale for positive numbers; those of fractions Wilson's.
No interval of a mean holds for rare failures that did not occur: `share` bounds their rate.

Args:
    values: Numbers of the seeds, shape (n,).
    strata: Numbers of each stratum, shape (n_i,); NaN for the mean of fewer than two.
    hits: Whether each drive is a hit, shape (n,), a tie 0.5.
    costs: Costs of the seeds, shape (n,); NaN without any.
    others: Those of another on the same seeds, shape (n,).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import Array

_LEVEL = 0.95  # of the intervals
_TAIL = 0.5 * (1.0 - _LEVEL)  # probability beyond each bound
_Z95 = 1.959964  # standard deviations to each side
_BLOCK = 512  # rows of a jackknife at once
_MIN_SEEDS = 4  # with fewer an interval spans orders of magnitude
_WORST = 0.05  # fraction of the episodes whose mean `compute_tail_mean` takes
_MIN_TAIL = 25  # episodes in the tail; with fewer an interval covers too rarely


class Estimate(NamedTuple):
    """A number with its 95 % interval; NaN bounds where there is none."""

    value: float
    low: float = math.nan
    high: float = math.nan

    def rescale(self, factor: float) -> "Estimate":
        """Multiply number and interval.

        Args:
            factor: Factor.
        """
        return Estimate(*(factor * number for number in self))

    def inline(self, scale: float = 1.0, digits: str = ".2f") -> str:
        """Format the number and, in brackets, its interval if there is one; thousands in full.

        Args:
            scale: Factor of the numbers.
            digits: Format of the numbers.
        """
        texts = (f"{scale * number:{digits}}" for number in self)
        value, low, high = (f"{float(x):.0f}" if "e+" in x else x for x in texts)
        return f"{value} [{low}, {high}]" if math.isfinite(self.low) else value


_RELATIONS: dict[str, Callable[[Array, float], npt.NDArray[np.bool_]]] = {
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal, "=": np.equal
}  # fmt: skip


class Bound(NamedTuple):
    """A relation and a number, such as "<= 0.75"."""

    relation: str
    value: float

    def __str__(self) -> str:
        return f"{self.relation} {self.value:g}"

    def is_met(self, values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Tell which of the values meet it; NaN never does."""
        return np.asarray(_RELATIONS[self.relation](np.asarray(values, float), self.value))


def compute_range(values: Array) -> Estimate:
    """Compute the median, with the smallest and largest number as bounds."""
    return Estimate(*(float(statistic(values)) for statistic in (np.median, np.min, np.max)))


def root_mean(squares: Array, axis: int = -1) -> Array:
    """Compute the square root of the mean over the seeds: RMSE from squared errors.

    Args:
        squares: Squared errors.
        axis: Axis of the seeds.
    """
    return np.asarray(np.sqrt(np.mean(squares, axis=axis)))


def margin_of_error(*strata: Array) -> float:
    """Compute half of the 95 % interval of the sum of independent means, by Student's t.

    The variances add up with the degrees of freedom of Welch and Satterthwaite, fewer where the
    kurtosis is large (O'Neill 2014, Some useful moment results in sampling problems).
    """
    variance = uncertainty = 0.0
    for values in strata:
        n = len(values)
        if n < 2:
            return math.nan
        freedom, square = n - 1.0, float(np.var(values))
        if n > 3 and square > 0.0:
            excess = float(np.mean((values - np.mean(values)) ** 4)) / square**2 - 3.0
            excess = ((n + 1.0) * excess + 6.0) * (n - 1.0) / ((n - 2.0) * (n - 3.0))  # unbiased
            freedom = max(freedom / (1.0 + 0.5 * max(excess, 0.0)), 2.0)
        variance += square / (n - 1.0)
        uncertainty += (square / (n - 1.0)) ** 2 / freedom
    if uncertainty == 0.0:
        return 0.0
    from scipy.special import stdtrit  # which a command's help need not load

    return float(-stdtrit(variance**2 / uncertainty, _TAIL)) * math.sqrt(variance)


def interval(
    values: Array, statistic: Callable[..., Any] = np.mean, paired: Array | None = None
) -> Estimate:
    """Compute a statistic over seeds with its 95 % interval, by the jackknife.

    Where no number is negative, the interval is that of the statistic's logarithm.
    Fewer than four seeds or an infinite statistic have none.

    Args:
        values: Numbers of the seeds, shape (n,).
        statistic: Smooth function, no median, of `values`, and of `paired` unless that is None.
        paired: Numbers of the same seeds, shape (n,), left out together with `values`.
    """
    data = (values,) if paired is None else (values, paired)
    estimate, n = float(statistic(*data, axis=-1)), len(values)
    if n < _MIN_SEEDS:
        return Estimate(estimate)
    blocks = np.array_split(np.arange(n), -(-n // _BLOCK))
    with np.errstate(divide="ignore"):
        parts = [statistic(*(_make_subsets(x, block) for x in data), axis=-1) for block in blocks]
    rest = np.concatenate(parts)
    if not np.isfinite(rest).all():
        return Estimate(estimate)
    if min(map(np.min, data)) >= 0.0 and rest.min() > 0.0:
        reach = math.exp(margin_of_error((n - 1.0) * np.log(rest)))
        return Estimate(estimate, estimate / reach, estimate * reach)
    reach = margin_of_error((n - 1.0) * rest)
    return Estimate(estimate, estimate - reach, estimate + reach)


def _make_subsets(values: Array, block: npt.NDArray[np.intp]) -> Array:
    """Copy the numbers (n,) without that of each index of a block, shape (block, n - 1)."""
    others = block[:, None] != np.arange(len(values))
    rest: Array = np.broadcast_to(values, others.shape)[others].reshape(len(block), -1)
    return rest


def mean_share(values: Array) -> Estimate:
    """Compute the mean of fractions; its interval is that of the odds, if they vary."""
    if not 0.0 < np.mean(values) < 1.0:
        return interval(values)
    odds = interval(values, lambda x, axis: ratio_of_means(x, 1.0 - x, axis))
    return Estimate(*(x / (1.0 + x) for x in np.maximum(odds, 0.0)))


def _make_ratio(statistic: Callable[..., Any]) -> Callable[..., Array]:
    """Make a statistic over that of a reference on the same seeds, (values, reference, axis)."""

    def ratio(values: Array, reference: Array, axis: int = -1) -> Array:
        return np.asarray(statistic(values, axis=axis) / statistic(reference, axis=axis))

    return ratio


ratio_of_means = _make_ratio(np.mean)  # mean over that of a reference
ratio_of_roots = _make_ratio(root_mean)  # RMSE over that of a reference, from squared errors


def average(*strata: Array) -> Estimate:
    """Average the means of strata, with interval; NaN without strata, and where a number is NaN."""
    filled = [stratum for stratum in strata if len(stratum)]
    if not filled:
        return Estimate(math.nan)
    middle = float(np.mean([stratum.mean() for stratum in filled]))
    reach = margin_of_error(*(stratum / len(filled) for stratum in filled))
    return Estimate(middle, middle - reach, middle + reach)


def geometric_mean(*strata: Array) -> Estimate:
    """Compute exp of the `average` of strata of logarithms, of equal weight."""
    return Estimate(*(math.exp(log) for log in average(*strata)))


def share(hits: npt.ArrayLike) -> Estimate:
    """Compute the mean of hits with Wilson's interval; NaN without hits."""
    from scipy.special import ndtri

    values, z = np.asarray(hits, np.float64), float(-ndtri(_TAIL))
    n = len(values)
    value = float(np.mean(values)) if n else math.nan
    if math.isnan(value):
        return Estimate(value)
    middle = (value + z * z / (2.0 * n)) / (1.0 + z * z / n)
    reach = z * math.sqrt(value * (1.0 - value) / n + (0.5 * z / n) ** 2) / (1.0 + z * z / n)
    return Estimate(value, max(middle - reach, 0.0), min(middle + reach, 1.0))


def compute_honesty(error: Array, deviation: Array) -> tuple[float, float, float]:
    """Compute whether a filter's own deviation tells how far it is from the truth.

    Args:
        error: Errors of an estimate, shape (n,).
        deviation: Its standard deviations in the same unit, shape (n,).

    Returns:
        NEES, the mean squared error in variances, 1 where it is honest; the fraction of errors in
        the 95 % interval; the mean logarithm of the normal density at the truth, whose unit is the
        error's: the larger, the better. It weighs error against honesty (Good 1952).
    """
    squares = (error / deviation) ** 2
    score = -0.5 * squares - np.log(deviation) - 0.5 * math.log(2.0 * math.pi)
    return float(np.mean(squares)), float(np.mean(squares < _Z95**2)), float(np.mean(score))


def compute_win_rate(costs: Array, others: Array) -> Estimate:
    """Compute the fraction of episodes that cost less than the other's."""
    return share(np.where(costs == others, 0.5, np.less(costs, others)))


def compute_tail_mean(costs: Array) -> Estimate:
    """Compute the mean of the largest 5 % of positive numbers: the conditional value at risk.

    Its interval is the logarithm's, by influences on the tail's mean; none for a tail below 25.
    """
    if len(costs) == 0 or np.isnan(costs).any():
        return Estimate(math.nan)
    count = max(1, round(_WORST * len(costs)))
    ordered = np.sort(costs)
    value = float(ordered[-count:].mean())
    if count < _MIN_TAIL or value <= 0.0:
        return Estimate(value)
    beyond = np.maximum(costs - ordered[-count], 0.0)
    reach = math.exp(margin_of_error(len(costs) / count * beyond / value))
    return Estimate(value, value / reach, value * reach)


def is_share_larger(hits: npt.ArrayLike, others: npt.ArrayLike) -> bool:
    """Check that a share exceeds another's of the same drives: McNemar's one-sided test, 2.5 %."""
    from scipy.special import bdtrc

    one, other = np.asarray(hits, np.bool_), np.asarray(others, np.bool_)
    larger, differing = int((one & ~other).sum()), int((one != other).sum())
    return differing > 0 and float(bdtrc(larger - 1, differing, 0.5)) <= _TAIL
