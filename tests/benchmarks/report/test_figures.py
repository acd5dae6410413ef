"""The figures: colours that stay, peaks that survive thinning, equal axes, whiskers."""

import importlib
import sys

import numpy as np
import pytest

from sideslip.benchmarks.report.colours import line_styles
from sideslip.envs.rendering.palette import COLOURS, INK, colour


def test_colours_stay_with_their_names() -> None:
    assert colour("the bound") == colour("truth") == INK
    assert colour("exact-kf, true model") == COLOURS["exact-kf"]
    assert colour("somebody-else") == colour("somebody-else")
    names = [*COLOURS, "somebody-else", "two-dof (1 ms)", "two-dof (33 ms)"]
    styles = line_styles(names)
    assert len(set(styles.values())) == len(names)
    assert line_styles(["multirate-kf"])["multirate-kf"] == (COLOURS["multirate-kf"], "solid")


def test_without_plotly_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.delitem(sys.modules, "sideslip.benchmarks.report.figures", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[report\]"):
        importlib.import_module("sideslip.benchmarks.report.figures")


def test_time_series_keep_every_peak_and_gap() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    t = np.arange(100_001) * 1e-3
    y = np.sin(t)
    y[54_321], y[77_777] = 5.0, -4.0
    y[20_000:30_000] = np.nan
    figure = figures.time_series(t, {"dakf": y, "truth": np.sin(t)}, "angle / rad")
    truth, line = figure.data
    assert (truth.name, truth.line.color) == ("truth", INK)
    assert truth.line.width > line.line.width
    assert len(line.x) <= figures.POINTS
    assert (np.nanmax(line.y), np.nanmin(line.y)) == (5.0, -4.0)
    inside = (line.x > 20.2) & (line.x < 29.8)
    assert inside.any()
    assert np.isnan(line.y[inside]).all()
    assert (line.x[0], line.x[-1]) == (0.0, np.float32(t[-1]))
    assert figure.layout.xaxis.title.text == "time / s"
    assert figure.layout.yaxis.title.text == "angle / rad"


def test_small_ranges_far_from_zero_keep_their_shape() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    t = 1.6e9 + np.arange(1000) * 0.01
    nothing = np.full(t.size, np.nan)
    series = {"dakf": np.sin(t), "lost": nothing}
    line, _ = figures.time_series(t, series, "angle / rad").data
    np.testing.assert_array_equal(line.x, t)
    assert line.y.dtype == np.float32


def test_figures_refuse_unequal_lengths() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    with pytest.raises(ValueError, match="'dakf' has shape"):
        figures.time_series(np.arange(3.0), {"dakf": np.arange(2.0)}, "angle / rad")
    with pytest.raises(ValueError, match="track 'truth'"):
        figures.track({"truth": (np.arange(3.0), np.arange(2.0))})
    with pytest.raises(ValueError, match="differ in length"):
        figures.bars_with_interval(["a"], [1.0], [], [], "m")


def test_curves_stand_on_logarithmic_axes() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    x, y = np.array([1.0, 1024.0, 65536.0]), np.array([8.0, 1.0, 1.0])
    figure = figures.curves(x, {"gym.make": y}, "environments", "CPU time / us", "xy")
    (line,) = figure.data
    assert list(line.x) == list(x) and list(line.y) == list(y)
    assert line.mode == "lines+markers"
    assert figure.layout.xaxis.type == figure.layout.yaxis.type == "log"
    assert figure.layout.yaxis.title.text == "CPU time / us"
    whiskers = figures.curves(x, {"gym.make": (y, y - 1.0, y + 2.0)}, "n", "us").data[0].error_y
    assert list(whiskers.array) == [2.0] * 3 and list(whiskers.arrayminus) == [1.0] * 3
    with pytest.raises(ValueError, match="has 3 values, x 2"):
        figures.curves(x[:2], {"gym.make": y}, "environments", "CPU time / us")


def test_tracks_have_equal_axes() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    figure = figures.track({"truth": (np.arange(5000.0), np.arange(5000.0))})
    assert figure.layout.yaxis.scaleanchor == "x"
    assert len(figure.data[0].x) == figures.POINTS
    assert figure.data[0].x[-1] == 4999


def test_whiskers_are_the_interval() -> None:
    figures = pytest.importorskip("sideslip.benchmarks.report.figures")
    (bar,) = figures.bars_with_interval(
        ["a", "b", "c"], [2.0, 3.0, 4.0], [1.5, np.nan, 4.0], [3.0, np.nan, 4.0], "m"
    ).data
    np.testing.assert_array_equal(bar.error_x.array, [1.0, np.nan, np.nan])
    np.testing.assert_array_equal(bar.error_x.arrayminus, [0.5, np.nan, np.nan])
    assert list(bar.customdata) == ["2 [1.5, 3]", "3", "4"]
