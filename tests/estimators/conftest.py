"""The tests' own helpers are imported as `tests.estimators...`, wherever pytest was started."""

import sys
from pathlib import Path

import pytest

_ROOT = str(Path(__file__).resolve().parents[2])
if _ROOT not in sys.path:
    sys.path.append(_ROOT)


@pytest.fixture
def own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is gone after it."""
    from sideslip.agents import AGENTS
    from sideslip.estimators.make import ESTIMATORS

    for registry in (ESTIMATORS, AGENTS):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))
