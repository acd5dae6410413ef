"""The textbook equations: conditioning, Joseph's form, generalised inverses."""

from typing import Any

import numpy as np
import pytest

from sideslip.estimators.design.gains import joseph_form, kalman_gain

pytestmark = [pytest.mark.smoke, pytest.mark.plain]


def some(seed: Any) -> Any:
    rng = np.random.default_rng(seed)
    A, C = rng.standard_normal((4, 4)), rng.standard_normal((2, 4))
    L = rng.standard_normal((2, 2))
    return rng, A @ A.T, C, L @ L.T


def test_the_gain_is_conditioning_of_the_joint_gaussian() -> None:
    rng, P, C, R = some(0)
    x, y = rng.standard_normal(4), rng.standard_normal(2)
    joint = np.block([[P, P @ C.T], [C @ P, C @ P @ C.T + R]])
    S = np.linalg.inv(joint[4:, 4:])
    K = kalman_gain(P, C, R)
    mean, cov = x + K @ (y - C @ x), joseph_form(P, K, C, R)
    np.testing.assert_allclose(mean, x + joint[:4, 4:] @ S @ (y - C @ x), rtol=1e-10)
    np.testing.assert_allclose(cov, P - joint[:4, 4:] @ S @ joint[4:, :4], rtol=1e-9, atol=1e-12)


def test_no_gain_leaves_less_covariance_than_the_kalman_gain() -> None:
    rng, P, C, R = some(2)
    best = np.trace(joseph_form(P, kalman_gain(P, C, R), C, R))
    for _ in range(20):
        other = kalman_gain(P, C, R) + 0.1 * rng.standard_normal((4, 2))
        after = joseph_form(P, other, C, R)
        assert np.trace(after) > best
        assert np.linalg.eigvalsh(after).min() > 0.0


def test_without_noise_the_gain_is_a_generalised_inverse() -> None:
    _, P, C, _ = some(3)
    zero = np.zeros((2, 2))
    np.testing.assert_allclose(kalman_gain(np.eye(4), C, zero), np.linalg.pinv(C), rtol=1e-10)
    np.testing.assert_allclose(C @ kalman_gain(P, C, zero), np.eye(2), atol=1e-12)
    ridge = np.linalg.solve(C.T @ C + 0.1 * np.eye(4), C.T)
    np.testing.assert_allclose(kalman_gain(np.eye(4), C, 0.1 * np.eye(2)), ridge, rtol=1e-9)
