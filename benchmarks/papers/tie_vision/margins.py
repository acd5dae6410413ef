"""Gain and phase margins of a discrete-time loop, the one at half the sampling rate included."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from ....envs.record import Array

if TYPE_CHECKING:
    from control import StateSpace, TransferFunction


_DECADES, _POINTS = 6, 4000  # of the frequency grid, below half the sampling rate


@dataclass(frozen=True)
class Margins:
    """Every crossing of a loop, in the order of frequency.

    gain: (n, 2), factors on the loop that bring it to -1, and rad/s. phase: (m, 2), rad in
    (-pi, pi] that turn it onto -1 (positive: lag), and rad/s. dt: s.
    """

    gain: Array
    phase: Array
    dt: float

    @property
    def gain_margin(self) -> tuple[float, float]:
        """(dB, rad/s) of the smallest gain above 1 that reaches -1; (inf, nan) where none does."""
        rising = self.gain[self.gain[:, 0] > 1.0]
        if not len(rising):
            return math.inf, math.nan
        factor, omega = rising[np.argmin(rising[:, 0])]
        return 20.0 * math.log10(factor), float(omega)

    @property
    def phase_margin(self) -> tuple[float, float]:
        """(rad, rad/s) of the least phase in size; (inf, nan) where the gain never is 1."""
        if not len(self.phase):
            return math.inf, math.nan
        angle, omega = self.phase[np.argmin(np.abs(self.phase[:, 0]))]
        return float(angle), float(omega)


def margins(loop: "StateSpace | TransferFunction") -> Margins:
    """The margins of 1 + L = 0 for a discrete-time loop L with one input and one output.

    L is real at z = -1: where it is negative there, half the sampling rate is a phase crossover.
    python-control's `stability_margins` finds crossings by a change of sign, and there is none at
    the end of the axis. The others are bracketed on a grid (4000 points over six decades) and
    refined: a pair of crossings closer than that is missed.

    Raises ValueError for a loop in continuous time or with several inputs or outputs.
    """
    if not loop.isdtime(strict=True) or loop.dt is True:
        raise ValueError(f"margins needs a discrete-time loop with its period, got dt={loop.dt!r}")
    if not loop.issiso():
        raise ValueError(
            f"margins needs one input and one output, got {loop.ninputs} x {loop.noutputs}"
        )
    dt = float(loop.dt)
    top = math.pi / dt

    def at(omega: float) -> complex:
        return complex(_response(loop, np.exp(1j * np.array([omega * dt])))[0])

    grid = top * np.logspace(-_DECADES, 0.0, _POINTS)[:-1]
    values = _response(loop, np.exp(1j * grid * dt))
    gain = [
        (1.0 / abs(at(omega)), omega)
        for omega in _zeros(lambda w: at(w).imag, grid, values.imag)
        if at(omega).real < 0.0
    ]
    end = at(top).real
    if end < 0.0:
        gain.append((-1.0 / end, top))
    crossings = _zeros(lambda w: math.log(abs(at(w))), grid, np.log(np.abs(values)))
    phase = [(np.angle(-at(omega)), omega) for omega in crossings]
    return Margins(np.reshape(gain, (-1, 2)), np.reshape(phase, (-1, 2)), dt)


def _response(
    loop: "StateSpace | TransferFunction", z: npt.NDArray[np.complex128]
) -> npt.NDArray[np.complex128]:
    """The loop at the points z, (n,); python-control's own takes a state space point by point."""
    if not hasattr(loop, "A"):
        return np.asarray(loop(z))
    shifted = z[:, None, None] * np.eye(len(loop.A)) - loop.A
    return np.asarray((loop.C @ np.linalg.solve(shifted, loop.B[None]) + loop.D)[:, 0, 0])


def _zeros(function: "Callable[[float], float]", grid: Array, values: Array) -> list[float]:
    """The zeros of a function, refined from changes of sign on a grid."""
    signs = np.sign(values)
    return [
        float(brentq(function, grid[i], grid[i + 1], xtol=1e-14 * grid[i], rtol=1e-14))
        for i in np.flatnonzero(signs[:-1] * signs[1:] < 0.0)
    ]
