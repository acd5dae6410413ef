"""What `info` contains: the report of a step and its names."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..record import Array
from .failures import RUNNING


class Report(NamedTuple):
    """Columns of the numbers that go into `info`."""

    t: int = 0
    beta: int = 1
    gamma: int = 2
    psi: int = 3
    beta_ref: int = 4
    gamma_ref: int = 5
    steer: int = 6
    yaw_moment: int = 7
    cost: int = 8
    failure: int = 9
    packets: int = 10
    reward: int = 11
    ended: int = 12  # 1 the time is over


REPORT = Report()

_NUMBERS = REPORT._fields[: REPORT.failure]  # of `info`; `failure` and `is_success` follow
_KEYS = (*_NUMBERS, "failure", "is_success")
_MASKS = tuple(f"_{key}" for key in _KEYS)


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
    """The infos of some rows of a batch as Gymnasium's vector environments have them.

    reports: (N, len(Report)). rows: (N,) that are reported; the others have zeros. Every
    key has an array (N,) and, with an underscore before it, a mask.
    """
    if rows.all():
        columns = reports.T.copy()
    else:
        columns = np.zeros(reports.shape[::-1])
        columns[:, rows] = reports[rows].T
    failure = columns[REPORT.failure].astype(np.int64)
    success = (columns[REPORT.ended] == 1.0) & (failure == RUNNING)
    values = (*columns[: len(_NUMBERS)], failure, success)
    masks = np.empty((len(values), len(rows)), np.bool_)
    masks[:] = rows
    infos: dict[str, Any] = dict(zip(_KEYS, values, strict=True))
    infos.update(zip(_MASKS, masks, strict=True))
    return infos
