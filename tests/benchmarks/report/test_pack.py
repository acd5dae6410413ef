"""What is packed comes back: texts whole, lines within a quantum, gaps where they were."""

import base64
import gzip
import json
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.report.html import _encode_figure, _encode_steps, _pack_text


def values_of(entry: dict[str, Any]) -> np.ndarray:
    """As the page reads steps."""
    at, found = 0, []
    for step in entry["steps"]:
        at += step or 0
        found.append(np.nan if step is None else entry["from"] + entry["by"] * at)
    return np.array(found)


def test_a_text_comes_back() -> None:
    text = "sideslip \u03b2 </script>"
    assert gzip.decompress(base64.b64decode(_pack_text(text))).decode() == text
    assert _pack_text(text) == _pack_text(text)
    assert "<" not in _pack_text(text)


@pytest.mark.parametrize("offset", [0.0, 1.6e9])
def test_a_line_comes_back_within_half_a_quantum(offset: float) -> None:
    y = offset + np.random.default_rng(0).normal(size=1000)
    y[100:200] = np.nan
    found = values_of(_encode_steps(y, levels=2048))
    half = 0.51 * np.ptp(y[~np.isnan(y)]) / 2047
    np.testing.assert_allclose(found, y, rtol=0.0, atol=half)
    assert _encode_steps([])["steps"] == []
    np.testing.assert_array_equal(values_of(_encode_steps([2.0, 2.0])), [2.0, 2.0])
    assert _encode_steps([np.nan, np.nan])["steps"] == [None, None]


def test_a_figure_is_steps_where_its_lines_are_long() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    t = np.arange(2000) * 0.01
    text = _encode_figure(figures.draw_time_series(t, {"dakf": np.sin(t)}, "angle / rad"))
    found = json.loads(text)
    assert "template" not in found["layout"] and "title" not in found["layout"]
    x, y = (values_of(found["data"][0][axis]) for axis in "xy")
    np.testing.assert_allclose(y, np.sin(x), atol=0.01)
    assert len(text) < 10_000
    short = json.loads(_encode_figure(figures.draw_curves(t[:5], {"dakf": t[:5]}, "x", "y")))
    assert "steps" not in short["data"][0]["x"]
