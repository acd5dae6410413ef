"""What `info` contains: the report of a step and its names."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..record import Array
from .failures import RUNNING


class StepReport(NamedTuple):
    """Columns of the report of a step, from which `info` is made."""

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


REPORT = StepReport()

_NUMBERS = REPORT._fields[: REPORT.failure]  # of `info`; `failure` and `is_success` follow
_KEYS = (*_NUMBERS, "failure", "is_success")
_RUNNING: dict[str, Any] = dict.fromkeys(_NUMBERS, 0.0) | {"failure": RUNNING, "is_success": False}
_MASKS = tuple(f"_{key}" for key in _KEYS)


def make_info(report: list[float]) -> dict[str, Any]:
    """Make `info` of a step or a reset.

    Args:
        report: Report of the step, a number for each column of `StepReport`.

    Returns:
        The info.
    """
    info = _RUNNING.copy()  # a copy's keys need no sorting in
    (
        info["t"], info["beta"], info["gamma"], info["psi"], info["beta_ref"], info["gamma_ref"],
        info["steer"], info["yaw_moment"], info["cost"], code, _, _, ended,
    ) = report  # fmt: skip
    if code != RUNNING:
        info["failure"] = int(code)
    elif ended == 1.0:
        info["is_success"] = True
    return info


def make_infos(reports: Array, rows: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Make the infos of some rows of a batch as Gymnasium's vector environments have them.

    Args:
        reports: Reports, shape (N, len(StepReport)).
        rows: Rows that are reported, shape (N,); the others have zeros.

    Returns:
        An array (N,) for every key and, with an underscore before it, a mask.
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
