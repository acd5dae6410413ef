"""Intervals over seeds: the bootstrap, paired where two columns share their seeds."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import bootstrap

from ...envs.record import Array

LEVEL = 0.95
RESAMPLES = 2000


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
