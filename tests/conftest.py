"""What all tests share."""

import os

# Before numpy comes: on small matrices BLAS's threads only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no window opens

from pathlib import Path

import pytest
from hypothesis import settings

# The first example of a property pays for compilation; the same examples come every time.
settings.register_profile("sideslip", deadline=None, derandomize=True)
settings.load_profile("sideslip")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Where plain tests alone are asked for, the other files import torch and more for nothing."""
    if not config.getoption("-m").startswith("plain") or collection_path.suffix != ".py":
        return None
    return True if "mark.plain" not in collection_path.read_text() else None
