"""Intervals over seeds: the bootstrap, paired where two columns share their seeds."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.stats import bootstrap

Array = npt.NDArray[np.float64]

LEVEL = 0.95
RESAMPLES = 2000


def root_mean(squares: Array, axis: int = -1) -> Array:
    """The square root of the mean: RMSE from each seed's mean squared error."""
    return np.asarray(np.sqrt(np.mean(squares, axis=axis)))


def mean(values: Array, axis: int = -1) -> Array:
    """The mean, in the form `interval` wants."""
    return np.asarray(np.mean(values, axis=axis))


def interval(
    values: Array, statistic: Callable[..., Array] = mean, paired: Array | None = None
) -> tuple[float, float, float]:
    """(estimate, low, high) of a statistic over seeds with its 95 % bootstrap interval.

    values: (n,) one number a seed. paired: (n,), resampled together with values and handed to the
    statistic as its second argument. Fewer than two different values: the estimate three times.
    The random numbers are fixed, so the same values give the same interval.
    """
    data = (values,) if paired is None else (values, paired)
    estimate = float(statistic(*data, axis=-1))
    if len(values) < 2 or all(np.ptp(column) == 0.0 for column in data):
        return estimate, estimate, estimate
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
    return estimate, float(low), float(high)


def ratio_of_roots(squares: Array, reference: Array, axis: int = -1) -> Array:
    """RMSE over the RMSE of a reference on the same seeds."""
    return np.asarray(root_mean(squares, axis) / root_mean(reference, axis))
