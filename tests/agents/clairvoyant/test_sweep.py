"""The sweep: Riccati's where nothing binds, the least of a small programme where limits do."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

pytest.importorskip("casadi")
from sideslip.agents.clairvoyant.forecast import Linearisation
from sideslip.agents.clairvoyant.plan import Limits, _run_backward_pass, _solve_input_qp


def test_the_cheapest_step_is_that_of_bounded_least_squares() -> None:
    rng = np.random.default_rng(0)
    sides = set()
    for _ in range(300):
        root, target = rng.normal(size=(2, 2)), rng.normal(size=2)
        low, high = -rng.uniform(0.0, 2.0, 2), rng.uniform(0.0, 2.0, 2)
        found = _solve_input_qp(root.T @ root, -root.T @ target, low, high)
        best = lsq_linear(root, target, (low - 1e-12, high + 1e-12), tol=1e-14).x
        cost = [np.sum((root @ each - target) ** 2) for each in (found[:2], best)]
        assert cost[0] <= cost[1] + 1e-9
        inside = (low < found[:2]) & (found[:2] < high)
        assert inside.tolist() == list(found[2:])
        sides.add(tuple(found[2:]))
    assert len(sides) == 4  # free, at either limit, in a corner


def episode(K: int = 400) -> tuple[Linearisation, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    A, B = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    Q, R = np.diag([1.0, 2.0, 0.5]), np.diag([0.3, 0.7])
    F = np.tile(np.hstack([A, B]), (K, 1, 1))
    H = np.zeros((K + 1, 5, 5))
    H[:, :3, :3], H[:, 3:, 3:] = Q, R
    return Linearisation(F, np.zeros((K + 1, 5)), H), A, B, Q, R


def test_the_gains_are_the_regulators() -> None:
    """Far from the end they are those of the stationary Riccati equation, sign included."""
    slopes, A, B, Q, R = episode()
    K, zero = 400, np.zeros(400)
    limits = Limits(np.full((K, 2), -9.0), np.full((K, 2), 9.0), zero, zero, 0, 0.0)
    d, G = np.empty((K, 2)), np.empty((K, 2, 3))
    _run_backward_pass(slopes, limits, np.zeros((K, 2)), K, 0.0, d, G)
    P = solve_discrete_are(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(G[0], -gain, rtol=1e-9)
    assert not d.any()


def test_limits_hold_and_steering_at_the_end_of_its_rate_follows_its_past() -> None:
    slopes, *_ = episode()
    slopes.g[:] = 5.0
    K = 400
    low, high = np.full((K, 2), -1.0), np.full((K, 2), 1.0)
    rate_low, rate_high = np.full(K, -0.2), np.full(K, 0.3)
    inputs = np.full((K, 2), 0.1)
    d, G = np.empty((K, 2)), np.empty((K, 2, 3))
    limits = Limits(low, high, rate_low, rate_high, 2, 0.4)
    _run_backward_pass(slopes, limits, inputs, 300, 1e-3, d, G)
    steering = inputs[:300, 1] + d[:300, 1]
    assert np.all((steering >= -0.2 - 1e-12) & (steering <= 0.3 + 1e-12))
    assert np.all(np.abs(inputs[:300, 0] + d[:300, 0]) <= 1.0 + 1e-12)
    bound = (steering < -0.2 + 1e-12) | (steering > 0.3 - 1e-12)
    assert bound.any()
    np.testing.assert_array_equal(G[:300][bound][:, 1], np.tile([0.0, 0.0, 0.4], (bound.sum(), 1)))
    assert not d[300:].any() and not G[300:].any()
