"""A bank whose members interact: what a step of the chain leaves alone, and what it finds."""

from typing import Any

import numpy as np
import pytest

from sideslip.estimators.core.multiple_model import (
    CALM,
    CHANGED,
    GUSTY,
    MIN_LOG_WEIGHT,
    compute_mixture,
    run_imm_step,
)

from .test_tyres import CHANGED as CHANGE
from .test_tyres import SETTLED, built, drives, squares

BOTH: tuple[dict[str, Any], ...] = ({}, {"sudden": True})
GUST = {"wind_force": 400.0, "wind_arm": 0.1, "wind_start": 4.1, "wind_length": 3.0}


def test_merging_leaves_the_mixture_as_it_is() -> None:
    """Mean, covariance and probability of all members, where no event adds or takes anything."""
    base, ((log, _), *_) = drives(1, **CHANGE)
    filter_ = built(base, log, sudden=True)
    filter_.run(log)
    members = filter_.filters[1:]
    members.burst, members.spread = 0.0, 0.0
    members.weight[:] = [0.0, MIN_LOG_WEIGHT, -0.5, -1.0]
    compute_mixture(filter_.filters)
    x, P, total = filter_.x, filter_.P, np.exp(members.weight).sum()
    run_imm_step(filter_.filters)
    compute_mixture(filter_.filters)
    assert np.exp(members.weight).sum() == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(filter_.x, x, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(filter_.P, P, rtol=1e-9, atol=1e-12 * np.abs(P).max())
    assert not np.array_equal(members[0].x, members[2].x)


def test_the_likeliest_member_is_what_happens() -> None:
    base, made = drives(6, **GUST)
    for until, expected in ((3900, {CALM}), (6500, {GUSTY}), (9900, {CALM})):
        right = 0
        for log, _ in made:
            filter_ = built(base, log, sudden=True)
            record = filter_.prepare_record(log)
            due = record.packets[:, 2] <= record.first + until
            filter_.step(record.fast[:until], record.packets[due])
            right += 1 + int(np.argmax(filter_.filters.weight[1:])) in expected
        assert right >= 5


def test_a_gust_of_unknown_strength_is_found() -> None:
    base, made = drives(8, **GUST)
    one, bank = (
        np.mean([squares(built(base, log, **options), log) for log, _ in made], axis=0)
        for options in BOTH
    )
    assert np.sqrt(bank[0] / one[0]) < 0.7
    assert bank[1] < 0.3 * one[1]


def test_what_it_costs_where_nothing_happens_and_gains_where_tyres_change() -> None:
    for scene, most, since in (({}, 1.08, SETTLED), (CHANGE, 0.7, 4500)):
        base, made = drives(6, **scene)
        one, bank = (
            np.mean([squares(built(base, log, **options), log, since)[0] for log, _ in made])
            for options in BOTH
        )
        assert np.sqrt(bank / one) < most


def test_only_tyres_that_have_just_changed_walk_and_only_a_gust_lasts() -> None:
    base, ((log, _), *_) = drives(1)
    filter_ = built(base, log, sudden=True)
    d, tyres = filter_.filters[0].dense, filter_.filters[0].tyres
    filter_.run(log)
    walks = filter_.filters.Q[1:, tyres, tyres] > 0.0
    lasts = filter_.filters.decay[1:, d] == 1.0
    assert np.flatnonzero(walks) + 1 == CHANGED
    assert np.flatnonzero(lasts) + 1 == GUSTY
