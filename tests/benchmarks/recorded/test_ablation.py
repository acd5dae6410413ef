"""What each part of a filter saves on a log: the options that take it away reach the filter."""

import dataclasses

import numpy as np
import pytest

from sideslip.benchmarks.recorded.ablation import WITHOUT, ablation
from sideslip.benchmarks.recorded.suite import CORNERS
from sideslip.envs.record import Log
from sideslip.envs.recordings.log_file import read_log
from sideslip.envs.vehicle.vehicle import PASSENGER_CAR
from tests.benchmarks.recorded.slalom import SPEED, columns, saved


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """The slalom with what an accelerometer would measure, and a loose contact."""
    table = columns()
    slip, yaw = table["sideslip_rad"], table["yaw_rate_radps"]
    table["steer_rad"] = table["steer_rad"].copy()
    table["steer_rad"][500] = 0.14
    felt = SPEED * (np.gradient(slip, 0.01) + yaw)
    steer = table["steer_rad"]
    return read_log(saved(tmp_path_factory.mktemp("drive"), accel_y_mps2=felt, steer_rad=steer))


def test_every_part_has_its_error_for_every_corner(log: Log) -> None:
    suite = ablation(log, PASSENGER_CAR, seeds=1)
    rmse = {(row.estimator, row.scenario): row.value for row in suite.rows}
    assert len(rmse) == len(WITHOUT) * (1 + len(CORNERS)) == 40
    nominal = f"{log.name}: passenger-car, front x 1.0, rear x 1.0"
    soft = f"{log.name}: passenger-car, front x 0.7, rear x 1.3"
    of = {label: rmse[f"joint-robust, {label}", nominal] for label in WITHOUT}
    assert len({f"{error:.6g}" for error in of.values()}) == len(WITHOUT)
    assert of["without biases"] > 1.5 * of["complete"]  # the gyro is off by 0.2 deg/s
    wrong = rmse["joint-robust, without stiffness", soft]
    assert wrong > 1.2 * rmse["joint-robust, complete", soft]


def test_a_log_without_truth_is_refused(log: Log) -> None:
    with pytest.raises(ValueError, match="parts are scored against sideslip truth"):
        ablation(dataclasses.replace(log, truth={}), PASSENGER_CAR)
