"""The best two inputs within limits, against a search over the whole rectangle."""

import numpy as np
import pytest

from sideslip.agents.controllers.lqr import _solve_box_qp


@pytest.mark.parametrize("seed", range(30))
def test_nothing_within_the_limits_costs_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    S = root @ root.T + 0.01 * np.eye(2)
    free, (low, high) = rng.normal(size=2) * 3.0, np.sort(rng.normal(size=2))
    u, w = _solve_box_qp(S[0, 0], S[0, 1], S[1, 1], free[0], free[1], 1.0, low, high)
    assert abs(u) <= 1.0 and low <= w <= high
    grid = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 201), np.linspace(low, high, 201)), -1)
    off = grid - free
    costs = np.einsum("...i,ij,...j", off, S, off)
    found = np.array([u, w]) - free
    assert found @ S @ found <= costs.min() + 1e-12


def test_what_is_within_the_limits_stays() -> None:
    assert _solve_box_qp(1.0, 0.9, 1.0, 0.3, -0.2, 1.0, -0.5, 0.5) == (0.3, -0.2)
