"""Our car on highway-env's roads, as the tests drive it."""

import pytest

pytest.importorskip("highway_env")
