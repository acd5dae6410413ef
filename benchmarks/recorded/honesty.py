"""Whether to believe an estimate: its deviation against the truth, or against the next sample."""

import math
from collections.abc import Mapping

import numpy as np

from ...envs.record import Array
from ..harness.results import Column

LOST = 3.0  # mean squared innovation over its variance
_Z95 = 1.959964  # standard deviations of a 95 % interval
HONESTY = (
    Column("nees", "NEES", form=".2f", interval=False),
    Column("coverage", "in 95 %", 100.0, ".0f", interval=False),
    Column("log_score", "log score", form=".2f", interval=False),
)
"""What `compute_honesty` computes."""


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


def describe_innovations(nis: Mapping[str, float]) -> str:
    """Describe whether slow samples surprise each filter as much as it expects.

    Args:
        nis: Mean squared innovation over its variance, of a value of a packet, by filter.

    Returns:
        A sentence; "" where no filter has innovations.
    """
    lost = [f"{name} ({mean:.1f})" for name, mean in nis.items() if mean > LOST]
    if not nis:
        return ""
    judged = "nobody is lost" if not lost else f"do not believe {', '.join(lost)}"
    return f"By squared innovations over their variance, which should be 1: {judged}."
