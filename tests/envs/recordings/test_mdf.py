"""MDF is read by channel groups, each with stamps of its own; asammdf has written the files."""

import gc
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import FAST, PACKET
from sideslip.envs.recordings.log_file import read_parts

from .drives import drive, read_log, saved

asammdf = pytest.importorskip("asammdf")

DEG = np.pi / 180.0
TABLE = drive(1200)
TIME = TABLE["time_s"].to_numpy()
ROWS = np.arange(200, 1200, 20)  # of the course's samples
COURSE = (8.0 * np.sin(0.9 * TIME[ROWS]) + 358.0) % 360.0 - 180.0  # over +-180 deg


def signal(name: str, time: Any, values: Any, **more: Any) -> Any:
    return asammdf.Signal(np.asarray(values), np.asarray(time), name=name, **more)


def written(folder: Path, *groups: list[Any], version: str = "4.10") -> Path:
    with asammdf.MDF(version=version) as file:
        for group in groups:
            file.append(group)
        return Path(file.save(folder / "drive.mf4", overwrite=True))


def fast(*without: str) -> list[Any]:
    names = [name for name in TABLE if name not in ("time_s", *without)]
    return [signal(str(name), TIME, TABLE[name]) for name in names]


def gps(late: float = 0.0, name: str = "course_deg") -> list[Any]:
    return [signal(name, TIME[ROWS] + late, COURSE, unit="deg")]


@pytest.mark.parametrize("version", ["3.30", "4.10", "4.11"])
@pytest.mark.parametrize("late", [0.0, 0.004])
def test_a_slow_group_has_its_own_samples(tmp_path: Path, version: str, late: float) -> None:
    path = written(tmp_path, fast(), gps(late), version=version)
    (log,), remarks = read_parts(path)
    csv = read_log(saved(TABLE, tmp_path))
    for read in (log, read_log(path)):
        np.testing.assert_array_equal(read.record.fast, csv.record.fast)
        packets = read.record.select_packets("gps")
        np.testing.assert_array_equal(packets[:, PACKET.captured] - 300, ROWS + (late > 0.0))
        np.testing.assert_allclose(packets[:, PACKET.value] / DEG, COURSE, rtol=1e-12)
    assert log.time[0] == pytest.approx(3.0) and remarks == []


def test_the_fastest_group_has_the_rows(tmp_path: Path) -> None:
    slow, names = TIME[::4] + 0.003, ("steer_rad", "speed_x_mps")
    steer = signal("steer_rad", slow, 0.02 * np.sin(2.0 * slow + 0.3), unit="rad")
    speed = signal("Speed_X", slow - 0.5, 3.6 * (20.0 + np.sin(slow - 0.5)), unit="km/h")
    (log,), remarks = read_parts(written(tmp_path, [steer], [speed], fast(*names), gps()))
    same = TABLE.iloc[round((log.time[0] - 3.0) / 0.01) :][: len(log.record.fast)]
    assert len(same) > 1140
    np.testing.assert_array_equal(log.record.fast[:, FAST.gyro], same["yaw_rate_radps"])
    np.testing.assert_allclose(log.record.fast[:, FAST.wheel_left], same["speed_x_mps"], atol=3e-4)
    np.testing.assert_allclose(log.record.fast[1:, FAST.steer], same["steer_rad"][:-1], atol=2e-5)
    assert "Interpolated in the rows of yaw_rate" in remarks[0]


def test_what_is_not_valid_is_unknown_and_text_is_ignored(tmp_path: Path) -> None:
    bad = np.arange(len(ROWS)) % 7 == 0
    course = signal("course_deg", TIME[ROWS], np.where(bad, 99.0, COURSE), invalidation_bits=bad)
    text = signal("gps_speed_mps", TIME[:2], np.array([b"a", b"b"]), encoding="utf-8")
    (log,), _ = read_parts(written(tmp_path, fast(), [course], [text]))
    captured = log.record.select_packets("gps")[:, PACKET.captured] - 300
    np.testing.assert_array_equal(captured, ROWS[~bad])


def test_channels_of_one_name_are_told_apart(tmp_path: Path) -> None:
    path = written(tmp_path, fast(), gps(), gps(0.05))
    with pytest.raises(ValueError, match=r"--map one of course_deg \(group 1\), .* \(group 2\)"):
        read_log(path)
    log = read_log(path, {"course_deg": "course_deg (group 2)"})
    captured = log.record.select_packets("gps")[:, PACKET.captured] - 300
    np.testing.assert_array_equal(captured, ROWS + 5)


def test_a_missing_channel_is_told_with_those_there_are(tmp_path: Path) -> None:
    path = written(tmp_path, [*fast("steer_rad"), signal("Delta", TIME, TABLE["steer_rad"])])
    with pytest.raises(ValueError, match=r"no column steer_rad; the log has .*Delta"):
        read_log(path)
    read, csv = read_log(path, {"steer_rad": "Delta"}), read_log(saved(TABLE, tmp_path))
    np.testing.assert_array_equal(read.record.fast, csv.record.fast)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_damaged_file_and_a_missing_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "drive.mf4"
    path.write_bytes(b"MDF     4.10" + bytes(200))
    with pytest.raises(ValueError, match=r"drive\.mf4: expected CSV, .* or VBO, but"):
        read_log(path)
    gc.collect()  # asammdf's own `__del__` fails where it could not open the file
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sideslip\[mdf\]'"):
        read_log(path)
