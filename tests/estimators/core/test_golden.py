"""The default filters still say what they said; a change is made on purpose and seen in the diff.

1e-9 of a column's range, not bits: the compiled core does the same IEEE arithmetic everywhere, but
gains come from BLAS and LAPACK, which sum in an order of their own on each machine, and from a
recursion that ends when its gains change by less than 1e-12.
"""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import Log
from sideslip.envs.vehicle.parameters import Vehicle
from tests.estimators.golden.recording import (
    CASES,
    FOLDER,
    TOLERANCE,
    Table,
    changes,
    drive,
    path,
    read,
    table_of_filter,
    table_of_record,
)

HINT = "if that is on purpose: python -m tests.estimators.golden, and commit what changed"


@pytest.fixture(scope="module")
def driven() -> tuple[Log, Vehicle]:
    return drive()


def compare(what: str, golden: Table, now: Table) -> None:
    """AssertionError that names the largest change."""
    assert now[0] == golden[0], f"{what} has other columns; {HINT}"
    assert np.isfinite(now[1]).all(), what
    change = changes(golden, now)
    row, column = np.unravel_index(change.argmax(), change.shape)
    assert change.max() <= TOLERANCE, (
        f"{what}: {golden[0][column]} at tick {golden[1][row, 0]:g} was "
        f"{golden[1][row, column]:.12g}, is {now[1][row, column]:.12g} "
        f"({change.max():.2g} of its range); {HINT}"
    )


def test_the_drive_is_the_one_that_was_recorded(driven: tuple[Log, Vehicle]) -> None:
    compare("the drive itself", read(path("record")), table_of_record(driven[0]))


@pytest.mark.parametrize(("name", "sensor"), CASES)
def test_a_default_filter_says_what_it_said(name: str, sensor: str, driven: Any) -> None:
    compare(f"{name} {sensor}", read(path(name, sensor)), table_of_filter(name, sensor, *driven))


def test_there_is_one_recording_for_each_and_none_besides() -> None:
    wanted = {path(name, sensor) for name, sensor in CASES} | {path("record")}
    assert set(FOLDER.glob("*.csv")) == wanted


def test_a_change_of_a_millionth_is_seen() -> None:
    names, rows = read(path("exact-kf", "camera"))
    moved = rows.copy()
    moved[7, 1] *= 1.0 + 1e-6
    with pytest.raises(AssertionError, match="exact-kf: beta at tick 1992 was"):
        compare("exact-kf", (names, rows), (names, moved))
