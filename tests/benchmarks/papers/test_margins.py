"""Margins: a loop with the factor applied has a pole on the unit circle, there."""

import math

import control
import numpy as np
import pytest

from sideslip.benchmarks.papers.tie_vision import _compute_gain_margin, _find_crossings

DT = 0.01


def nearest_pole(loop: control.StateSpace, omega: float) -> float:
    """How far the closed loop's nearest pole is from exp(j omega dt)."""
    poles = control.feedback(loop, 1).poles()
    return float(np.abs(poles - np.exp(1j * omega * loop.dt)).min())


def random_loop(rng: np.random.Generator) -> control.StateSpace:
    radius, angle = rng.uniform(0.3, 0.98, 2), rng.uniform(0.05, 3.0, 2)
    poles = [*(radius * np.exp(1j * angle)), *(radius * np.exp(-1j * angle)), 0.5, 1.0]
    zeros = rng.uniform(-2.0, 2.0, 4)
    return control.ss(control.tf(rng.uniform(0.01, 1.0) * np.poly(zeros), np.poly(poles).real, DT))


@pytest.mark.parametrize("seed", range(12))
def test_every_gain_margin_puts_a_pole_on_the_unit_circle(seed: int) -> None:
    loop = random_loop(np.random.default_rng(seed))
    found = _find_crossings(loop)
    for factor, omega in found:
        # poles of a sixth-order polynomial: good to about the square root of its rounding
        assert nearest_pole(factor * loop, omega) < 1e-7
    assert (np.diff(found[:, 1]) > 0.0).all()


@pytest.mark.parametrize("seed", range(12))
def test_python_control_finds_the_same_below_half_the_sampling_rate(seed: int) -> None:
    loop = random_loop(np.random.default_rng(seed))
    found = _find_crossings(loop)
    gains, _, _, at_gain, _, _ = control.stability_margins(control.tf(loop), returnall=True)
    inside = found[found[:, 1] < 0.999 * math.pi / DT]
    # near 0 it reports roundings of the pole at z = 1 as crossings
    theirs = (at_gain > 1e-5 * math.pi / DT) & (at_gain < 0.999 * math.pi / DT)
    assert inside[:, 0] == pytest.approx(gains[theirs], rel=1e-6)


def test_the_crossover_at_half_the_sampling_rate() -> None:
    """Jury's test for k / (z - 1/2): stable for -1/2 < k < 3/2, the upper end at z = -1."""
    loop = control.ss(control.tf([1.0], [1.0, -0.5], DT))
    assert _find_crossings(loop) == pytest.approx(np.array([[1.5, math.pi / DT]]), rel=1e-12)
    assert _compute_gain_margin(loop)[0] == pytest.approx(20.0 * math.log10(1.5), rel=1e-12)
    assert np.abs(control.feedback(1.499 * loop, 1).poles()).max() < 1.0
    assert np.abs(control.feedback(1.501 * loop, 1).poles()).max() > 1.0
    lost = control.stability_margins(loop)[0]
    assert math.isinf(lost), "python-control finds it too now: say so in the docstring"


def test_a_positive_end_is_no_crossover() -> None:
    assert (
        _find_crossings(control.ss(control.tf([-1.0], [1.0, -0.5], DT)))[:, 1] < math.pi / DT
    ).all()


def test_a_loop_that_never_crosses_has_infinite_margins() -> None:
    loop = control.ss(control.tf([0.1, 0.02], [1.0, 0.0], DT))  # positive real, gain below 1
    assert _compute_gain_margin(loop)[0] == math.inf and len(_find_crossings(loop)) == 0
