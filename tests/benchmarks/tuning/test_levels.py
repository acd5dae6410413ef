"""The search of levels: its drives, its score, and that it finds levels that are wrong."""

import numpy as np
import pytest
from rich.console import Console

from sideslip.benchmarks.tuning.levels import (
    _convert_levels,
    _search,
    draw_drive,
    get_levels,
    run_filter,
)
from sideslip.benchmarks.tuning.next_car import PARTS, main


def test_a_seed_is_a_drive_and_five_seeds_are_all_kinds_of_sensors() -> None:
    first, again = (draw_drive(3, 4.0) for _ in range(2))
    assert np.array_equal(first.log.record.fast, again.log.record.fast)
    drives = [draw_drive(seed, 4.0) for seed in range(5)]
    assert [sorted(x.log.slow) for x in drives] == [
        ["camera"],
        ["gps"],
        ["camera", "gps"],
        ["gps"],
        [],
    ]
    assert [x.log.record.dt for x in drives] == [0.001] * 3 + [0.01] * 2
    assert all(x.facts["vehicle"] != drives[0].facts["vehicle"] for x in drives[1:])
    for drive in drives:  # the levels in use are the defaults
        error, deviation = run_filter(drive, _convert_levels(get_levels(), drive.log))
        assert np.isfinite(error).all() and (deviation > 0.0).all()


def test_every_part_can_be_left_out() -> None:
    drive = draw_drive(2, 3.0)
    whole = run_filter(drive, {})[0]
    for name, options in list(PARTS.items())[1:]:
        assert not np.array_equal(run_filter(drive, options)[0], whole), name


@pytest.mark.long
def test_levels_that_are_far_off_are_left() -> None:
    start = get_levels() | {"gyro_noise": 0.1, "force_share": 0.5}
    _, found, before = _search(start, 36, 10, 1, Console(quiet=True))
    assert found < before - 0.1


@pytest.mark.long
def test_the_table_of_parts_is_written(tmp_path) -> None:  # type: ignore[no-untyped-def]
    main(3, tmp_path / "table.json", 1)
    assert "without tyres" in (tmp_path / "table.json").read_text()
