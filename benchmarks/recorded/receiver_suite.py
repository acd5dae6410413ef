"""Question: do a receiver's fixes filter better with noise that follows HDOP? (NMEA logs)"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import spearmanr

from ... import __version__
from ...envs.backend.files import atomic_file
from ...envs.record import Array
from ...envs.recordings.nmea import HOUR, Counts
from ...envs.recordings.sources import read_nmea
from ..harness.results import ResultRow, ResultTable, Suite, write_text
from ..harness.stats import Estimate
from ..harness.verdict import format_verdict
from ..report.kml import make_track_kml
from .receiver import (
    MIN_NOISE,
    SAME,
    NoiseLawResult,
    Signal,
    Track,
    compare,
    compute_gain,
    make_signals,
    make_track,
)

DEGREES = 180.0 / math.pi
TUNED, FIXED = "table", "constant"
CLASSES = {"HDOP below 2": (0.0, 2.0), "2 to 5": (2.0, 5.0), "5 and more": (5.0, math.inf)}
_NEGLIGIBLE = 0.01  # of log-likelihood a fix: nobody would notice
_WEAK_CORRELATION = 0.3  # a rank correlation that explains little
_ROWS = {"position": "prediction_error", "course": "course_prediction_error"}
_ALL = {"likelihood": "log_likelihood", "square": "nis"}


class ReceiverReplay(NamedTuple):
    """A receiver's log: its fixes, and each signal with the results of the laws."""

    name: str
    track: Track
    outcomes: list[tuple[Signal, dict[str, NoiseLawResult]]]
    counts: Counts


def replay_nmea(log: str | Path, *no_drive: object) -> ReceiverReplay:
    """Read a receiver's log and compare the laws of its noise on it (needs the extra `wires`).

    no_drive: what only a drive with a gyro has, a vehicle and a mapping: None or empty. Raises what
    `read_nmea` does, and ValueError, with the path, for a log too short to compare.
    """
    path = Path(log)
    if any(no_drive):
        raise ValueError(f"{path}: a receiver's log takes no vehicle and no mapping")
    epochs, counts = read_nmea(path)
    track = make_track(epochs)
    try:
        if not len(track.t):
            raise ValueError("no fix has an HDOP: expected GGA, GNS or GSA sentences with one")
        outcomes = [(signal, compare(signal)) for signal in make_signals(track)]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return ReceiverReplay(f"{path.resolve().parent.name}/{path.stem}", track, outcomes, counts)


def make_receiver_suite(replay: ReceiverReplay) -> Suite:
    """The answer, the counts, the numbers of each law, the track."""
    track = replay.track
    low, middle, high = np.percentile(track.hdop, (5, 50, 95))
    step = np.diff(track.t)
    set_anew = np.abs(step) >= HOUR  # a clock that was set, or a pause
    parts = f" in {set_anew.sum() + 1} parts" if set_anew.any() else ""
    text = (
        f"{step[~set_anew].sum():.0f} s with {len(track.t)} fixes{parts}; HDOP {middle:.1f}, from "
        f"{low:.1f} to {high:.1f} in 90 % of them; {np.median(track.satellites):.0f} satellites. "
        "A filter with a constant rate, disturbed by white noise, predicts each fix from those "
        "before, where the car moves. Its two noises are those of maximum likelihood on the first "
        "half of the log; all numbers are of the second."
    )
    suite = Suite("replay", f"A receiver's log: {replay.name}", text)
    suite.verdict = compose_verdict(replay)
    suite.rows = [
        row for signal, results in replay.outcomes for row in _make_rows(replay, signal, results)
    ]
    suite.tables = [_make_table(signal, results) for signal, results in replay.outcomes]
    counts = [[what, str(n)] for what, n in replay.counts.rows()]
    suite.tables.append(
        ResultTable("What came from the receiver", ("what", "count"), counts, keyed=False)
    )
    suite.figures = _draw_figures(replay)
    return suite


def compose_verdict(replay: ReceiverReplay) -> str:
    """The verdict."""
    tuned, fixed = (replay.outcomes[0][1][law] for law in (TUNED, FIXED))
    rank = float(spearmanr(fixed.hdop, fixed.error).statistic)
    errors = [
        f"{np.median(result.error):.2f} m ({np.percentile(result.error, 95):.1f} m)"
        for result in (tuned, fixed)
    ]
    why = "." if abs(rank) > _WEAK_CORRELATION else ", as of a receiver that smooths its fixes."
    return format_verdict(
        *(_describe_gain(signal.name, results) for signal, results in replay.outcomes),
        f"Error of the next fix, median (95 %): {errors[0]} tuned by HDOP, {errors[1]} constant.",
        f"Why: the rank correlation of that error with HDOP is {rank:.2f}{why}",
        "Not covered: how far fixes are from the truth; other receivers. Likelihood: nats a fix.",
    )


def _describe_gain(name: str, results: Mapping[str, NoiseLawResult]) -> str:
    number = compute_gain(results[TUNED], results[FIXED])
    value, low, high = number
    what = f"Tuning the noise of {name} by HDOP"
    if max(abs(low), abs(high)) < _NEGLIGIBLE:
        return f"{what} changes nothing: log-likelihood {value:+.3f}."
    how = "pays" if low > 0.0 else "costs" if high < 0.0 else "is not seen to pay"
    return f"{what} {how}: log-likelihood {number.inline(digits='+.2f')}."


def _make_rows(
    replay: ReceiverReplay, signal: Signal, results: Mapping[str, NoiseLawResult]
) -> list[ResultRow]:
    rows = []
    for law, result in results.items():
        where = {
            "suite": "replay", "scenario": f"{replay.name}: {signal.name}", "estimator": law,
            "n": len(result.error), "env_version": f"replay {__version__}",
        }  # fmt: skip
        rms = Estimate(float(np.sqrt(np.mean(result.error**2))))
        rows.append(ResultRow.from_estimate(_ROWS[signal.name], rms, **where))
        for column, metric in _ALL.items():
            rows.append(
                ResultRow.from_estimate(
                    metric, Estimate(float(getattr(result, column).mean())), **where
                )
            )
        if law != FIXED:
            rows.append(
                ResultRow.from_estimate("difference", compute_gain(result, results[FIXED]), **where)
            )
    return rows


def _make_table(signal: Signal, results: Mapping[str, NoiseLawResult]) -> ResultTable:
    scale, unit = (DEGREES, "deg") if signal.axes == 1 else (1.0, signal.unit)
    cells = []
    for law, result in results.items():
        error = scale * result.error
        more = "-"
        if law != FIXED:
            more = compute_gain(result, results[FIXED]).inline(digits="+.3f")
        numbers = [np.median(error), np.sqrt(np.mean(error**2)), np.percentile(error, 95)]
        numbers += [result.likelihood.mean(), result.square.mean()]
        noise = f"{scale * result.r:.3g}" if result.r > 1.5 * MIN_NOISE else "none seen"
        cells.append([law, noise, *(f"{number:.2f}" for number in numbers), more])
    header = ("noise", f"at HDOP 1 / {unit}", "median", "rms", "95 %", "log-likelihood", "NIS",
              "against constant")  # fmt: skip
    note = (
        f"Errors in {unit} of {len(result.error)} fixes. constant, half, table: how the noise "
        f"follows HDOP; {SAME}: what `table` has on average, while `constant` "
        "has its own. NIS is 1 for a filter that knows its errors; intervals by blocks of fixes."
    )
    if signal.axes == 1:
        note += " The noise of course is that at 1 m/s, it falls with speed."
    return ResultTable(f"The next {signal.name}, predicted", header, cells, note, keyed=False)


def write_kml(path: Path, replay: ReceiverReplay) -> None:
    """The fixes as a track for a map."""
    track = replay.track
    fixes = {"fixes": (track.east, track.north)}
    write_text(path, make_track_kml(replay.name, fixes, origin=track.origin))


def _draw_figures(replay: ReceiverReplay) -> list[tuple[str, Any, str]]:
    """The track by classes of HDOP, and HDOP over time; nothing without plotly."""
    try:
        from ..report.figures import draw_time_series, draw_track
    except ModuleNotFoundError:
        return []
    now = replay.track
    shown = {
        name: (_select_values(now, ends, now.east), now.north) for name, ends in CLASSES.items()
    }
    time = now.t - now.t[0]
    return [
        (
            f"{replay.name}: the track",
            draw_track(shown),
            "East and north of the first fix, by HDOP.",
        ),
        (f"{replay.name}: HDOP", draw_time_series(time, {"HDOP": now.hdop}, "HDOP"), ""),
    ]


def _select_values(track: Track, ends: tuple[float, float], values: Array) -> Array:
    """The values where HDOP lies within the ends, else NaN."""
    return np.where((track.hdop >= ends[0]) & (track.hdop < ends[1]), values, np.nan)


def draw(path: Path, replay: ReceiverReplay) -> None:
    """The track and the errors of the next fix by HDOP, as a picture; needs the extra `report`."""
    try:
        from matplotlib.colors import LogNorm
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "pictures need matplotlib: pip install 'sideslip[report]'"
        ) from None
    track, result = replay.track, replay.outcomes[0][1][FIXED]
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(4, 3))
    look = {"c": track.hdop, "norm": LogNorm(1.0, 20.0), "cmap": "cividis_r", "s": 5}
    dots = left.scatter(track.east, track.north, **look)
    figure.colorbar(dots, ax=left, label="HDOP", ticks=[1, 2, 5, 10, 20], format="%g")
    left.set(aspect="equal", adjustable="datalim", xlabel="east / m", ylabel="north / m")
    left.set_title(replay.name, fontsize=10)
    right.scatter(result.hdop, np.maximum(result.error, 0.01), s=6, color="#0072B2", alpha=0.5)
    line = np.array([1.0, 20.0])
    right.plot(line, line * np.median(result.error / result.hdop), color="#D55E00")
    right.set(xscale="log", yscale="log", xlabel="HDOP", ylabel="error of the next fix / m")
    right.set_title("line: errors that follow HDOP", fontsize=10)
    with atomic_file(path) as file:
        figure.savefig(file, format=path.suffix[1:] or "png", dpi=100)
