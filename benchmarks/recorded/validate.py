"""Whether an identified car stays near held-out parts of its log, driven by steering and speed."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from ...envs.record import PACKET, Array, Log
from ...envs.vehicle.parameters import Vehicle
from ...estimators.wires import SignalCalibration, apply_wires
from ..harness.results import Column, ResultTable
from .bicycle_fit import compute_residual, make_windows, simulate_windows
from .identify import identify
from .quality import find_saturated

_BLOCK, _MOST_BLOCKS = 12.0, 16  # s, the shortest; of a part
# ISO 19364 (steady-state circular driving) and ISO 22140 (lateral transient response) compare a
# simulation with tolerances around what was measured. Their texts are not at hand: these numbers
# are assumed. name: factor to the unit shown, unit, offset in it, share of the measured value
_CORRIDORS = {
    "yaw rate": (180.0 / np.pi, "deg/s", 1.0, 0.1),
    "lateral acceleration": (1.0, "m/s2", 0.3, 0.1),
    "sideslip angle": (180.0 / np.pi, "deg", 0.3, 0.15),
}
_MIN_SHARE, _MAX_GAIN_ERROR = 0.95, 0.1  # assumed as well
_NOTE = (
    "Odd blocks identify, even ones are driven open loop: the model's first second forgets its "
    "start, 4 s count. A sample is inside within offset + share x what was measured; a channel "
    f"stays inside with {100.0 * _MIN_SHARE:.0f} % of its samples and a gain (simulated over "
    f"measured, by least squares) within {100.0 * _MAX_GAIN_ERROR:.0f} % of 1. Form after "
    "ISO 19364 and ISO 22140, whose text was not at hand: all tolerances are assumptions, and "
    "this is no proof of conformity."
)


def _cut(log: Log, start: int, end: int) -> Log:
    """Cut rows out of a log, with the packets that were captured and arrived in them."""
    record, packets = log.record, log.record.packets
    first, behind = record.first + start, record.first + end
    within = (packets[:, PACKET.captured] >= first) & (packets[:, PACKET.arrived] < behind)
    fast = record.fast[start:end]
    record = dataclasses.replace(record, fast=fast, packets=packets[within], first=first)
    truth = {name: values[start:end] for name, values in log.truth.items()}
    return dataclasses.replace(log, record=record, truth=truth)


def _split_blocks(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Split logs into odd blocks, to identify from, and even ones, which are held out."""
    blocks = []
    for log in logs:
        count = int(np.clip(len(log.time) * log.record.dt / _BLOCK, 1, _MOST_BLOCKS))
        ends = np.linspace(0, len(log.time), count + 1).astype(int).tolist()
        blocks += [_cut(log, *pair) for pair in itertools.pairwise(ends)]
    return blocks[::2], blocks[1::2]


def make_validation_table(
    logs: Sequence[Log], car: Vehicle, wires: SignalCalibration | None, tyres: str | None
) -> ResultTable:
    """Identify a car from odd blocks of a log and compare its motion with the even ones.

    Args:
        logs: Parts of the log.
        car: Stated car.
        wires: Stated calibration of the signals.
        tyres: Law of the tyres, as for `identify`.

    Returns:
        A row for each channel; none, with the reason in the note, where nothing is identified.
    """
    moved = [apply_wires(log, SignalCalibration(at=wires.at if wires else {})) for log in logs]
    odd, even = _split_blocks(moved)
    wires = wires and wires._replace(at={})
    result = identify(odd, car, wires, tyres)
    w = make_windows(even, [find_saturated(log) for log in even]) if even else None
    reason = result.reason
    if w is None or not len(w.starts):
        reason = reason or "no window of 5 s is held out"
    title = "Does the found car stay within assumed corridors of ISO 19364 / 22140?"
    columns = (
        "channel", Column("rmse", "RMSE", form=".3g"), "unit", "corridor",
        Column("inside", "inside / %", 100.0, ".0f"), Column("gain", "gain", form=".3f"), "stays",
    )  # fmt: skip
    if reason or result.theta is None or w is None:
        return ResultTable(title, columns, [], f"Not validated: {reason}.", keyed=False)
    w = dataclasses.replace(w, tyres=result.tyres)
    places, residual = w.scored_rows, compute_residual(car, result.theta, w)
    measured = {
        name: (w.rows[i][places], w.rows[i][places] - residual[:, i])
        for i, name in enumerate([*_CORRIDORS][: 2 if w.accel else 1])
    }
    if all("beta" in log.truth for log in even):
        every = round(w.dt / even[0].record.dt)
        truth = np.concatenate([log.truth["beta"][::every] for log in even])
        # with the antenna at the centre of gravity its sideslip angle is the car's
        slip = simulate_windows(car.replace(antenna_ahead=0.0), result.theta, w)[2]
        if np.isfinite(truth[places]).any():
            measured["sideslip angle"] = truth[places], slip[:, places[0] - w.starts[0] - 1]
    cells = [_compare(name, *pair) for name, pair in measured.items()]
    return ResultTable(title, columns, cells, _NOTE, keyed=False)


def _compare(name: str, measured: Array, simulated: Array) -> list[object]:
    """Cells of a channel: measured and simulated, shape (windows, rows)."""
    factor, unit, offset, share = _CORRIDORS[name]
    known = np.isfinite(measured)
    x, y = factor * measured[known], factor * simulated[known]
    inside = float(np.mean(np.abs(y - x) <= offset + share * np.abs(x)))
    gain = float(x @ y / (x @ x))
    stays = inside >= _MIN_SHARE and abs(gain - 1.0) <= _MAX_GAIN_ERROR
    corridor = f"{offset:g} + {100.0 * share:.0f} %"
    rmse = float(np.sqrt(np.mean((y - x) ** 2)))
    return [name, rmse, unit, corridor, inside, gain, "yes" if stays else "no"]
