"""A recorded slalom whose truth is known exactly."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.envs.vehicle.parameters import PASSENGER_CAR

Array = npt.NDArray[np.float64]

SPEED, DT, ROWS = 20.0, 0.01, 1001
SLALOM = 0.02 * np.sin(2.0 * np.pi * 0.4 * DT * np.arange(ROWS))


def columns() -> dict[str, Array]:
    """A slalom of the linear passenger car: row k's steering acts from k to k+1."""
    G, H = make_bicycle_model(PASSENGER_CAR, SPEED).discretise(DT)
    x = np.zeros((ROWS, 2))
    for k in range(ROWS - 1):
        x[k + 1] = G @ x[k] + H[:, 0] * SLALOM[k]
    return {
        "time_s": 100.0 + DT * np.arange(ROWS), "speed_x_mps": np.full(ROWS, SPEED),
        "yaw_rate_radps": x[:, 1], "steer_rad": SLALOM, "sideslip_rad": x[:, 0],
    }  # fmt: skip


def saved(folder: Path, **changes: Array | None) -> Path:
    """The slalom as a CSV, with columns replaced, added, or (None) left out."""
    table = {name: c for name, c in (columns() | changes).items() if c is not None}
    pd.DataFrame(table).to_csv(folder / "slalom.csv", index=False)
    return folder / "slalom.csv"


VEHICLE = """\
name = "mine"
mass = 1500
yaw_inertia = 2400
front_arm = 1.2
rear_arm = 1.5
front_stiffness_axle = 110000.0
rear_stiffness_per_tyre = 60000.0
"""
