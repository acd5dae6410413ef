"""Training of a correction: what it learns from, that it learns, and that a seed decides all."""

import functools
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torch")
from sideslip.agents.training.corrections import (
    _FIRST_ROUND,
    HELD_OUT,
    TRAINING,
    _collect_samples,
    _compute_errors,
    _compute_quality,
    _Samples,
    train_correction,
)
from sideslip.benchmarks.control.tasks import make_tuning_seeds
from sideslip.estimators.learned.correction import learned, locate_stack
from sideslip.estimators.learned.correction_file import CorrectionCard
from sideslip.estimators.vector.estimate import EstimateObservation
from tests.estimators.learned.test_correction import READ, correction

CARD = CorrectionCard(base="exact-kf", states=READ)
STIFF = {"base": "coms-slalom", "duration": 2.5, "rear_stiffness": 0.6, "front_stiffness": 1.4}
DRIVE: tuple[str, dict[str, Any]] = ("sideslip/YawFusion-v0", {"scenario": STIFF})


@pytest.mark.long
def test_it_learns_what_the_filter_lacks_and_says_how_well() -> None:
    """Of tyres that never vary and a filter that is told others: most of its error, on seeds that
    it has not seen, with intervals that hold what they promise."""
    found = train_correction(CARD, [DRIVE], episodes=12, epochs=60)
    quality = _compute_quality(found, _collect_samples(found, [DRIVE], _FIRST_ROUND[:1], 7, 32))
    assert quality["rmse"] < 0.7 * quality["filter_rmse"]
    assert 0.85 < quality["coverage"] <= 1.0
    assert found.card.temperature > 0.0 and found.card.evaluation.keys() == quality.keys()


def test_a_seed_gives_the_same_bits_and_another_one_others() -> None:
    short = DRIVE[0], {"scenario": STIFF | {"duration": 0.6}}
    cards = [CorrectionCard(base="exact-kf", states=READ, seed=seed) for seed in (0, 0, 1)]
    one, same, other = (train_correction(card, [short], 2, 1).network.weights[0] for card in cards)
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_samples_are_what_the_kernel_read_and_the_filters_error() -> None:
    made, (env_id, options) = correction(), DRIVE
    seen = _collect_samples(made, [(env_id, options)], [("none", "fusion")], 5, 3)
    assert seen.inputs.shape == (len(seen.errors), CARD.inputs) and len(seen.errors) > 60
    errors, deviations = _compute_errors(made, seen)
    assert np.abs(seen.inputs).max() <= 3.0  # its clip
    assert (deviations > 0.0).all() and np.isfinite(errors).all()
    assert np.abs(seen.errors).max() < 0.1


def test_the_kernel_adds_what_the_network_does() -> None:
    made, (env_id, options) = correction(), DRIVE
    factory = functools.partial(learned, file=made)
    env: Any = gym.make_vec(env_id, num_envs=3, sensors="fusion", **options)
    env = EstimateObservation(env, factory, outputs=["beta"], std=False)
    batch, added = env.estimator, []
    env.reset(seed=5)
    for _ in range(40):
        obs, *_ = env.step(np.full((3, 1), 0.2, np.float32))
        net = batch.first.net
        stack = batch.memory[:, locate_stack(net) : locate_stack(net) + int(net.sizes[0])]
        seen = _Samples(stack.astype(np.float32), batch.filters[:, 0].x[:, net.beta])
        added.append(float(np.abs(_compute_errors(made, seen)[0] - seen.errors).max()))
        estimate = seen.errors + (seen.errors - _compute_errors(made, seen)[0])
        assert obs[:, -1] == pytest.approx(estimate, abs=1e-6)
    assert max(added) > 1e-4


def test_a_learned_batch_is_pickled_whole() -> None:
    env_id, options = DRIVE
    env: Any = EstimateObservation(gym.make_vec(env_id, 2, **options), "learned-joint")
    env.reset(seed=5)
    again = pickle.loads(pickle.dumps(env.estimator))
    assert np.array_equal(again.memory, env.estimator.memory)
    assert again.filters.tobytes() == env.estimator.filters.tobytes()


def test_nobody_else_has_its_seeds() -> None:
    assert min(TRAINING, HELD_OUT) > 2**66 + 2**40  # of trainings of policies
    assert max(make_tuning_seeds(4096)) < 2**32 < TRAINING
