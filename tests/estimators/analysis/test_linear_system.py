"""The dual-rate estimator's face: its standard deviations, what it cannot see, bad input."""

from typing import Any

import numpy as np
import pytest

from sideslip.estimators import DualRate
from tests.estimators.filters.test_dual_rate import random_system

pytestmark = pytest.mark.plain


@pytest.mark.compiled
def test_every_step_has_its_standard_deviation() -> None:
    """Against the spread of the error over many runs with noise of the model's kind."""
    s = random_system(1) | {"disturbed": None, "leak": 1.0, "rate": 0.0, "Q_d": 0.0, "ratio": 4}
    filter_ = DualRate(**s, intersample="hold", allow_unstable=True)
    a, c, r, rng = s["A"], s["C"], s["ratio"], np.random.default_rng(0)
    K, runs = 40 * r, 60
    squares = np.zeros((r, len(a)))
    for _ in range(runs):
        w = rng.multivariate_normal(np.zeros(len(a)), s["Q"], K)
        x = np.zeros((K + 1, len(a)))
        for k in range(K):
            x[k + 1] = a @ x[k] + w[k]
        v = rng.multivariate_normal(np.zeros(len(c)), s["R"], K // r + 1)
        found = filter_.run(np.zeros((K, s["B"].shape[1])), x[::r] @ c.T + v)
        error = (found.x - x)[20 * r : 40 * r].reshape(20, r, -1)
        squares += np.mean(error**2, axis=0) / runs
    np.testing.assert_allclose(np.sqrt(squares), found.std[20 * r : 21 * r], rtol=0.15)


GOOD: dict[str, Any] = {
    "A": [[0.9, 0.1], [0.0, 0.8]], "B": [[1.0], [0.0]], "C": [[1.0, 0.0]], "ratio": 5, "Q": 0.1,
    "R": 1.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"A": [[1.0, 0.0]]}, r"shapes \(m, m\), \(m, p\) and \(q, m\), got \(1, 2\)"),
        ({"A": [0.9]}, "A is a finite matrix"),
        ({"B": [[np.nan], [0.0]]}, "B is a finite matrix"),
        ({"C": [[1.0]]}, r"got \(2, 2\), \(2, 1\), \(1, 1\)"),
        ({"ratio": 0}, "ratio is a whole number of steps, at least 1, got 0"),
        ({"ratio": 2.5}, "whole number"),
        ({"ratio": np.inf}, "whole number"),
        ({"Q": [[1.0, 2.0], [2.0, 1.0]]}, "Q is indefinite"),
        ({"Q": [1.0, 2.0, 3.0]}, r"Q is finite and has shape \(2, 2\) or \(2,\)"),
        ({"R": -1.0}, "R is indefinite"),
        ({"R": 0.0}, "R must be positive definite"),
        ({"disturbed": (2,)}, "different rows from 0 to 1"),
        ({"disturbed": (0, 0)}, "different rows"),
        ({"disturbed": (0,), "Q_d": -1.0}, "Q_d is indefinite"),
        ({"disturbed": (0,), "leak": [1.0, 2.0]}, r"leak is finite and has shape \(1, 1\) or"),
        ({"disturbed": (0,), "rate": np.inf}, "rate is finite"),
        ({"intersample": "guess"}, "unknown intersample 'guess'; known: predict, hold, oh, pseudo"),
        ({"gains": "loud"}, "unknown gains 'loud'; known: constant, from-29, placed"),
        ({"intersample": "oh", "gains": "from-29"}, "from-29.*pseudo"),
        ({"gains": "placed"}, "poles are for gains='placed'"),
        ({"poles": [0.5, 0.6]}, "poles are for gains='placed'"),
        ({"gains": "placed", "poles": [0.5]}, "2 states need 2 finite poles"),
        ({"disturbed": (0, 1), "gains": "placed", "poles": [0.5, 0.6, 0.7, 0.8]}, "be placed"),
        ({"A": [[1.5, 0.0], [0.0, 1.2]]}, "error grows"),
        ({"start": [1.0, 2.0, 3.0]}, r"start is finite and has shape \(2,\)"),
    ],
)
def test_bad_systems_are_refused(bad: Any, message: Any) -> None:
    with pytest.raises(ValueError, match=message):
        DualRate(**(GOOD | bad))


def test_bad_signals_are_refused() -> None:
    filter_ = DualRate(**GOOD, start=[1.0, -1.0])
    np.testing.assert_array_equal(filter_.x, [1.0, -1.0])
    assert filter_.names == ("x1", "x2") and filter_.k == 0 and filter_.spectral_radius < 1.0
    for U, Y in ((np.zeros((10, 2)), np.zeros(3)), (np.full(10, np.nan), np.zeros(3))):
        with pytest.raises(ValueError, match=r"U is finite and has shape \(K, 1\)"):
            filter_.run(U, Y)
    bad: tuple[Any, ...] = (np.zeros(2), np.zeros((3, 2)), [0.0, np.inf, 0.0])
    for Y in bad:
        with pytest.raises(ValueError, match=r"Y is finite or NaN and has shape \(3, 1\)"):
            filter_.run(np.zeros(10), Y)
    filter_.reset()
    filter_.update(0.5)
    with pytest.raises(ValueError, match="step 0 has had its sample"):
        filter_.update(0.5)
    filter_.step(0.0)
    with pytest.raises(ValueError, match="a sample comes every 5 steps, this is step 1"):
        filter_.update(0.5)
    with pytest.raises(ValueError, match=r"u is finite and has shape \(1,\)"):
        filter_.step([0.0, 1.0])


def test_what_one_output_cannot_see_is_named() -> None:
    with pytest.warns(UserWarning, match="the measurement cannot see: .*d1"):
        filter_ = DualRate(**GOOD, disturbed=(0, 1))
    assert filter_.spectral_radius == pytest.approx(1.0)
    assert any("d2" in way for way in filter_.unobservable)
