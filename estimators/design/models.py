"""Which states a filter has, what drives them and what its sensors measure.

A bicycle's states stand in the order of `_ORDER`, as many of them as its sensors need. The first
states of a model follow its physics ("dense"), the disturbances behind them decay by themselves.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core.model import FORCES, KINEMATIC, ROLL, VELOCITY_ROLL, YAW

COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted


class MeasurementRow(NamedTuple):
    """One value of a packet as a measurement: a sum of states."""

    states: tuple[str, ...]
    noise: str  # its standard deviation is the option `<noise>_noise`
    sd: float  # default of that option, in the unit of the value
    angle: bool = False  # the innovation is wrapped
    over_speed: bool = False  # the default, of `COURSE_SPEED`, grows as 1/V; an option is unscaled
    ground: bool = False  # a direction over the ground, where psi is relative to the road


@dataclass(frozen=True)
class Measurement:
    """A slow sensor as a filter sees it."""

    rows: tuple[MeasurementRow, ...]  # sums of a bicycle's states, for the packet's first values
    velocities: tuple[MeasurementRow, ...] = ()  # rows of a second layer, in their place
    heading_fix: bool = False  # its first sample, where it is far off, sets psi


MEASUREMENTS: dict[str, Measurement] = {
    "camera": Measurement(
        (MeasurementRow(("psi",), "psi", 3.5e-3, angle=True), MeasurementRow(("y_l",), "y_l", 0.02))
    ),
    "gps": Measurement(
        (MeasurementRow(("beta", "psi"), "course", math.radians(0.14), True, True, ground=True),),
        (
            MeasurementRow(("v_x",), "gps_speed", 0.05),
            MeasurementRow(("v_y",), "gps_speed", 0.05),
        ),  # double-layer-gps (41)
        heading_fix=True,
    ),
}
"""What each slow sensor measures, by its name."""


class StateInfo(NamedTuple):
    """A state of a model; numbers are in its unit."""

    unit: str
    prior: float  # usual standard deviation at the start
    bound: float  # largest magnitude of an estimate in an observation


TYRES = ("front_tyres", "rear_tyres", "inverse_friction")
STATES = {
    "beta": StateInfo("rad", 0.02, np.pi / 2.0),
    "gamma": StateInfo("rad/s", 0.05, 10.0),
    "psi": StateInfo("rad", 0.05, np.pi),
    "y_l": StateInfo("m", 0.3, 200.0),
    "psi_late": StateInfo("rad", 0.05, np.pi),
    "y_l_late": StateInfo("m", 0.3, 200.0),
    **dict.fromkeys(("v_x", "v_y"), StateInfo("m/s", 0.1, 100.0)),
    "phi": StateInfo("rad", 0.02, np.pi / 2.0),
    "phi_rate": StateInfo("rad/s", 0.05, 10.0),
    **dict.fromkeys(("F_yf", "F_yr"), StateInfo("N", 500.0, 1e5)),
    "d1": StateInfo("rad/s", 0.1, 100.0),
    "d2": StateInfo("rad/s2", 1.0, 1000.0),
    "d3": StateInfo("rad/s", 0.1, 100.0),
    "d": StateInfo("rad/s2", 1.0, 1000.0),
    "F_d": StateInfo("N", 0.0, 1e5),
    "N_d": StateInfo("N m", 100.0, 1e5),
    "bias": StateInfo("rad/s", 0.0, 10.0),
    "accel_bias": StateInfo("m/s2", 0.0, 50.0),
    "accel_scale": StateInfo("-", 0.0, 1.0),
    **dict.fromkeys(("bank", "camera_yaw", "map_heading"), StateInfo("rad", 0.0, 1.0)),
    "steer_offset": StateInfo("rad", 0.0, 1.0),
    **dict.fromkeys(TYRES, StateInfo("-", 0.0, 5.0)),
}
"""All states of all models, by name."""
FOREIGN_STATE = StateInfo("-", 0.0, 1e6)
"""A state that `STATES` lacks, which only a user's estimator has."""


@dataclass(frozen=True)
class FilterModel:
    """States by name, what drives them and what is measured."""

    kind: int  # code of `core.model`
    states: tuple[str, ...]  # those that follow the model
    inputs: tuple[str, ...] = ("steer", "N_z")  # columns of a fast row, or sums of two
    fast: tuple[str, ...] = ("gyro",)  # likewise, measured in every row
    disturbances: tuple[tuple[str, str], ...] = ()  # states behind them, and what each one pushes
    forces: bool = False  # disturbances are an Ornstein-Uhlenbeck force and moment instead
    late: tuple[str, ...] = ()  # states that lag behind the camera's (tie-vision (12))
    biases: tuple[str, ...] = ()  # last states, names of `BIASES`

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        pushes = ("F_d", "N_d") if self.forces else tuple(name for name, _ in self.disturbances)
        return self.states + self.late + pushes + self.biases


_ORDER = ("beta", "gamma", "psi", "y_l")
INERTIAL = ("gyro", "accel_y", "roll_rate")  # the fast sensors of a bicycle, in their order
WANDER = {
    **{"bias": "gyro", "accel_bias": "accel_y", "bank": "", "camera_yaw": "camera"},
    **{"map_heading": "camera", "steer_offset": ""},
}
SCALE = "accel_scale"
BIASES = WANDER | {SCALE: "accel_y"} | dict.fromkeys(TYRES, "")
"""States that nothing drives but noise, and the sensor that each needs, if any. Option `bias_sds`
says what they are. The tyres' count too: factors of stiffness, and the reciprocal of friction."""
NONLINEAR = (*TYRES, SCALE)

MODELS: dict[str, FilterModel] = {
    "roll": FilterModel(ROLL, ("phi", "phi_rate"), ("accel_y",), ("roll_rate",)),
    "kinematic": FilterModel(KINEMATIC, ("v_x", "v_y"), ("accel_x", "accel_y"), ("wheel",)),
    "velocity-roll": FilterModel(
        VELOCITY_ROLL,
        ("v_x", "v_y", "phi", "phi_rate"),
        ("accel_x", "accel_y"),
        ("roll_rate",),
        (("d", "phi_rate"),),
    ),
    "yaw-moment": FilterModel(YAW, ("gamma",), ("N_z",), ("gyro",), (("N_d", "gamma"),)),
    "tyre-forces": FilterModel(
        FORCES, ("gamma",), ("N_z",), ("gyro", "accel_y"), (("F_yf", "gamma"), ("F_yr", "gamma"))
    ),
}
"""Models other than the bicycle's, by name."""

LATE = {"psi": "psi_late", "y_l": "y_l_late"}


def select_states(sensors: tuple[str, ...]) -> tuple[str, ...]:
    """Select the fewest of a bicycle's states that slow sensors measure: the first of `_ORDER`.

    Args:
        sensors: Names of the slow sensors.
    """
    rows = [row for sensor in sensors for row in MEASUREMENTS[sensor].rows]
    return _ORDER[: max([2, *(1 + _ORDER.index(state) for row in rows for state in row.states)])]
