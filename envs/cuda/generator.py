"""A row's generator on the device: NumPy's PCG64, which draws one 64-bit key a reset.

Its 128-bit numbers are four words of 32 bits, the lowest first: first the state, then the
increment. M. E. O'Neill, "PCG: A Family of Simple Fast Space-Efficient Statistically Good
Algorithms for Random Number Generation", 2014.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

WORDS = 8
_MASK = 0xFFFFFFFF
_M0, _M1, _M2, _M3 = 0x9FCCF645, 0x4385DF64, 0x1FC65DA4, 0x2360ED05


def draw_key(words: Any) -> Any:
    """The generator's next 64 bits as (low, high) of 32; its words (WORDS,) move on."""
    a, b, c, d = int(words[0]), int(words[1]), int(words[2]), int(words[3])
    aa, ab, ba = a * _M0, a * _M1, b * _M0
    ac, bb, ca = a * _M2, b * _M1, c * _M0
    low = (aa & _MASK) + int(words[4])
    second = (low >> 32) + _extract_high(aa) + (ab & _MASK) + (ba & _MASK) + int(words[5])
    third = (second >> 32) + _extract_high(ab) + _extract_high(ba) + int(words[6])
    third = third + (ac & _MASK) + (bb & _MASK) + (ca & _MASK)
    top = (third >> 32) + _extract_high(ac) + _extract_high(bb) + _extract_high(ca) + int(words[7])
    top = top + a * _M3 + b * _M2 + c * _M1 + d * _M0  # what is above its 32 bits is lost
    a, b, c, d = low & _MASK, second & _MASK, third & _MASK, top & _MASK
    words[0], words[1], words[2], words[3] = a, b, c, d
    low, high, turn = a ^ c, b ^ d, d >> 26  # the words' exclusive or, rotated by the leading bits
    if turn >= 32:
        low, high = high, low
    turn = turn & 31
    first = ((low >> turn) | (high << (32 - turn))) & _MASK
    return first, ((high >> turn) | (low << (32 - turn))) & _MASK


def _extract_high(product: int) -> int:
    return (product >> 32) & _MASK


def read_words(generators: Sequence[np.random.Generator]) -> npt.NDArray[np.int64]:
    """The words (WORDS, N) of generators as they are now."""
    words = np.empty((WORDS, len(generators)), np.int64)
    for i, generator in enumerate(generators):
        state: Any = generator.bit_generator.state["state"]
        for k, number in enumerate((state["state"], state["inc"])):
            words[4 * k : 4 * k + 4, i] = [number >> 32 * part & _MASK for part in range(4)]
    return words
