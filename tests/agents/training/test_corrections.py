"""Training of a correction: what it learns from, that it learns, and that a seed decides all."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
from sideslip.agents.training.corrections import (
    FIRST,
    HELD_OUT,
    TRAINING,
    judged,
    quality_of,
    samples,
    train_correction,
)
from sideslip.benchmarks.control.seeds import tuning_seeds
from sideslip.estimators.learned.files import CorrectionCard
from tests.estimators.learned.test_correction import READ, correction

CARD = CorrectionCard(base="exact-kf", states=READ)
STIFF = {"base": "coms-slalom", "duration": 2.5, "rear_stiffness": 0.6, "front_stiffness": 1.4}
DRIVE: tuple[str, dict[str, Any]] = ("sideslip/YawFusion-v0", {"scenario": STIFF})


def test_it_learns_what_the_filter_lacks_and_says_how_well() -> None:
    """Of tyres that never vary and a filter that is told others: most of its error, on seeds that
    it has not seen, with intervals that hold what they promise."""
    found = train_correction(CARD, [DRIVE], episodes=16, epochs=150)
    quality = quality_of(found, samples(found, [DRIVE], FIRST[:1], 7, 32))
    assert quality["rmse"] < 0.7 * quality["filter_rmse"]
    assert 0.85 < quality["coverage"] <= 1.0
    assert found.card.temperature > 0.0 and found.card.evaluation.keys() == quality.keys()


def test_a_seed_gives_the_same_bits_and_another_one_others() -> None:
    short = DRIVE[0], {"scenario": STIFF | {"duration": 0.6}}
    cards = [CorrectionCard(base="exact-kf", states=READ, seed=seed) for seed in (0, 0, 1)]
    one, same, other = (train_correction(card, [short], 2, 1).network.weights[0] for card in cards)
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_samples_are_what_the_kernel_read_and_the_filters_error() -> None:
    """The network by NumPy on a sample's inputs is what the kernel added there."""
    made, (env_id, options) = correction(), DRIVE
    seen = samples(made, [(env_id, options)], [("none", "fusion")], 5, 3)
    assert seen.inputs.shape == (len(seen.errors), CARD.inputs) and len(seen.errors) > 60
    errors, deviations = judged(made, seen)
    assert np.abs(seen.inputs).max() <= 3.0  # its clip
    assert (deviations > 0.0).all() and np.isfinite(errors).all()
    assert np.abs(seen.errors).max() < 0.1


def test_nobody_else_has_its_seeds() -> None:
    assert min(TRAINING, HELD_OUT) > 2**66 + 2**40  # of trainings of policies
    assert max(tuning_seeds(4096)) < 2**32 < TRAINING


def test_nothing_to_learn_from_is_refused() -> None:
    with pytest.raises(ValueError, match="0 drives, 32 episodes, 20 epochs"):
        train_correction(CARD, [])
    with pytest.raises(ValueError, match="1 drives, 0 episodes"):
        train_correction(CARD, [DRIVE], episodes=0)
