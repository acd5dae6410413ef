"""What a CAN bus says it does not know is no measurement."""

from pathlib import Path
from typing import Any

import numpy as np

from sideslip.envs.record import FAST
from sideslip.envs.recordings.log_file import read_parts

from . import test_containers as bus


def test_a_value_that_is_not_available_is_no_measurement(tmp_path: Path) -> None:
    def lose(i: int, frame: Any) -> None:
        if frame.arbitration_id == 256 and 400 <= i < 410:
            frame.data[2:4] = b"\xff\x7f"

    path = bus.write_frames(tmp_path / "drive.log", lose)
    dbc = bus.write_dbc(tmp_path, bus.DBC + 'VAL_ 256 YawRate 32767 "Signal_Not_Available" ;\n')
    (log,), remarks = read_parts(path, {**bus.COLUMNS, "dbc": str(dbc)})
    assert np.abs(log.record.fast[:, FAST.gyro]).max() < 3.9
    assert any("not available are left out" in text for text in remarks)
