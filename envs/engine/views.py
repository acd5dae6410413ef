"""What an episode's packed numbers tell: its car, its sensors' clocks, its record, its info."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, overload

import numpy as np
import numpy.typing as npt

from .dynamics import Motion
from .layout import Array, P, Z
from .record import SLOW_NAMES, TICK, Record, SlowSensor
from .sensors import ticks
from .switches import REPORT, RUNNING
from .template import Template
from .vehicle import Vehicle

T = TypeVar("T")

_NUMBERS = REPORT._fields[: REPORT.failure]  # of `info`; `failure` and `is_success` follow
_KEYS = (*_NUMBERS, "failure", "is_success")
_MASKS = tuple(f"_{key}" for key in _KEYS)


def vehicle_in(template: Template, params: Array, state: Array) -> Vehicle:
    """The true vehicle now, with what the seed drew; friction is the mean of both sides'."""
    if not params[P.car] > 0.0:  # not reset yet
        return template.vehicle
    changed = state[Z.clock + 2] >= params[P.change]
    return template.vehicle.replace(
        front_stiffness=float(params[P.car + 4] * (params[P.change + 1] if changed else 1.0)),
        rear_stiffness=float(params[P.car + 5] * (params[P.change + 2] if changed else 1.0)),
        friction=float(0.5 * (params[P.car + 10] + params[P.car + 19])),
    )


def slow_in(template: Template, state: Array) -> dict[str, SlowSensor]:
    """The slow sensors by name, with the clock phase that the episode drew."""
    told = {}
    for name, sensor in template.slow.items():
        if sensor.phase is None:
            at = Z.camera if name == SLOW_NAMES[0] else Z.gps
            frames, upcoming = state[at], state[at + 1]
            first = upcoming - frames * ticks(sensor.period)
            sensor = dataclasses.replace(sensor, phase=first * TICK)
        told[name] = sensor
    return told


def motion_in(state: Array) -> Motion:
    """The true velocities, heading, place and roll now, in SI units."""
    return Motion(*state[Z.motion : Z.motion + len(Motion._fields)].tolist())


def record_in(state: Array, rows: Array, packets: Array) -> Record:
    """The record whose fast rows end now (copies)."""
    return Record(rows.copy(), packets.copy(), int(state[Z.clock + 2]) - len(rows) + 1)


def info_of(report: Array) -> tuple[dict[str, Any], int]:
    """`info` of a step or a reset from a report (len(Report),), and how many packets came."""
    (
        t, beta, gamma, psi, beta_ref, gamma_ref, steer, yaw_moment, cost,
        code, delivered, _, ended,
    ) = report.tolist()  # fmt: skip
    failure = int(code)
    return {
        "t": t,
        "beta": beta,
        "gamma": gamma,
        "psi": psi,
        "beta_ref": beta_ref,
        "gamma_ref": gamma_ref,
        "steer": steer,
        "yaw_moment": yaw_moment,
        "cost": cost,
        "failure": failure,
        "is_success": ended == 1.0 and failure == RUNNING,
    }, int(delivered)


def infos_of(reports: Array, rows: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """The infos of some rows of a batch as Gymnasium's vector environments tell them.

    reports: (N, len(Report)). rows: (N,) whose infos are told; of the others stand zeros. Every
    key has an array (N,) and, with an underscore before it, a mask.
    """
    if rows.all():
        columns = reports.T.copy()
    else:
        columns = np.zeros(reports.shape[::-1])
        columns[:, rows] = reports[rows].T
    failure = columns[REPORT.failure].astype(np.int64)
    success = (columns[REPORT.ended] == 1.0) & (failure == RUNNING)
    told = (*columns[: len(_NUMBERS)], failure, success)
    masks = np.empty((len(told), len(rows)), np.bool_)
    masks[:] = rows
    infos: dict[str, Any] = dict(zip(_KEYS, told, strict=True))
    infos.update(zip(_MASKS, masks, strict=True))
    return infos


class Each(Sequence[T]):
    """Something of every row of a batch, made when it is asked for."""

    def __init__(self, count: int, of: Callable[[int], T]) -> None:
        self._rows, self._of = range(count), of

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int) -> T: ...
    @overload
    def __getitem__(self, i: slice) -> tuple[T, ...]: ...
    def __getitem__(self, i: int | slice) -> T | tuple[T, ...]:
        if isinstance(i, slice):
            return tuple(map(self._of, self._rows[i]))
        return self._of(self._rows[i])

    def __repr__(self) -> str:
        return f"<{len(self)} rows>"
