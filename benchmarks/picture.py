"""The benchmark at a glance: one PNG from the rows, for a README."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..envs.io import atomic_file
from ..envs.numerics import require_extra
from ..envs.rendering.palette import INK, find_colour
from .control.entries import Entry
from .control.report import select_complete
from .control.tasks import TITLES, list_scored_tasks
from .harness.metrics import METRICS
from .harness.results import ResultRow, ShareMap, Suite
from .report.figures import SHARE_SCALE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

_MAX_COLUMNS = 3  # panels


def write_picture(path: str | Path, suites: Sequence[Suite]) -> None:
    """Write bars of every estimator's error and the controllers' scores, with their intervals.

    Args:
        path: File of the picture.
        suites: Results.

    Raises:
        ValueError: No suite has a row to draw.
        ModuleNotFoundError: The extra `report` is not installed.
    """
    with require_extra("report", "pictures need matplotlib"):
        from matplotlib.figure import Figure
    rows = [row for suite in suites for row in suite.rows]
    error = "error of sideslip / mrad"
    score = "score (0: nominal, 1: oracle-state)\nhatched: of a part of the contests"
    candidates = [
        ("Estimating with a late camera", ("tie-vision-fig7", "rmse"), error),
        ("Estimating with GPS, wind, outage", ("dakf-fig6", "rmse"), error),
        *((f"Tier {x}\n{text}", (f"tier {x}", "score"), score) for x, text in TITLES.items()),
    ]
    panels = []
    for title, key, label in candidates:
        if shown := [r for r in rows if (r.scenario, r.metric) == key and _is_shown(r)]:
            panels.append((title, shown, label))
    maps = [share_map for suite in suites for share_map in suite.maps]
    if not (panels or maps):
        needed = "the suites estimation, control or recovery"
        raise ValueError(f"nothing to draw: the picture needs {needed}")
    n_columns = min(len(panels), _MAX_COLUMNS)
    n_rows = -(-len(panels) // max(n_columns, 1))
    heights = [n_rows] * bool(panels) + [1] * len(maps)
    wide = max([4.0 * n_columns, *(2.4 * len(share_map.shares) for share_map in maps)])
    max_bars = max([len(panel_rows) for _, panel_rows, _ in panels], default=0)
    high = n_rows * max(2.6, 0.17 * max_bars + 0.8) * bool(panels) + 2.6 * len(maps)
    figure = Figure(figsize=(wide, high), layout="constrained")
    strips = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for strip, share_map in zip(strips[bool(panels) :], maps, strict=True):
        _draw_maps(strip, share_map)
    axes = strips[0].subplots(n_rows, n_columns, squeeze=False).ravel() if panels else []
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    for axis, (title, panel_rows, label) in zip(axes, panels, strict=False):
        scenario = panel_rows[0].scenario
        _draw_bars(axis, panel_rows, title, label, _find_partial_entries(rows, scenario))
        over_bound = [r for r in rows if (r.scenario, r.metric) == (scenario, "rmse_over_bound")]
        ratios = {r.estimator: r.value for r in over_bound}
        bounded = [row for row in panel_rows if row.estimator in ratios]
        for row in bounded[:1]:  # the bound is the same for all
            value = 1e3 * row.value / ratios[row.estimator]
            axis.axvline(value, color=INK, linewidth=1.5)
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
            axis.text(value, -0.4, " the bound", color=INK, fontsize=8, va="center", bbox=box)
    with atomic_file(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:] or "png", dpi=110)


def _is_shown(row: ResultRow) -> bool:
    """Whether a row stands in the picture: of the scores those on the controller's own filter."""
    return row.metric != "score" or Entry(row.controller, row.estimator).is_default


def _find_partial_entries(rows: Sequence[ResultRow], tier: str) -> set[str]:
    """Find the controllers that drive a part of a tier's tasks, so that theirs is another score."""
    of_tier = {task.name for task in list_scored_tasks() if f"tier {task.tier}" == tier}
    driven: dict[str, set[str]] = {}
    for row in rows:
        if row.metric == "score" and row.scenario in of_tier and _is_shown(row):
            driven.setdefault(row.controller, set()).add(row.scenario)
    return set(driven.keys() - select_complete(driven).keys())


def _draw_maps(strip: "SubFigure", share_map: ShareMap) -> None:
    """Shares over two axes in a row, a panel a name, with the line at one half."""
    from matplotlib.colors import LinearSegmentedColormap

    scale = LinearSegmentedColormap.from_list("share", SHARE_SCALE)
    strip.suptitle(share_map.title, fontsize=9)
    axes = strip.subplots(1, len(share_map.shares), squeeze=False, sharey=True)[0]
    for axis, (name, share) in zip(axes, share_map.shares.items(), strict=True):
        image = axis.pcolormesh(share_map.x, share_map.y, share, cmap=scale, vmin=0.0, vmax=1.0)
        if share.min() < 0.5 < share.max():
            axis.contour(share_map.x, share_map.y, share, [0.5], colors=INK, linewidths=1.0)
        axis.set_title(name, fontsize=8)
        axis.set_xlabel(share_map.x_label, fontsize=7)
        axis.tick_params(labelsize=7)
    axes[0].set_ylabel(share_map.y_label, fontsize=7)
    strip.colorbar(image, ax=axes).ax.tick_params(labelsize=7)


def _draw_bars(
    axis: "Axes", rows: Sequence[ResultRow], title: str, label: str, parted: set[str]
) -> None:
    """Horizontal bars, the best on top: the smallest error or the highest score."""
    sign = 1.0 if rows[0].metric == "score" else -1.0
    ordered = sorted(rows, key=lambda row: sign * row.value)
    names = [row.estimator if row.metric == "rmse" else row.controller for row in ordered]
    scale = 1e3 if METRICS[rows[0].metric] == "rad" else 1.0
    values = [scale * row.value for row in ordered]
    colours = [find_colour(name) for name in names]
    ends = [[row.value - row.low for row in ordered], [row.high - row.value for row in ordered]]
    errors = [[scale * length for length in side] for side in ends]
    bars = axis.barh(names, values, color=colours, xerr=errors, ecolor="0.3", capsize=2)
    for bar, name in zip(bars, names, strict=True):
        if "," in name or name in parted:  # a variant of a known name wears its colour, hatched
            bar.set(hatch="//", edgecolor="white")
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(label, fontsize=8)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
