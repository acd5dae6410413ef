"""The dual-rate estimator for any linear system: dual-rate (1)-(36) as the paper states it.

x_{k+1} = a x_k + b u_k + x_d,k + w_k,    y_k = c x_k + v_k at k = 0, r, 2 r, ...
x_d,k+1 = a_d x_d,k + u_d + w_d,k
"""

import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.validation import check_choice
from ..design.gains import (
    DUAL_RATE_GAINS,
    DUAL_RATE_RULES,
    SampledSystem,
    check_covariance,
    frame_map,
)
from ..design.periodic import MARGINAL, find_unobservable, spectral_radius
from ..protocol import Estimates, UnobservableWarning, compute_std


class DualRate:
    """A filter for x_{k+1} = A x_k + B u_k measured as y = C x once every `ratio` steps.

    ValueError: a wrong shape, no covariance, poles that cannot be placed, or a growing error.

    Args:
        A: Transition matrix, shape (m, m).
        B: Input matrix, shape (m, p).
        C: Measurement matrix, shape (q, m).
        ratio: Steps between two samples, r >= 1.
        Q: Covariance of a step's process noise, shape (m, m) or (m,).
        R: Covariance of the measurement noise, shape (q, q) or (q,).
        disturbed: Rows of x that d extended states x_d push, dual-rate (4)-(5); None for none.
        leak: a_d of (7), a number, (d,) or (d, d).
        rate: u_d of (7), a number or (d,).
        Q_d: Covariance of w_d, a number, (d,) or (d, d).
        intersample: "pseudo" (14)-(32), "oh" (35), "hold" (Hara) or "predict" (34).
        gains: "constant", "from-29" or "placed".
        poles: Poles in the z-plane for one step, shape (m + d,), for "placed": of (I - L C) A,
            (22), for "pseudo" and "oh", of the single-rate filter, each to the power r, for the
            others.
        start: x at k = 0, shape (m,); None for zeros.
        allow_unstable: Whether a filter whose error grows is accepted.

    Attributes:
        x: Present state with x_d, shape (m + d,); `names` has their names.
        k: Present step.
        spectral_radius: Spectral radius of the error from sample to sample.
        unobservable: Directions that the measurement cannot see.
        shares: L_{k+i} G_{k+i} of (14) and (19), shape (r, m + d, q).
    """

    def __init__(
        self, A: npt.ArrayLike, B: npt.ArrayLike, C: npt.ArrayLike, ratio: int, *,
        Q: npt.ArrayLike, R: npt.ArrayLike, disturbed: Sequence[int] | None = None,
        leak: npt.ArrayLike = 1.0, rate: npt.ArrayLike = 0.0, Q_d: npt.ArrayLike = 0.0,
        intersample: str = "pseudo", gains: str = "constant", poles: npt.ArrayLike | None = None,
        start: npt.ArrayLike | None = None, allow_unstable: bool = False,
    ) -> None:  # fmt: skip
        a, b, c = (_parse_matrix(name, M) for name, M in zip("ABC", (A, B, C), strict=True))
        m, rows = len(a), _parse_disturbed(disturbed, len(a))
        if a.shape != (m, m) or len(b) != m or c.shape[1] != m:
            shapes = f"{a.shape}, {b.shape}, {c.shape}"
            raise ValueError(f"A, B and C have shapes (m, m), (m, p) and (q, m), got {shapes}")
        if not (ratio >= 1 and ratio % 1 == 0):
            raise ValueError(f"ratio is a whole number of steps, at least 1, got {ratio!r}")
        n, d, q = m + len(rows), len(rows), len(c)
        F, self._B, self._drift = np.zeros((n, n)), np.zeros((n, b.shape[1])), np.zeros(n)
        F[:m, :m], self._B[:m] = a, b
        F[rows, range(m, n)] = 1.0  # (5)
        F[m:, m:] = _parse_array("leak", leak, d, d)  # (11)
        self._drift[m:] = _parse_array("rate", rate, d)
        noise = np.zeros((n, n))
        noise[:m, :m] = _parse_array("Q", Q, m, m)  # (12)
        noise[m:, m:] = _parse_array("Q_d", Q_d, d, d)
        measured, r = np.hstack([c, np.zeros((q, d))]), _parse_array("R", R, q, q)
        for name, M in (("Q", noise[:m, :m]), ("Q_d", noise[m:, m:]), ("R", r)):
            check_covariance(name, M, definite=name == "R")
        placed = _parse_poles(intersample, gains, poles, n)
        system = SampledSystem(F, noise, measured, r, int(ratio))
        with np.errstate(invalid="ignore", over="ignore"):
            shares = system.compute_shares(intersample, gains, placed)
        self.names = tuple([*(f"x{i + 1}" for i in range(m)), *(f"d{i + 1}" for i in rows)])
        self.shares, self.ratio, self._F, self._C = shares, int(ratio), F, measured
        self._check_stability(F, measured, allow_unstable)
        self._std = compute_std(system.compute_covariances(shares))  # after each step of a cycle
        self._start = np.zeros(n)
        self._start[:m] = _parse_array("start", 0.0 if start is None else start, m)
        self.reset()

    def _check_stability(self, F: Array, C: Array, allow_unstable: bool) -> None:
        """Check that the error does not grow; warn of what the measurement cannot see."""
        M = frame_map(F, C, self.shares)
        self.spectral_radius = spectral_radius(M) if np.isfinite(M).all() else np.inf
        self.unobservable: tuple[str, ...] = ()
        if self.spectral_radius > 1.0 + MARGINAL:
            if not allow_unstable:
                raise ValueError(
                    f"the error grows by a factor of {self.spectral_radius:.6g} from sample to "
                    "sample (allow_unstable=True builds it all the same)"
                )
        elif self.spectral_radius >= 1.0 - MARGINAL:
            self.unobservable = find_unobservable(M, self.names)
            text = f"the measurement cannot see: {'; '.join(self.unobservable)}"
            warnings.warn(text, UnobservableWarning, stacklevel=3)

    def reset(self) -> None:
        """Reset to k = 0, before the first sample."""
        self.x, self.k = self._start.copy(), 0
        self._innovation, self._since = np.zeros(len(self._C)), self.ratio  # steps since a sample

    def step(self, u: npt.ArrayLike) -> None:
        """Step from k to k+1: dual-rate (17), (19).

        Args:
            u: Input of the step, shape (p,).
        """
        u = _parse_array("u", u, self._B.shape[1])
        self.x = self._F @ self.x + self._B @ u + self._drift
        self.k, self._since = self.k + 1, self._since + 1
        if self._since < self.ratio:
            self.x = self.x + self.shares[self._since] @ self._innovation

    def update(self, y: npt.ArrayLike) -> None:
        """Correct by the one sample of this k, a multiple of r, else ValueError: dual-rate (13).

        Args:
            y: Sample, finite, shape (q,).
        """
        if self.k % self.ratio:
            raise ValueError(f"a sample comes every {self.ratio} steps, this is step {self.k}")
        if self._since == 0:
            raise ValueError(f"step {self.k} has had its sample")
        self._innovation = _parse_array("y", y, len(self._C)) - self._C @ self.x
        self._since = 0
        self.x = self.x + self.shares[0] @ self._innovation

    def run(self, U: npt.ArrayLike, Y: npt.ArrayLike) -> Estimates:
        """Reset, then filter inputs and samples of k = 0, r, 2 r, ...; time is in steps.

        Args:
            U: Inputs, finite, shape (K, p), else ValueError.
            Y: Samples, shape (K // r + 1, q); a row that holds a NaN is a sample that never came.
        """
        u, y = np.array(U, np.float64), np.array(Y, np.float64)
        p, q = self._B.shape[1], len(self._C)
        u = u.reshape(len(u), -1) if u.ndim else u
        y = y.reshape(len(y), -1) if y.ndim else y
        if u.ndim != 2 or u.shape[1] != p or not np.isfinite(u).all():
            raise ValueError(f"U is finite and has shape (K, {p}), got {np.shape(U)}")
        count = len(u) // self.ratio + 1
        if y.shape != (count, q) or np.isinf(y).any():
            raise ValueError(f"Y is finite or NaN and has shape ({count}, {q}), got {np.shape(Y)}")
        self.reset()
        X = np.empty((len(u) + 1, len(self.names)))
        for k in range(len(X)):
            if k % self.ratio == 0 and not np.isnan(y[k // self.ratio]).any():
                self.update(y[k // self.ratio])
            X[k] = self.x
            if k < len(u):
                self.step(u[k])
        S = self._std[np.arange(len(X)) % self.ratio]
        return Estimates(np.arange(float(len(X))), X, S, self.names, np.full(count, np.nan))


def _parse_disturbed(rows: Sequence[int] | None, m: int) -> list[int]:
    """Parse the rows of x that a disturbance pushes; ValueError for an unknown or repeated one."""
    chosen = [] if rows is None else [int(row) for row in rows]
    if len(set(chosen)) != len(chosen) or any(not 0 <= row < m for row in chosen):
        raise ValueError(f"disturbed holds different rows from 0 to {m - 1}, got {rows!r}")
    return chosen


def _parse_poles(
    intersample: str, gains: str, poles: npt.ArrayLike | None, n: int
) -> npt.NDArray[np.complex128] | None:
    """Parse the poles to place, (n,); ValueError for a contradiction or an unknown rule or gain."""
    check_choice("intersample", intersample, DUAL_RATE_RULES)
    check_choice("gains", gains, DUAL_RATE_GAINS)
    if gains == "from-29" and intersample != "pseudo":
        raise ValueError("gains 'from-29' are those of intersample='pseudo'")
    if (gains == "placed") != (poles is not None):
        raise ValueError(f"poles are for gains='placed', got gains={gains!r} and poles={poles!r}")
    if poles is None:
        return None
    placed = np.array(poles, np.complex128)
    if placed.shape != (n,) or not np.isfinite(placed).all():
        raise ValueError(f"{n} states need {n} finite poles, got {poles!r}")
    return placed


def _parse_matrix(name: str, value: npt.ArrayLike) -> Array:
    """Parse a finite matrix of any shape (k, m); ValueError for anything else."""
    M = np.array(value, np.float64)
    if M.ndim != 2 or not M.size or not np.isfinite(M).all():
        raise ValueError(f"{name} is a finite matrix, got {value!r}")
    return M


def _parse_array(name: str, value: npt.ArrayLike, *shape: int) -> Array:
    """Parse finite numbers; one stands for equal ones, (n,) for a diagonal; else ValueError."""
    M = np.array(value, np.float64)
    M = np.full(shape[:1], M) if M.ndim == 0 else M
    M = np.diag(M) if M.ndim < len(shape) else M
    if M.shape != shape or not np.isfinite(M).all():
        shapes = " or ".join(str(shape[i:]) for i in range(len(shape)))
        raise ValueError(f"{name} is finite and has shape {shapes}, got {value!r}")
    return M
