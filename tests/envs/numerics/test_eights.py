"""Eight neighbours at once: the numbers and the order of sums of each column alone."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs.numerics.jit import jit
from sideslip.envs.numerics.simd8 import allocate_scratch, load8, mirror, store8


@jit
def _product(a: Any, b: Any, c: Any) -> None:
    work = allocate_scratch(a, 2, 8)
    for i in range(len(a)):
        store8(work, 0.0, 1, 0)
        for k in range(len(b)):
            store8(work, load8(work, 1, 0) + a[i, k] * load8(b, k, 8), 1, 0)
        store8(c, load8(work, 1, 0), i, 8)


@jit
def _mirror(a: Any, i: int, j: int) -> None:
    mirror(a, i, j)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.plain
def test_a_product_by_eights_is_that_of_single_numbers(rng: np.random.Generator) -> None:
    a, b, c = rng.normal(size=(5, 7)), rng.normal(size=(7, 16)), np.zeros((5, 16))
    _product(a, b, c)
    for i in range(5):
        for j in range(8, 16):
            total = 0.0
            for k in range(7):
                total += a[i, k] * b[k, j]
            assert c[i, j] == total
    assert not c[:, :8].any()


@pytest.mark.plain
@pytest.mark.parametrize("j", [0, 8])
def test_a_mirrored_block_is_the_transposed_one(rng: np.random.Generator, j: int) -> None:
    before = rng.normal(size=(16, 16))
    after = before.copy()
    _mirror(after, 0, j)
    above = np.triu_indices(8) if j == 0 else np.nonzero(np.ones((8, 8)))
    for i, k in zip(*above, strict=True):
        assert after[i, j + k] == before[i, j + k] == after[j + k, i]
    np.testing.assert_array_equal(after[8:, 8:], before[8:, 8:])
