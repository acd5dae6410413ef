"""Gains in textbook letters: Kalman's, placed poles, generalised inverses, and dual-rate's shares.

At fixed speed and ratio r, every rule of dual-rate is x_{k+i} = F x_{k+i-1} + H u + B_i eps_k for
i = 0 .. r-1, with the last innovation eps_k: B_i = L G_i with the gain L and the matrix G_i of the
pseudo measurement (14).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ..core.memory import FilterMemory

Poles = Array | npt.NDArray[np.complex128]
INVERSES = ("moore-penrose", "p-weighted", "tikhonov", "bayes")
DUAL_RATE_RULES = ("predict", "hold", "oh", "pseudo")
"""Corrections of dual-rate filters between slow samples."""
DUAL_RATE_GAINS = ("constant", "from-29", "placed")
_RIDGE = 1e-3  # lambda of Tikhonov's inverse, in the square of a row's SI unit
_CYCLES, _SETTLED = 400, 1e-12  # most samples of a recursion, relative change where it ends


def check_covariance(name: str, M: Array, definite: bool = False) -> None:
    """Check that a matrix is a covariance: finite, symmetric, semidefinite; else ValueError.

    Args:
        name: Name for messages.
        M: Matrix, shape (n, n).
        definite: Whether it must be positive definite.
    """
    if not np.isfinite(M).all():
        raise ValueError(f"{name} is not finite")
    if not np.allclose(M, M.T, rtol=1e-9, atol=0.0):
        raise ValueError(f"{name} is not symmetric")
    lowest = np.linalg.eigvalsh(M).min(initial=np.inf)
    if lowest < -1e-12 * np.abs(M).max(initial=1e-300):
        raise ValueError(f"{name} is indefinite: its least eigenvalue is {lowest:.3g}")
    if definite and not lowest > 0.0:
        raise ValueError(f"{name} must be positive definite: its least eigenvalue is {lowest:.3g}")


def kalman_gain(P: Array, C: Array, R: Array) -> Array:
    """Compute the Kalman gain K = P C^T (C P C^T + R)^-1, shape (n, p).

    With R = 0 it is a generalised inverse of C: the Moore-Penrose one for P = I, the P-weighted
    one for a covariance P; with P = I, R = lambda I it is Tikhonov's.
    """
    PC = P @ C.T
    return np.asarray(np.linalg.solve((C @ PC + R).T, PC.T).T, np.float64)


def joseph_form(P: Array, K: Array, C: Array, R: Array) -> Array:
    """Compute P after a correction by any gain: (I - K C) P (I - K C)^T + K R K^T, P before it.

    A sum of two squares stays symmetric and positive semidefinite under rounding.
    """
    rest = np.eye(len(P)) - K @ C
    return np.asarray(rest @ P @ rest.T + K @ R @ K.T)


def compute_inverse(kind: str, C: Array, P: Array, R: Array) -> Array:
    """Compute the generalised inverse of C, shape (n, p), that tie-vision (20) needs.

    C has full row rank only, so C^T C of the printed (20) is singular; the Moore-Penrose inverse is
    C^T (C C^T)^-1. "bayes" is the mean of the error given the residual, P C^T (C P C^T + R)^-1: for
    an optimal gain it leaves nothing to correct between the samples.

    Args:
        kind: Name of `INVERSES`; "p-weighted" weighs by P, "tikhonov" is regularised by `_RIDGE`.
        C: Measurement matrix, shape (p, n).
        P: Covariance of the state, shape (n, n).
        R: Covariance of the measurement noise, shape (p, p).
    """
    zero, ridge = np.zeros((len(C), len(C))), _RIDGE * np.eye(len(C))
    noises = {"moore-penrose": zero, "p-weighted": zero, "tikhonov": ridge, "bayes": R}
    return kalman_gain(P if kind in ("p-weighted", "bayes") else np.eye(len(P)), C, noises[kind])


def transition_matrix(f: FilterMemory, G: Array) -> Array:
    """Compute F (n, n) of a step: G on the dense states, the others decay."""
    n, dense = int(f.n), len(G)
    F = np.zeros((n, n))
    F[:dense] = G
    F[range(dense, n), range(dense, n)] = f.decay[dense:n]
    return F


def observer_gain(F: Array, C: Array, poles: Poles) -> Array:
    """Compute the gain K (n, p) that gives (I - K C) F its poles; ValueError where none does.

    Args:
        F: Transition matrix, shape (n, n).
        C: Measurement matrix, shape (p, n).
        poles: Poles in the z-plane, shape (n,), no more equal ones than there are outputs.
    """
    try:
        from scipy.signal import place_poles  # slow to load

        K: Array = place_poles(F.T, (C @ F).T, poles).gain_matrix.T
    except ValueError as error:
        raise ValueError(f"the poles {np.round(poles, 6)} cannot be placed: {error}") from None
    placed = np.linalg.eigvals((np.eye(len(F)) - K @ C) @ F)
    if np.abs(np.sort_complex(placed) - np.sort_complex(poles)).max() > 1e-6:
        raise ValueError(f"the poles {np.round(poles, 6)} cannot be placed: not observable")
    return K


class SampledSystem(NamedTuple):
    """A linear system whose output is sampled every few steps."""

    F: Array  # transition matrix of a step, shape (n, n)
    Q: Array  # covariance of a step's process noise, shape (n, n)
    C: Array  # measurement matrix, shape (q, n)
    R: Array  # covariance of the measurement noise, shape (q, q)
    steps: int  # between two samples

    def compute_shares(self, rule: str, gains: str, poles: Poles | None) -> Array:
        """Compute B_i of a rule, shape (steps, n, q).

        Args:
            rule: Name of `DUAL_RATE_RULES`.
            gains: Name of `DUAL_RATE_GAINS`.
            poles: Poles in the z-plane for one step, shape (n,), for gains "placed": of the
                fast-rate filter (I - L C) F for "oh" and "pseudo", of the single-rate one, to the
                power of `steps`, for the others.
        """
        F, C, steps, is_single_rate = self.F, self.C, self.steps, rule in ("predict", "hold")
        if gains == "from-29":
            return self.compute_shares_29()
        if gains == "placed":
            assert poles is not None
            exponent = steps if is_single_rate else 1
            L = observer_gain(np.linalg.matrix_power(F, exponent), C, poles**exponent)
        else:
            L = self._compute_sampled_gain()
        if rule == "hold":
            return self._compute_hold_shares(L)
        if rule == "predict":
            return np.concatenate([L[None], np.zeros((steps - 1, *L.shape))])
        if gains == "constant":
            L = L / steps  # every step takes an even part
        inverse = compute_inverse("moore-penrose", C, np.eye(len(F)), self.R)
        return compute_pseudo_shares(F, C, L, inverse - L, steps)

    def _compute_sampled_gain(self) -> Array:
        """Compute the limit of the Kalman gain (n, q) of a sample every `steps` steps."""
        F, Q, C, R, steps = self
        n = len(F)
        power, noise = np.eye(n), np.zeros((n, n))
        for _ in range(steps):
            power, noise = F @ power, F @ noise @ F.T + Q
        P, K = noise.copy(), np.zeros((n, len(C)))
        for _ in range(_CYCLES):
            before, K = K, kalman_gain(P, C, R)
            P = power @ joseph_form(P, K, C, R) @ power.T + noise
            if np.abs(K - before).max() <= _SETTLED * np.abs(K).max():
                break
        return K

    def _compute_hold_shares(self, K: Array) -> Array:
        """Compute Hara's B_i = L for all i, (steps, n, q), with poles and map of the sampled K."""
        # the innovation is held: F^r - sum_{i=1}^{r} F^i L C = F^r (I - K C)
        power, total = np.eye(len(self.F)), np.zeros_like(self.F)
        for _ in range(self.steps):
            power = self.F @ power
            total = total + power
        L = np.linalg.solve(total, power @ K)
        return np.repeat(L[None], self.steps, axis=0)

    def compute_shares_29(self) -> Array:
        """Compute the limits of B_i = L_i G_i (steps, n, q), G_i of (31), Kalman gains for (29).

        The covariance recursion is the paper's, which takes pseudo measurements for independent
        ones; its error can grow (by 1.17 to 1.22 a sample for a course alone).
        """
        F, Q, C, R, steps = self
        n, q = len(F), len(C)
        pinv = compute_inverse("moore-penrose", C, np.eye(n), R)
        P, shares = Q.copy(), np.zeros((steps, n, q))
        for _ in range(_CYCLES):
            before = shares.copy()
            P = F @ P @ F.T + Q
            for i in range(steps):
                if i == 0:
                    G, noise = np.eye(q), R
                    Psi, Upsilon, Lambda = np.eye(n), np.zeros((n, n)), np.zeros((n, q))
                else:  # (26)-(28), one step on: all that came before is moved by F
                    Psi = F @ (Psi - shares[i - 1] @ C)
                    Upsilon = F @ Upsilon @ F.T + Q
                    Lambda = F @ (Lambda + shares[i - 1])
                    G = C @ Psi @ pinv  # (31)
                    v = G + C @ Lambda
                    noise = C @ Upsilon @ C.T + v @ R @ v.T  # (29)
                    P = F @ P @ F.T + Q
                L = kalman_gain(P, C, noise)
                P = joseph_form(P, L, C, noise)
                shares[i] = L @ G
            if np.abs(shares - before).max() <= _SETTLED * np.abs(shares).max():
                break
        return shares

    def compute_covariances(self, B: Array) -> Array:
        """Compute the error's covariances after each step, (steps, n, n), that B_i lead to.

        Args:
            B: B_i, shape (steps, n, q).
        """
        steps, n, q = B.shape
        covariances = np.zeros((steps, n, n))
        P = np.zeros((n + q, n + q))  # of the error and the last innovation
        predict_map = np.eye(n + q)
        predict_map[:n, :n] = self.F
        measure_map = np.block([[np.eye(n), np.zeros((n, q))], [self.C, np.zeros((q, q))]])
        for _ in range(30):
            for i, share in enumerate(B):
                P = predict_map @ P @ predict_map.T
                P[:n, :n] += self.Q
                if i == 0:
                    P = measure_map @ P @ measure_map.T
                    P[n:, n:] += self.R
                correct_map = np.eye(n + q)
                correct_map[:n, n:] = -share
                P = correct_map @ P @ correct_map.T
                covariances[i] = P[:n, :n]
        return covariances


def compute_pseudo_shares(F: Array, C: Array, L: Array, first: Array, steps: int) -> Array:
    """Compute B_i (steps, n, q) of the pseudo measurement with one gain: (31) and Oh's (35).

    B_i = L C F [(I - L C) F]^(i-1) E.

    Args:
        F: Transition matrix of a step, shape (n, n).
        C: Measurement matrix, shape (q, n).
        L: Gain, shape (n, q).
        first: E, the estimated error after the sample over its innovation, C^+ - L, shape (n, q).
        steps: Number of steps between two samples.
    """
    shares, e = [L], first
    for _ in range(1, steps):
        propagated = F @ e
        shares.append(L @ C @ propagated)
        e = propagated - L @ C @ propagated
    return np.array(shares)


def frame_map(F: Array, C: Array, shares: Array) -> Array:
    """Compute the map (n, n) from the error before a sample to that before the next one."""
    M, eps = np.eye(len(F)), C
    for B in shares:
        M = F @ (M - B @ eps)
    return M
