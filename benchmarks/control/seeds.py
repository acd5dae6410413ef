"""Test seeds that nobody can have tuned on: they change with the contestants and the env."""

import hashlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ... import __version__
from ...agents.learned.files import SUFFIX
from .contests import ControlTask

Seeds = Sequence[int] | Callable[[ControlTask], Sequence[int]]
"""The same in every contest, or of each."""

_PACKAGE = Path(__file__).resolve().parents[2]
_CONTESTANTS = dict.fromkeys(("estimators", "agents"), (".py", ".toml", SUFFIX))
_LENGTH = 16
_TUNING = 2**29  # the clairvoyant's are beyond 2^30


def make_salt(*more: str) -> str:
    """The salt: a hash of the contestants' files, weights included, the env's version and further
    texts."""
    digest = hashlib.sha256(__version__.encode())
    for folder, endings in _CONTESTANTS.items():
        for path in sorted((_PACKAGE / folder).rglob("*")):
            if path.suffix in endings:
                digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    for text in more:
        digest.update(text.encode())
    return digest.hexdigest()[:_LENGTH]


def make_salted_seeds(salt: str, n: int, more: str = "") -> list[int]:
    """The first n test seeds of a salt (hexadecimal), each below 2^32; more seeds keep the first.

    more: a text that makes them others. Raises ValueError for a salt that is not hexadecimal.
    """
    if not re.fullmatch("[0-9a-f]+", salt):
        raise ValueError(f"a salt is hexadecimal digits, got {salt!r}")
    words = [int(salt[i : i + 8], 16) for i in range(0, len(salt), 8)]
    words += list(hashlib.sha256(more.encode()).digest()) if more else []
    children = np.random.SeedSequence(words).spawn(n)
    return [int(child.generate_state(1)[0]) for child in children]


def make_task_seeds(salt: str, n: int) -> Callable[[ControlTask], list[int]]:
    """The first n test seeds of each contest.

    Other ones in each: a seed draws the car as well, and contests that share their cars would not
    be independent strata of an interval.
    """
    return lambda task: make_salted_seeds(salt, n, task.seed_text)


def make_tuning_seeds(n: int) -> list[int]:
    """The first n seeds on which contests are chosen and controllers tuned: no test's."""
    return list(range(_TUNING, _TUNING + n))
