"""A row's generator on the device draws the keys that NumPy's draws on the host."""

import numpy as np
import pytest

pytest.importorskip("numba_cuda")

from sideslip.envs.device.cuda_env import _read_words
from sideslip.envs.device.cuda_kernel import _draw_key

pytestmark = pytest.mark.plain


def test_keys_are_those_of_numpys_generator() -> None:
    generators = [np.random.default_rng(seed) for seed in range(200)]
    words = _read_words(generators)
    for i, generator in enumerate(generators):
        for _ in range(5):
            key = int(generator.integers(0, 2**64, dtype=np.uint64))
            assert _draw_key(words[:, i]) == (key & 0xFFFFFFFF, key >> 32)
    assert np.array_equal(words, _read_words(generators))  # and it stands where NumPy's does
