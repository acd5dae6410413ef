"""Random numbers: the generator's published answers, and what the numbers are distributed as."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sideslip.envs.numerics import functions as noise
from sideslip.envs.numerics.functions import (
    CHANNELS,
    _to_uniform,
    draw_normals,
    draw_uniforms,
    philox,
)
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.numerics.primitives import ARRAYS

pytestmark = pytest.mark.plain

# Every test below fixes its keys, so it always sees the same numbers: a p-value of 1e-3 is
# passed once and for all by a right generator that is not unlucky.
LEAST_P = 1e-3
KEY = (0x12345678, 0x9ABCDEF0)
N = 200_000

# Random123's file kat_vectors, philox4x32 10: counter, key, answer
KNOWN = [
    ("00000000 " * 4, "00000000 " * 2, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff " * 4, "ffffffff " * 2, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    (
        "243f6a88 85a308d3 13198a2e 03707344",
        "a4093822 299f31d0",
        "d16cfe09 94fdcceb 5001e420 24126ea1",
    ),
]


def on_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    return as_python(function, ARRAYS)


def words(text: str) -> list[int]:
    return [int(word, 16) for word in text.split()]


@pytest.mark.smoke
@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_philox_gives_the_published_answers(counter: str, key: str, answer: str) -> None:
    assert list(philox(*words(key), *words(counter))) == words(answer)
    assert list(as_python(philox)(*words(key), *words(counter))) == words(answer)
    lanes: list[Any] = [np.full(3, word, np.int64) for word in words(key) + words(counter)]
    for lane, word in zip(on_arrays(philox)(*lanes), words(answer), strict=True):
        assert lane.tolist() == [word] * 3


def sample(block: int, count: int = N) -> np.ndarray:
    """(4, count) normals of a block at ticks 0, 1, 2, ..."""
    ticks = np.arange(count, dtype=np.int64)
    key: Any = [np.full(count, word, np.int64) for word in KEY]
    return np.stack(on_arrays(draw_normals)(*key, ticks, np.full(count, block, np.int64)))


def test_uniforms_lie_strictly_inside_the_unit_interval() -> None:
    assert 0.0 < _to_uniform(0) < _to_uniform(0xFFFFFFFF) < 1.0
    assert _to_uniform(0) == 0.5 / 2.0**32


def test_uniforms_are_uniform() -> None:
    u = np.array([draw_uniforms(*KEY, tick, CHANNELS.camera_link) for tick in range(20_000)])
    for column in u.T:
        assert stats.kstest(column, "uniform").pvalue > LEAST_P


def test_log_errs_less_than_stated() -> None:
    rng = np.random.default_rng(4)
    ends = np.arange(1000)
    word = np.concatenate([rng.integers(0, 2**32, N), ends, 2**32 - 1 - ends])
    exact = np.log((word.astype(np.longdouble) + 0.5) / 2**32)
    assert float(np.max(np.abs(on_arrays(noise._log_uniform)(word) - exact))) < 1e-13


@pytest.mark.parametrize("block", [CHANNELS.inertial, CHANNELS.gps])
def test_normals_are_standard_normal(block: int) -> None:
    for column in sample(block):
        assert stats.kstest(column, "norm").pvalue > LEAST_P


def test_normals_have_the_moments_of_the_normal_law() -> None:
    x = sample(CHANNELS.wheels)
    for power, exact, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        error = np.mean(x**power) - exact
        # four standard errors of the mean of x^p, whose variance is `variance`
        assert abs(error) < 4.0 * np.sqrt(variance / x.size), power


def test_tails_reach_beyond_five_sigma_and_stay_finite() -> None:
    x = np.concatenate([sample(block) for block in range(6)])  # 4.8 million: 2.75 expected
    assert 5.0 < np.max(np.abs(x)) < np.sqrt(2.0 * np.log(2.0**33))  # the smallest word's radius


def test_numbers_of_a_block_its_neighbours_and_the_next_tick_are_uncorrelated() -> None:
    now = np.concatenate([sample(CHANNELS.inertial), sample(CHANNELS.wheels)])
    rows = np.concatenate([now[:, :-1], now[:, 1:]])
    for first, second in itertools.combinations(rows, 2):
        # five standard errors of a correlation of N pairs; 120 of them are looked at
        assert abs(np.corrcoef(first, second)[0, 1]) < 5.0 / np.sqrt(N)
        assert abs(np.corrcoef(first**2, second**2)[0, 1]) < 5.0 / np.sqrt(N)


def test_sine_and_cosine_halves_have_no_joint_structure() -> None:
    a, b, c, d = sample(CHANNELS.camera)
    for first, second in ((a, b), (c, d), (a, c), (b, d)):
        angle = np.arctan2(second, first) / (2.0 * np.pi) + 0.5
        assert stats.kstest(angle, "uniform").pvalue > LEAST_P


def test_every_argument_changes_the_numbers() -> None:
    base = (*KEY, 17, CHANNELS.gps)
    seen = {draw_normals(*base)}
    for place in range(4):
        for bit in (0, 5, 20):
            changed = list(base)
            changed[place] ^= 1 << bit
            seen.add(draw_normals(*changed))
    assert len(seen) == 13
    assert len({draw_uniforms(*base, index) for index in range(100)}) == 100


def test_channels_do_not_share_blocks() -> None:
    assert list(CHANNELS) == list(range(len(CHANNELS)))
