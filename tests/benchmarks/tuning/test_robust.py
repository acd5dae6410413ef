"""The search of joint-robust's levels: its drives, and what it makes least."""

import math

import numpy as np
import pytest

from sideslip.benchmarks.tuning import robust
from sideslip.envs.record import FAST

OURS = 3  # a seed of our own plant


def test_a_drive_is_a_log_at_100_hz_of_a_car_and_sensors_that_are_misjudged() -> None:
    made, again = robust._simulate_drive(OURS), robust._simulate_drive(OURS)
    assert made is not None and again is not None
    log, fast = made.log, made.log.record.fast
    assert log.record.dt == pytest.approx(0.01) and len(fast) == 100 * robust.DURATION + 1
    assert np.array_equal(fast, again.log.record.fast)
    assert np.abs(log.truth["beta"]).max() > 0.005
    jumps = np.flatnonzero(np.abs(np.diff(fast[:, FAST.steer])) > 0.03)
    assert len(jumps) in (2, 4)  # loose contacts that are seen, there and back
    assert len(log.record.packets) == pytest.approx(10 * robust.DURATION, abs=5)


def test_a_better_filter_has_less_of_the_objective() -> None:
    made = robust._simulate_drive(OURS)
    assert made is not None
    sure = {"force_share": 1e-4, "moment_share": 1e-4, "model_error": 0.0}
    shipped, worse = (robust._compute_errors(options, [made]) for options in ({}, sure))
    assert shipped.shape == (1, 2, 2)
    assert robust._compute_objective(shipped) < robust._compute_objective(worse)


def test_the_objective_is_a_mean_logarithm_that_wants_honest_deviations() -> None:
    found = np.array([[[0.01, 1.0], [0.04, 1.0]]])
    assert robust._compute_objective(found) == pytest.approx(math.log(0.02))
    for nees in (math.e, 1.0 / math.e):
        other = found.copy()
        other[0, 0, 1] = nees
        assert robust._compute_objective(other) == pytest.approx(math.log(0.02) + 0.05)


def test_both_axles_have_the_same_levels() -> None:
    found = robust._make_options({"q_front_tyres": 0.01, "model_error": 0.1})
    assert found == {"q_front_tyres": 0.01, "q_rear_tyres": 0.01, "model_error": 0.1}
