"""Error maps between slow samples: dual-rate's equations (13)-(34) written out, slowly."""

import numpy as np
import numpy.typing as npt

from sideslip.benchmarks.papers import theory
from sideslip.estimators.design.kalman import kalman_gain

Array = npt.NDArray[np.float64]


def test_pseudo_measurements_equal_fast_ones_for_square_c_only() -> None:
    """dual-rate (33): the maps agree where (30) can be solved."""
    rng = np.random.default_rng(5)
    A = 0.97 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for outputs, equal in ((3, True), (2, False)):
        C = rng.normal(size=(outputs, 3))
        L = kalman_gain(np.eye(3), C, np.eye(outputs))
        ours = theory.make_maps("pseudo", A, C, L, 10)
        off = theory.compute_difference(ours, theory.make_maps("fast", A, C, L, 10))
        assert off < 1e-12 if equal else off > 0.1


def test_the_maps_are_what_a_simulated_error_does() -> None:
    """(13)-(14), (17), (19) and (31)-(32) step by step, without noise."""
    rng = np.random.default_rng(6)
    A, C = 0.3 * rng.normal(size=(3, 3)), rng.normal(size=(1, 3))
    L = 0.3 * rng.normal(size=(3, 1))
    maps = theory.make_maps("pseudo", A, C, L, 3)
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


def test_prediction_alone_moves_what_the_sample_left() -> None:
    """(34)."""
    rng = np.random.default_rng(7)
    A, C, L = rng.normal(size=(3, 3)), rng.normal(size=(2, 3)), rng.normal(size=(3, 2))
    maps = theory.make_maps("predicted", A, C, L, 4)
    np.testing.assert_allclose(maps[3], A @ A @ A @ (np.eye(3) - L @ C))
