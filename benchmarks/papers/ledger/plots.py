"""The papers' figures from an example's signals: axes and curves as the papers have them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ....envs.record import PACKET, Array
from .claim import Example

Draw = Callable[[Example], Any]


@dataclass(frozen=True)
class PaperFigure:
    """One figure of a paper, redrawn. scenario: of the simulation. caption: what to see."""

    paper: str
    title: str
    scenario: str
    draw: Draw
    caption: str


def _draw_lines(
    example: Example,
    series: Mapping[str, Array],
    y_label: str,
    window: tuple[float, float] | None = None,
    **more: Any,
) -> Any:
    """Lines over time, in a window (s) of it; more: of `draw_time_series`."""
    from ...report.figures import draw_time_series

    t = example.time
    inside = (t >= window[0]) & (t <= window[1]) if window else np.ones(len(t), bool)
    shown = {name: signal[inside] for name, signal in series.items()}
    return draw_time_series(t[inside], shown, y_label, **more)


def make_curves(
    signal: str,
    y_label: str,
    labels: Sequence[str] = (),
    window: tuple[float, float] | None = None,
    x_label: str = "time / s",
) -> Draw:
    """A signal of everybody (or of those named) over time. window: s, of the time axis."""

    def draw(example: Example) -> Any:
        signals = {name: example.curves.get(name, {}) for name in labels or example.curves}
        series = {name: values[signal] for name, values in signals.items() if signal in values}
        return _draw_lines(example, series, y_label, window, x_label=x_label)

    return draw


def make_loops(y_label: str) -> Draw:
    """Open loops over frequency in Hz, on a logarithmic axis."""

    def draw(example: Example) -> Any:
        series = {name: signals["magnitude"] for name, signals in example.curves.items()}
        figure = _draw_lines(example, series, y_label, x_label="frequency / Hz")
        ends = np.log10(example.time[[0, -1]])
        figure.update_xaxes(type="log", range=[float(end) for end in ends])
        return figure

    return draw


def make_course(y_label: str, labels: Sequence[str]) -> Draw:
    """The course psi + beta: the truth, the receiver's samples and each filter's."""

    def draw(example: Example) -> Any:
        series = {
            name: example.curves[name]["psi"] + example.curves[name]["beta"] for name in labels
        }
        series["measured"] = extract_samples(example, "gps", 0, "arrived")
        return _draw_lines(example, series, y_label, dots=("measured",))

    return draw


def extract_samples(example: Example, sensor: str, row: int, at: str) -> Array:
    """A slow sensor's values at the ticks they were `captured` or `arrived`, NaN elsewhere."""
    values = np.full(len(example.time), np.nan)
    ticks = example.packets[sensor][:, getattr(PACKET, at)].astype(int)
    in_range = ticks < len(values)
    values[ticks[in_range]] = example.packets[sensor][in_range, PACKET.value + row]
    return values


def repeat_samples(values: Array) -> Array:
    """Samples held until the next one, as a controller without an estimator sees them."""
    known = np.flatnonzero(~np.isnan(values))
    last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
    out = np.full(len(values), np.nan)
    out[last >= 0] = values[known[last[last >= 0]]]
    return out


def make_offset(y_label: str, labels: Sequence[str], window: tuple[float, float]) -> Draw:
    """The lateral offset: truth, the camera's held late samples, and each filter's."""

    def draw(example: Example) -> Any:
        series = {name: example.curves[name]["y_l"] for name in labels}
        series["measured, held"] = repeat_samples(extract_samples(example, "camera", 1, "arrived"))
        return _draw_lines(example, series, y_label, window)

    return draw


def draw_delays(example: Example) -> Any:
    """The delay of the newest frame over the time of its capture, for the first second."""
    packets = example.packets["camera"]
    late = np.full(len(example.time), np.nan)
    ticks = packets[:, PACKET.captured].astype(int)
    late[ticks] = packets[:, PACKET.arrived] - packets[:, PACKET.captured]
    return _draw_lines(example, {"camera": repeat_samples(late)}, "delay / ms", (0.0, 1.0))
