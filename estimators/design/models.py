"""Which states a filter has, what drives them and what its sensors measure.

States stand in the order of `ORDER`, as many of them as the model has. The first ones follow the
physical model ("dense"), the disturbances behind them decay by themselves.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST
from ...envs.sensors.slow import CAMERA, GPS, SLOW_NAMES
from ...envs.vehicle.linear import roll
from ...envs.vehicle.vehicle import Vehicle
from ..core.transition import FORCES, KINEMATIC, LATERAL, ROLL, VELOCITY_ROLL, YAW

Array = npt.NDArray[np.float64]

SMOOTHING_TIME = 0.2  # s, of the measured speed
COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted

UNITS = {
    "beta": "rad",
    "gamma": "rad/s",
    "psi": "rad",
    "y_l": "m",
    "psi_late": "rad",
    "y_l_late": "m",
    "v_x": "m/s",
    "v_y": "m/s",
    "phi": "rad",
    "phi_rate": "rad/s",
    "F_yf": "N",
    "F_yr": "N",
    "d1": "rad/s",
    "d2": "rad/s2",
    "d3": "rad/s",
    "d": "rad/s2",
    "F_d": "N",
    "N_d": "N m",
}


@dataclass(frozen=True)
class Model:
    """States by name, what drives them and what is measured.

    kind: of `transition`. states: those that follow the model. disturbances: name of each state
    behind them and the state that it pushes, or, for "forces", an Ornstein-Uhlenbeck force and
    moment. late: the states that lag behind the camera's (tie-vision (12)). inputs, fast: names of
    `SIGNALS`.
    """

    kind: int
    states: tuple[str, ...]
    inputs: tuple[str, ...] = ("steer", "N_z")
    fast: tuple[str, ...] = ("gyro",)
    disturbances: tuple[tuple[str, str], ...] = ()
    forces: bool = False
    late: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        behind = ("F_d", "N_d") if self.forces else tuple(name for name, _ in self.disturbances)
        return self.states + self.late + behind


ORDER = ("beta", "gamma", "psi", "y_l")
WALK = (("d1", "beta"), ("d2", "gamma"))  # dakf-stability (8)-(9), (14)
WALK_ALL = (*WALK, ("d3", "psi"))  # dual-rate (4): one for every state of (37)

MODELS: dict[str, Model] = {
    "roll": Model(ROLL, ("phi", "phi_rate"), ("accel_y",), ("roll_rate",)),
    "kinematic": Model(KINEMATIC, ("v_x", "v_y"), ("accel_x", "accel_y"), ("wheel",)),
    "velocity-roll": Model(
        VELOCITY_ROLL,
        ("v_x", "v_y", "phi", "phi_rate"),
        ("accel_x", "accel_y"),
        ("roll_rate",),
        (("d", "phi_rate"),),
    ),
    "yaw-moment": Model(YAW, ("gamma",), ("N_z",), ("gyro",), (("N_d", "gamma"),)),
    "tyre-forces": Model(
        FORCES, ("gamma",), ("N_z",), ("gyro", "accel_y"), (("F_yf", "gamma"), ("F_yr", "gamma"))
    ),
}
"""Models other than the bicycle's, by name."""

ROWS: dict[str, tuple[tuple[str, ...], ...]] = {
    "camera": (("psi",), ("y_l",)),
    "gps": (("beta", "psi"),),
}
"""What each slow sensor measures of a bicycle: sums of states, one a row."""

VELOCITY_ROWS = (("v_x",), ("v_y",))  # double-layer-gps (41)
_ANGLES = {"camera": (1, 0, 0, 0), "gps": (1, 0, 0, 0)}
_NEEDS = {"camera": ("psi", "y_l"), "gps": ("psi",)}
_LATE = {"psi": "psi_late", "y_l": "y_l_late"}

Signal = tuple[tuple[int, float], tuple[int, float]]


def signals(vehicle: Vehicle) -> dict[str, Signal]:
    """Sums of two columns of a fast row, as (column, factor), by name."""
    arm = vehicle.rear_track / (2.0 * vehicle.wheel_radius)  # N_z = arm (T_r - T_l)
    single = ("gyro", "accel_y", "accel_x", "roll_rate", "steer")
    table: dict[str, Signal] = {
        name: ((getattr(FAST, name), 1.0), (getattr(FAST, name), 0.0)) for name in single
    }
    table["N_z"] = ((FAST.torque_right, arm), (FAST.torque_left, -arm))
    table["wheel"] = ((FAST.wheel_left, 0.5), (FAST.wheel_right, 0.5))
    return table


def states_for(sensors: tuple[str, ...]) -> tuple[str, ...]:
    """The smallest set of a bicycle's states that the given slow sensors measure."""
    needed = {state for sensor in sensors for state in _NEEDS[sensor]}
    return ORDER[:2] + tuple(state for state in ORDER[2:] if state in needed)


def bicycle_model(
    sensors: tuple[str, ...], fast: tuple[str, ...], disturbances: str, late: bool
) -> Model:
    """The bicycle with what the given slow sensors need.

    disturbances: "none", "walk" (d_1, d_2), "walk-all" (every state's) or "forces".
    late: the camera measures states that lag (tie-vision (12)-(13)).
    """
    walks = {"walk": WALK, "walk-all": WALK_ALL}.get(disturbances, ())
    states = states_for(sensors)
    lagging = tuple(_LATE[s] for s in states if s in _LATE) if late and "camera" in sensors else ()
    walks = tuple((name, state) for name, state in walks if state in states)
    return Model(LATERAL, states, ("steer", "N_z"), fast, walks, disturbances == "forces", lagging)


def write_model(
    f: Any, model: Model, vehicle: Vehicle, step: float, noise: Mapping[str, float], Q: Array
) -> None:
    """Write everything about the model and its rows into a filter's record.

    step: s. noise: standard deviations "gyro", "accel_y", "roll_rate", "wheel", "psi", "y_l",
    "course" (at 60 km/h, growing as 1/V) or "course_fixed" (at any speed), and of disturbances
    "force", "moment", "time". Q: (n, n), process noise per second on top of them.
    """
    names, dense = model.names, len(model.states) + len(model.late)
    n = len(names)
    f.kind, f.n, f.total, f.dense, f.delayed = model.kind, n, n, dense, len(model.late)
    f.forces = int(model.forces)
    for j, (_, pushed) in enumerate(model.disturbances):
        f.pushed[j] = names.index(pushed)
    f.car[:] = [
        vehicle.mass,
        vehicle.yaw_inertia,
        vehicle.front_arm,
        vehicle.rear_arm,
        vehicle.front_stiffness,
        vehicle.rear_stiffness,
    ]
    body = roll(vehicle)
    f.roll[:] = [-body.A[1, 0], -body.A[1, 1], body.B[1, 0]]
    f.preview = vehicle.preview
    f.step = step
    f.Q[:n, :n] = Q * step
    f.decay[:] = 1.0
    if model.forces:  # exact discretisation of the process
        keep = math.exp(-step / noise["time"])
        f.decay[dense:n] = keep
        f.Q[dense, dense] += (1.0 - keep * keep) * noise["force"] ** 2
        f.Q[dense + 1, dense + 1] += (1.0 - keep * keep) * noise["moment"] ** 2
    f.speed_state = names.index("v_x") if "v_x" in names else -1
    _write_signals(f, model, vehicle, noise)
    _write_rows(f, model, noise)


def _write_signals(f: Any, model: Model, vehicle: Vehicle, noise: Mapping[str, float]) -> None:
    """Inputs and fast measurements; rows that depend on the speed are `transition.build`'s."""
    table, names = signals(vehicle), model.names
    f.inputs, f.fasts = len(model.inputs), len(model.fast)
    for i, name in enumerate(model.inputs):
        f.u_column[i], f.u_factor[i] = zip(*table[name], strict=True)
    state_of = {"gyro": "gamma", "roll_rate": "phi_rate", "wheel": "v_x"}
    for i, name in enumerate(model.fast):
        f.y_column[i], f.y_factor[i] = zip(*table[name], strict=True)
        f.r_fast[i] = noise[name] ** 2
        if name in state_of:
            f.y_row[i, names.index(state_of[name])] = 1.0
    if model.kind == FORCES:  # m a_y = F_yf + F_yr
        f.y_row[1, 1] = f.y_row[1, 2] = 1.0 / vehicle.mass


def _write_rows(f: Any, model: Model, noise: Mapping[str, float]) -> None:
    names = model.names
    for s, sensor in enumerate(SLOW_NAMES):
        if f.period[s] == 0:
            continue
        velocity = model.kind == VELOCITY_ROLL
        rows = VELOCITY_ROWS if velocity else ROWS[sensor]
        f.rows[s] = len(rows)
        f.angle[s] = 0 if velocity else _ANGLES[sensor]
        for i, summed in enumerate(rows):
            for state in summed:
                late = _LATE.get(state)
                f.row[s, i, names.index(late if late in model.late else state)] = 1.0
    f.r[CAMERA, :2] = noise["psi"] ** 2, noise["y_l"] ** 2
    fixed = noise.get("course_fixed")
    f.r[GPS, 0] = 0.0 if fixed is None else fixed**2
    f.r_course = 0.0 if fixed is not None else (noise["course"] * COURSE_SPEED) ** 2
    if model.kind == VELOCITY_ROLL:  # layer 2 is told its noise with each packet
        f.r_course = 0.0
        f.r[GPS, :2] = noise["gps_speed"] ** 2
