"""Gain margins of a discrete-time loop, the crossing at half the sampling rate included."""

import math
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from ....envs.record import Array

if TYPE_CHECKING:
    from control import StateSpace, TransferFunction

    Loop: TypeAlias = StateSpace | TransferFunction


_DECADES, _POINTS = 6, 4000  # of the frequency grid, below half the sampling rate


def find_crossings(loop: "Loop") -> Array:
    """(n, 2): factors on the loop that bring it to -1, and rad/s, in the order of frequency.

    L is real at z = -1: where it is negative there, half the sampling rate is a phase crossover.
    python-control's `stability_margins` finds crossings by a change of sign, and there is none at
    the end of the axis. The others are bracketed on a grid (4000 points over six decades) and
    refined: a pair of crossings closer than that is missed.

    Raises ValueError for a loop in continuous time or with several inputs or outputs.
    """
    if not loop.isdtime(strict=True) or loop.dt is True:
        raise ValueError(f"margins need a discrete-time loop with its period, got dt={loop.dt!r}")
    if not loop.issiso():
        raise ValueError(
            f"margins need one input and one output, got {loop.ninputs} x {loop.noutputs}"
        )
    dt = float(loop.dt)
    top = math.pi / dt

    def evaluate_loop(omega: float) -> complex:
        return complex(_compute_response(loop, np.exp(1j * np.array([omega * dt])))[0])

    grid = top * np.logspace(-_DECADES, 0.0, _POINTS)[:-1]
    signs = np.sign(_compute_response(loop, np.exp(1j * grid * dt)).imag)
    frequencies = [
        float(brentq(lambda w: evaluate_loop(w).imag, low, high, xtol=1e-14 * low, rtol=1e-14))
        for low, high, changes in zip(grid, grid[1:], signs[:-1] * signs[1:] < 0.0, strict=False)
        if changes
    ]
    factors = [
        (1.0 / abs(evaluate_loop(omega)), omega)
        for omega in frequencies
        if evaluate_loop(omega).real < 0.0
    ]
    end = evaluate_loop(top).real
    return np.reshape([*factors, *([(-1.0 / end, top)] if end < 0.0 else [])], (-1, 2))


def compute_gain_margin(loop: "Loop") -> tuple[float, float]:
    """(dB, rad/s) of the smallest gain above 1 that reaches -1; (inf, nan) where none does."""
    margins = find_crossings(loop)
    rising = margins[margins[:, 0] > 1.0]
    if not len(rising):
        return math.inf, math.nan
    factor, omega = rising[np.argmin(rising[:, 0])]
    return 20.0 * math.log10(factor), float(omega)


def _compute_response(loop: "Loop", z: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """The loop at the points z, (n,); python-control's own takes a state space point by point."""
    if not hasattr(loop, "A"):
        return np.asarray(loop(z))
    shifted = z[:, None, None] * np.eye(len(loop.A)) - loop.A
    return np.asarray((loop.C @ np.linalg.solve(shifted, loop.B[None]) + loop.D)[:, 0, 0])
