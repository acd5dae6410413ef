"""Error maps between slow samples: dual-rate's equations (13)-(34) written out, slowly."""

import numpy as np
import numpy.typing as npt
import pytest

from sideslip.benchmarks.papers.dual_rate import (
    COURSE_SD,
    RATIO,
    _make_pseudo_maps,
    compare_maps,
    make_extended_model,
)
from sideslip.estimators.design import gains as spread
from sideslip.estimators.design.gains import kalman_gain

Array = npt.NDArray[np.float64]


def test_pseudo_measurements_equal_fast_ones_for_square_c_only() -> None:
    """dual-rate (33): the maps agree where (30) can be solved."""
    rng = np.random.default_rng(5)
    A = 0.97 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for outputs, equal in ((3, True), (2, False)):
        C = rng.normal(size=(outputs, 3))
        L = kalman_gain(np.eye(3), C, np.eye(outputs))
        off = compare_maps(A, C, L, 10)
        assert off < 1e-12 if equal else off > 0.1


def test_the_maps_are_what_a_simulated_error_does() -> None:
    """(13)-(14), (17), (19) and (31)-(32) step by step, without noise."""
    rng = np.random.default_rng(6)
    A, C = 0.3 * rng.normal(size=(3, 3)), rng.normal(size=(1, 3))
    L = 0.3 * rng.normal(size=(3, 1))
    maps = _make_pseudo_maps(A, C, L, 3)
    x, start = rng.normal(size=3), rng.normal(size=3)
    hat = x - start
    innovation = C @ (x - hat)  # (13)
    hat = hat + L @ innovation
    np.testing.assert_allclose(maps[0] @ start, x - hat)
    C_plus = C.T @ np.linalg.inv(C @ C.T)
    G1 = C @ A @ (np.eye(3) - L @ C) @ C_plus  # (32)
    x, hat = A @ x, A @ hat
    pseudo = C @ hat + G1 @ innovation  # (14)
    hat = hat + L @ (pseudo - C @ hat)  # (19)
    np.testing.assert_allclose(maps[1] @ start, x - hat)
    Psi = A @ A @ (np.eye(3) - L @ C) - A @ L @ G1 @ C  # (26) for i = 2
    G2 = C @ Psi @ C_plus  # (31)
    x, hat = A @ x, A @ hat
    hat = hat + L @ G2 @ innovation
    np.testing.assert_allclose(maps[2] @ start, x - hat)


def radius_of_29(q: Array, printed: bool, frames: int = 30) -> float:
    """Growth of dual-rate's error over a frame with gains from (29), its formulas one by one.

    printed: the noise term is (I + C Lambda) V_k, as printed; else (G + C Lambda) V_k.
    """
    A, C = make_extended_model()
    I, one, R, Q = np.eye(6), np.eye(1), np.array([[COURSE_SD**2]]), np.diag(q) * 1e-3  # noqa: E741
    P = 0.01 * np.eye(6)
    for _ in range(frames):
        G, Psi, Lambda, noise = one, I, np.zeros((6, 1)), np.zeros((6, 6))
        for i in range(RATIO):
            R_star = R
            if i > 0:
                G = C @ Psi @ C.T @ np.linalg.inv(C @ C.T)  # (31)
                of_v = (one if printed else G) + C @ Lambda
                R_star = C @ noise @ C.T + of_v @ R @ of_v.T  # of V*, (29)
            L = kalman_gain(P, C, R_star)
            P = (I - L @ C) @ P
            P = A @ (0.5 * (P + P.T)) @ A.T + Q
            Psi = A @ (Psi - L @ G @ C)  # (26)
            Lambda = A @ (Lambda + L @ G)  # (28)
            noise = A @ noise @ A.T + Q  # (27)
    return float(np.abs(np.linalg.eigvals(Psi)).max())


@pytest.mark.parametrize("strength", [5.0, 20.0])
def test_gains_from_the_pseudo_noise_grow(strength: float) -> None:
    """An independent trial found a radius of 1.17 to 1.22, as printed and as corrected."""
    q = np.array([1e-4, 1e-4, 1e-4, strength, strength, strength])
    A, C = make_extended_model()
    R = np.array([[COURSE_SD**2]])
    shares = spread.SampledSystem(A, np.diag(q) * 1e-3, C, R, RATIO).compute_shares_29()
    ours = float(np.abs(np.linalg.eigvals(spread.frame_map(A, C, shares))).max())
    corrected, printed = radius_of_29(q, False), radius_of_29(q, True)
    assert ours == pytest.approx(corrected, rel=1e-3)
    assert 1.1 < corrected < 1.3
    assert 1.1 < printed < 1.3
