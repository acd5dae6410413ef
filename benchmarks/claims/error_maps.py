"""Error maps of pseudo measurements, in NumPy and dual-rate's letters: its equations (22)-(32).

One slow sample y_k = C x_k + v_k every r steps; in between the innovation of the last sample is
carried on. Everything here is a map from the prediction error at the sample, X~_{k|k-1}.
Corrections: docs/PAPERS.md section 2.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...estimators.kalman import gain

Array = npt.NDArray[np.float64]


def fast(A: Array, C: Array, L: Array, r: int) -> list[Array]:
    """Maps to X~_{k+i|k+i}, i = 0 .. r-1, with a measurement at every step: (22) repeated."""
    I = np.eye(len(A))  # noqa: E741
    maps = [I - L @ C]
    for _ in range(1, r):
        maps.append((I - L @ C) @ A @ maps[-1])  # Omega of (22)
    return maps


def pseudo(A: Array, C: Array, L: Array, r: int) -> tuple[list[Array], Array]:
    """The same with pseudo measurements (14), G from (31), and the map to X~_{k+r|k+r-1}."""
    G = np.eye(len(C))  # G_k = I
    Psi: Array = np.eye(len(A))
    maps = []
    for i in range(r):
        if i > 0:
            G = least_squares(C, Psi)
        after = Psi - L @ G @ C  # (19) with the innovation C X~ of (13)
        maps.append(after)
        Psi = A @ after  # (26)
    return maps, Psi


def least_squares(C: Array, Psi: Array) -> Array:
    """G of (31): the least-squares solution of (30), G C = C Psi."""
    return np.asarray(np.linalg.solve(C @ C.T, C @ Psi.T @ C.T).T, np.float64)


def difference(ours: list[Array], wanted: list[Array]) -> float:
    """The largest relative difference of two sequences of maps."""
    return max(
        float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(ours, wanted, strict=True)
    )


@dataclass
class FromNoise:
    """Gains from the covariance of the pseudo measurement's noise: the step after (33).

    printed: (29) as printed, whose noise term is (I + C Lambda) V_k; else the corrected one,
    (G + C Lambda) V_k. `frame` goes from one sample to the next.
    """

    A: Array
    C: Array
    Q: Array
    R: Array
    r: int
    printed: bool = True

    def frame(self, P: Array) -> tuple[Array, Array]:
        """(P_{k+r|k+r-1}, the map to X~_{k+r|k+r-1}) from P_{k|k-1}."""
        A, C, R = self.A, self.C, self.R
        I, one = np.eye(len(A)), np.eye(len(C))  # noqa: E741
        G, Psi, Lambda = one, I, np.zeros((len(A), len(C)))
        noise = np.zeros_like(A)  # the covariance of Upsilon
        for i in range(self.r):
            R_star = R
            if i > 0:
                G = least_squares(C, Psi)  # (31)
                of_v = (one if self.printed else G) + C @ Lambda
                R_star = C @ noise @ C.T + of_v @ R @ of_v.T  # of V*, (29)
            L = gain(P, C, R_star)
            P = (I - L @ C) @ P
            P = A @ (0.5 * (P + P.T)) @ A.T + self.Q
            Psi = A @ (Psi - L @ G @ C)  # (26)
            Lambda = A @ (Lambda + L @ G)  # (28)
            noise = A @ noise @ A.T + self.Q  # (27)
        return P, Psi

    def spectral_radius(self, P: Array, frames: int) -> float:
        """Of the map over the last of some frames."""
        Psi = P
        for _ in range(frames):
            P, Psi = self.frame(P)
        return float(np.abs(np.linalg.eigvals(Psi)).max())
