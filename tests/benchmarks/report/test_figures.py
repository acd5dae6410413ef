"""The figures: colours that stay, peaks that survive thinning, equal axes, whiskers."""

import importlib
import sys

import numpy as np
import pytest

from sideslip.agents import AGENTS, baselines
from sideslip.benchmarks.control.entries import LEARNED
from sideslip.benchmarks.control.entries import ORACLE_NAMES as MATRIX_RUNGS
from sideslip.benchmarks.harness.stats import Estimate
from sideslip.benchmarks.report import figures
from sideslip.envs.rendering.palette import (
    COLOURS,
    CONTROLLERS,
    FILTERS,
    INK,
    ORACLES,
    OTHER_COLOURS,
    find_colour,
)
from sideslip.estimators.make import ESTIMATORS


def test_colours_stay_with_their_names() -> None:
    assert find_colour("the bound") == find_colour("truth") == INK
    assert find_colour("exact-kf, true model") == COLOURS["exact-kf"]
    assert find_colour("somebody-else") == find_colour("somebody-else")
    names = [*COLOURS, "somebody-else", "two-dof (1 ms)", "two-dof (33 ms)"]
    styles = figures._choose_line_styles(names)
    assert len(set(styles.values())) == len(names)
    styles = figures._choose_line_styles(["exact-kf", "exact-kf, true model"])
    assert [dash for _, dash in styles.values()] == ["solid", "dash"]


def test_every_filter_controller_and_rung_has_a_colour_of_its_own() -> None:
    """All names of the package, no two alike, none the strangers'; to be seen on white and dark."""
    assert set(FILTERS) == set(ESTIMATORS)
    assert {*CONTROLLERS} >= {*AGENTS, *(x.agent for entries in LEARNED.values() for x in entries)}
    assert {*ORACLES} >= {*MATRIX_RUNGS, *baselines.ORACLES}
    own = [*FILTERS.values(), *CONTROLLERS.values(), *ORACLES.values(), *OTHER_COLOURS, INK]
    assert len(set(own)) == len(own)
    for shade in own[:-1]:
        light = luminance(shade)
        assert 1.05 / (light + 0.05) > 2.3, f"{shade} on white"
        assert (light + 0.05) / (luminance("#14171b") + 0.05) > 2.3, f"{shade} on the dark page"


def test_colours_that_meet_differ_for_the_colour_blind_too() -> None:
    """Distances in OKLab; without red or green cones by the matrices of Machado et al. (2009)."""
    for meet in (("exact-kf", "multirate-kf", "bicycle-kf", "dakf", "single-rate-kf"),
                 ("lqr", "two-dof", "nmpc", "esc", "none", "sliding-mode")):  # fmt: skip
        for eyes in (np.eye(3), *LACKING):
            seen = np.array([oklab(eyes @ linear(COLOURS[name])) for name in meet])
            apart = np.linalg.norm(seen[:, None] - seen[None], axis=2) + np.eye(len(meet))
            assert apart.min() > 0.05, meet


LACKING = np.array([
    [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],  # green
    [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],  # red
])  # fmt: skip


def linear(shade: str) -> np.ndarray:
    coded = np.array([int(shade[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.asarray(np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4))


def luminance(shade: str) -> float:
    return float(linear(shade) @ [0.2126, 0.7152, 0.0722])


def oklab(rgb: np.ndarray) -> np.ndarray:
    """Ottosson (2020), from linear sRGB."""
    cones = [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]
    axes = [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]
    return np.asarray(np.array(axes) @ np.cbrt(np.clip(np.array(cones) @ rgb, 0.0, None)))


def test_groups_stand_below_each_other_with_their_intervals() -> None:
    numbers = {"dakf": Estimate(2.0, 1.5, 3.0), "exact-kf, gps": Estimate(4.0, 3.0, 5.0)}
    figure = figures.draw_groups({"A": numbers, "B": numbers}, "ratio", {1.0: "one"})
    assert [trace.y[0] for trace in figure.data] == [1, 2, 4, 5]
    assert list(figure.layout.yaxis.ticktext) == [*numbers, *numbers]
    first, second, *_ = figure.data
    assert (first.error_x.array[0], first.error_x.arrayminus[0]) == (1.0, 0.5)
    assert first.hovertemplate == "dakf: 2 [1.5, 3]<extra></extra>"
    assert (first.marker.symbol, second.marker.symbol) == ("circle", "circle-open")
    texts = {each.text: each for each in figure.layout.annotations}
    assert set(texts) == {"<b>A</b>", "<b>B</b>", "one"}
    assert texts["one"].x == 0.0  # log of 1: a logarithmic axis places texts so


def test_without_plotly_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.delitem(sys.modules, "sideslip.benchmarks.report.figures", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"sideslip\[report\]"):
        importlib.import_module("sideslip.benchmarks.report.figures")


def test_time_series_keep_every_peak_and_gap() -> None:
    t: np.ndarray = np.arange(100_001) * 1e-3
    y = np.sin(t)
    y[54_321], y[77_777] = 5.0, -4.0
    y[20_000:30_000] = np.nan
    y[40_010:40_013] = np.nan
    figure = figures.draw_time_series(t, {"dakf": y, "truth": np.sin(t)}, "angle / rad")
    line, truth = figure.data  # the truth on top of the estimate
    assert (truth.name, truth.line.color) == ("truth", INK)
    assert truth.line.width > line.line.width
    assert len(line.x) <= figures.POINTS
    assert (np.nanmax(line.y), np.nanmin(line.y)) == (5.0, -4.0)
    inside = (line.x > 20.2) & (line.x < 29.8)
    assert inside.any()
    assert np.isnan(line.y[inside]).all()
    assert np.isnan(line.y[(line.x > 40.0) & (line.x < 40.1)]).any()  # three samples of 100 000
    assert (line.x[0], line.x[-1]) == (0.0, t[-1])
    assert figure.layout.xaxis.title.text == "time / s"
    assert figure.layout.yaxis.title.text == "angle / rad"


def test_tracks_have_equal_axes() -> None:
    figure = figures.draw_track({"truth": (np.arange(5000.0), np.arange(5000.0))})
    assert figure.layout.yaxis.scaleanchor == "x"
    assert len(figure.data[0].x) == figures.POINTS
    assert figure.data[0].x[-1] == 4999
