"""The benchmark at a glance: one PNG from the rows, for a README."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..envs.backend.extras import extra
from ..envs.backend.files import whole
from ..envs.rendering.palette import INK, colour
from .control.answer import everywhere, on_its_own
from .control.contests import TITLES, contests
from .harness.metrics import METRICS
from .harness.results import Row, ShareMap, Suite
from .report.colours import SHARE_SCALE

_ACROSS = 3  # panels


def write_picture(path: str | Path, suites: Sequence[Suite]) -> None:
    """Bars of every estimator's error and the controllers' scores, with their intervals.

    Needs the extra `report`. Raises ValueError if no suite has a row to draw.
    """
    with extra("report", "pictures need matplotlib"):
        from matplotlib.figure import Figure
    rows = [row for suite in suites for row in suite.rows]
    error = "error of sideslip / mrad"
    score = "score (0: nominal, 1: oracle-state)\nhatched: of a part of the contests"
    panels = [
        (title, [r for r in rows if (r.scenario, r.metric) == key and _shown(r)], label)
        for title, key, label in (
            ("Estimating with a late camera", ("tie-vision-fig7", "rmse"), error),
            ("Estimating with GPS, wind, outage", ("dakf-fig6", "rmse"), error),
            *(
                (f"Tier {tier}\n{what}", (f"tier {tier}", "score"), score)
                for tier, what in TITLES.items()
            ),
        )
    ]
    panels = [panel for panel in panels if panel[1]]
    maps = [each for suite in suites for each in suite.maps]
    if not (panels or maps):
        raise ValueError(
            "nothing to draw: the picture needs the suites estimation, control or recovery"
        )
    across = min(len(panels), _ACROSS)
    down = -(-len(panels) // max(across, 1))
    heights = [down] * bool(panels) + [1] * len(maps)
    wide = max([4.0 * across, *(2.4 * len(each.shares) for each in maps)])
    most = max([len(mine) for _, mine, _ in panels], default=0)
    high = down * max(2.6, 0.17 * most + 0.8) * bool(panels) + 2.6 * len(maps)
    figure = Figure(figsize=(wide, high), layout="constrained")
    strips = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for strip, each in zip(strips[bool(panels) :], maps, strict=True):
        _maps(strip, each)
    axes = strips[0].subplots(down, across, squeeze=False).ravel() if panels else []
    for axis in axes[len(panels) :]:
        axis.set_axis_off()
    for axis, (title, mine, label) in zip(axes, panels, strict=False):
        _bars(axis, mine, title, label, in_part(rows, mine[0].scenario))
        over = {r.estimator: r.value for r in rows
                if r.metric == "rmse_over_bound" and r.scenario == mine[0].scenario}  # fmt: skip
        for row in mine:
            if row.estimator in over:
                _limit(axis, 1e3 * row.value / over[row.estimator])
                break
    with whole(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:] or "png", dpi=110)


def _shown(row: Row) -> bool:
    """Whether a row stands in the picture: of the scores those on the controller's own filter."""
    return row.metric != "score" or on_its_own(row.controller, row.estimator)


def in_part(rows: Sequence[Row], tier: str) -> set[str]:
    """Controllers that drive a part of a tier's contests, so that theirs is another's score."""
    of_tier = {each.name for each in contests() if f"tier {each.tier}" == tier}
    driven: dict[str, set[str]] = {}
    for row in rows:
        if row.metric == "score" and row.scenario in of_tier and _shown(row):
            driven.setdefault(row.controller, set()).add(row.scenario)
    return set(driven.keys() - everywhere(driven).keys())


def _maps(strip: Any, shown: ShareMap) -> None:
    """Shares over two axes in a row, a panel a name, with the line at one half."""
    from matplotlib.colors import LinearSegmentedColormap

    scale = LinearSegmentedColormap.from_list("share", SHARE_SCALE)
    strip.suptitle(shown.title, fontsize=9)
    axes = strip.subplots(1, len(shown.shares), squeeze=False, sharey=True)[0]
    for axis, (name, share) in zip(axes, shown.shares.items(), strict=True):
        image = axis.pcolormesh(shown.x, shown.y, share, cmap=scale, vmin=0.0, vmax=1.0)
        if share.min() < 0.5 < share.max():
            axis.contour(shown.x, shown.y, share, [0.5], colors=INK, linewidths=1.0)
        axis.set_title(name, fontsize=8)
        axis.set_xlabel(shown.x_label, fontsize=7)
        axis.tick_params(labelsize=7)
    axes[0].set_ylabel(shown.y_label, fontsize=7)
    strip.colorbar(image, ax=axes).ax.tick_params(labelsize=7)


def _limit(axis: Any, value: float) -> None:
    axis.axvline(value, color=INK, linewidth=1.5)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0}
    axis.text(value, -0.4, " the bound", color=INK, fontsize=8, va="center", bbox=box)


def _bars(axis: Any, rows: Sequence[Row], title: str, label: str, parted: set[str]) -> None:
    """Horizontal bars, the best on top: the smallest error or the highest score."""
    sign = 1.0 if rows[0].metric == "score" else -1.0
    ordered = sorted(rows, key=lambda row: sign * row.value)
    names = [row.estimator if row.metric == "rmse" else row.controller for row in ordered]
    scale = 1e3 if METRICS[rows[0].metric] == "rad" else 1.0
    values = [scale * row.value for row in ordered]
    colours = [colour(name) for name in names]
    errors = [
        [scale * (row.value - row.low) for row in ordered],
        [scale * (row.high - row.value) for row in ordered],
    ]
    bars = axis.barh(names, values, color=colours, xerr=errors, ecolor="0.3", capsize=2)
    for bar, name in zip(bars, names, strict=True):
        if "," in name or name in parted:  # a variant of a known name wears its colour, hatched
            bar.set(hatch="//", edgecolor="white")
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(label, fontsize=8)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
