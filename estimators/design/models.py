"""Which states a filter has, what drives them and what its sensors measure.

A new slow sensor is an entry of `MEASUREMENTS`: options, states and compiled code follow it.
States stand in the order of `_ORDER`, as many of them as the model has. The first ones follow the
physical model ("dense"), the disturbances behind them decay by themselves.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...envs.record import FAST, PACKET, Array
from ...envs.sensors.slow import SLOW, SLOW_NAMES
from ...envs.vehicle.linear import make_roll_model
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ..core.model import FORCES, KINEMATIC, LATERAL, ROLL, VELOCITY_ROLL, YAW
from ..core.record import CarIndex, FilterRecord

COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted


class MeasurementRow(NamedTuple):
    """One value of a packet as a measurement: a sum of states.

    Attributes:
        states: Names of the states.
        noise: Its standard deviation is the option `<noise>_noise`.
        sd: That option's default, in the unit of the value.
        angle: Whether the innovation is wrapped.
        over_speed: Whether the default holds at `COURSE_SPEED` and grows as 1/V; the option holds
            at every speed.
        ground: Whether it is a direction over the ground, where psi is relative to the road.
    """

    states: tuple[str, ...]
    noise: str
    sd: float
    angle: bool = False
    over_speed: bool = False
    ground: bool = False


@dataclass(frozen=True)
class Measurement:
    """A slow sensor as a filter sees it.

    Attributes:
        rows: Sums of a bicycle's states, for the packet's first values.
        velocities: Rows of a second layer, in their place.
        heading_fix: Whether its first sample, where it is far off, sets psi.
    """

    rows: tuple[MeasurementRow, ...]
    velocities: tuple[MeasurementRow, ...] = ()
    heading_fix: bool = False


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


def find_packet_column(sensor: str, value: str) -> int:
    """Find the column of a sensor's packets that holds a value.

    Args:
        sensor: Name of the slow sensor.
        value: Name of the value.

    Returns:
        Index of the column; 0 where the sensor sends none of that name.
    """
    names = [field.name for field in SLOW[SLOW_NAMES.index(sensor)].values]
    return PACKET.value + names.index(value) if value in names else 0


class StateInfo(NamedTuple):
    """A state of a model; numbers are in its unit."""

    unit: str
    prior: float  # usual standard deviation at the start
    bound: float  # largest magnitude of an estimate in an observation


STATES = {
    "beta": StateInfo("rad", 0.02, np.pi / 2.0),
    "gamma": StateInfo("rad/s", 0.05, 10.0),
    "psi": StateInfo("rad", 0.05, np.pi),
    "y_l": StateInfo("m", 0.3, 200.0),
    "psi_late": StateInfo("rad", 0.05, np.pi),
    "y_l_late": StateInfo("m", 0.3, 200.0),
    "v_x": StateInfo("m/s", 0.1, 100.0),
    "v_y": StateInfo("m/s", 0.1, 100.0),
    "phi": StateInfo("rad", 0.02, np.pi / 2.0),
    "phi_rate": StateInfo("rad/s", 0.05, 10.0),
    "F_yf": StateInfo("N", 500.0, 1e5),
    "F_yr": StateInfo("N", 500.0, 1e5),
    "d1": StateInfo("rad/s", 0.1, 100.0),
    "d2": StateInfo("rad/s2", 1.0, 1000.0),
    "d3": StateInfo("rad/s", 0.1, 100.0),
    "d": StateInfo("rad/s2", 1.0, 1000.0),
    "F_d": StateInfo("N", 0.0, 1e5),
    "N_d": StateInfo("N m", 100.0, 1e5),
    "bias": StateInfo("rad/s", 0.0, 10.0),
    "accel_bias": StateInfo("m/s2", 0.0, 50.0),
    "accel_scale": StateInfo("-", 0.0, 1.0),
    "bank": StateInfo("rad", 0.0, 1.0),
    "front_tyres": StateInfo("-", 0.0, 5.0),
    "rear_tyres": StateInfo("-", 0.0, 5.0),
    "inverse_friction": StateInfo("-", 0.0, 5.0),
}
"""All states of all models, by name."""
FOREIGN_STATE = StateInfo("-", 0.0, 1e6)
"""A state that `STATES` lacks, which only a user's estimator has."""


@dataclass(frozen=True)
class FilterModel:
    """States by name, what drives them and what is measured.

    Attributes:
        kind: Code of `core.model`.
        states: Names of the states that follow the model.
        inputs: Names of `make_signals`.
        fast: Names of `make_signals` that are measured in every row.
        disturbances: Name of each state behind them and of the state that it pushes.
        forces: Whether the disturbances are an Ornstein-Uhlenbeck force and moment instead.
        late: States that lag behind the camera's (tie-vision (12)).
        biases: Last states, names of `BIASES`.
    """

    kind: int
    states: tuple[str, ...]
    inputs: tuple[str, ...] = ("steer", "N_z")
    fast: tuple[str, ...] = ("gyro",)
    disturbances: tuple[tuple[str, str], ...] = ()
    forces: bool = False
    late: tuple[str, ...] = ()
    biases: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        pushes = ("F_d", "N_d") if self.forces else tuple(name for name, _ in self.disturbances)
        return self.states + self.late + pushes + self.biases


_ORDER = ("beta", "gamma", "psi", "y_l")
_BODY = ("phi", "phi_rate")  # of a bicycle whose accelerometer or roll rate is measured
INERTIAL = ("gyro", "accel_y", "roll_rate")  # the fast sensors of a bicycle, in their order
TYRES = ("front_tyres", "rear_tyres", "inverse_friction")
WANDER = {"bias": "gyro", "accel_bias": "accel_y", "bank": ""}
SCALE = "accel_scale"
BIASES = WANDER | {SCALE: "accel_y"} | dict.fromkeys(TYRES, "")
"""States that are constants: what a fast sensor measures on top, the road's bank, which no
accelerometer feels, the error of the accelerometer's scale, and the tyres: factors of stiffness,
and the reciprocal of friction."""
NONLINEAR = (*TYRES, SCALE)
_WALK = (("d1", "beta"), ("d2", "gamma"))  # dakf-stability (8)-(9), (14)
_WALK_ALL = (*_WALK, ("d3", "psi"))  # dual-rate (4): one for every state of dual-rate (37)
DISTURBANCES = ("none", "walk", "walk-all", "forces")

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

_EXPANSION_TIME = 0.004  # s between two expansions of the tyres' forces

_LATE = {"psi": "psi_late", "y_l": "y_l_late"}

Signal = tuple[tuple[int, float], tuple[int, float]]


def make_signals(vehicle: Vehicle) -> dict[str, Signal]:
    """Make the sums of two columns of a fast row.

    Args:
        vehicle: Vehicle with the wheels' radius and track.

    Returns:
        Two pairs (column, factor) by name.
    """
    arm = vehicle.rear_track / (2.0 * vehicle.wheel_radius)  # N_z = arm (T_r - T_l)
    single = ("gyro", "accel_y", "accel_x", "roll_rate", "steer", "curvature")
    table: dict[str, Signal] = {
        name: ((getattr(FAST, name), 1.0), (getattr(FAST, name), 0.0)) for name in single
    }
    table["N_z"] = ((FAST.torque_right, arm), (FAST.torque_left, -arm))
    table["wheel"] = ((FAST.wheel_left, 0.5), (FAST.wheel_right, 0.5))
    return table


def select_states(sensors: tuple[str, ...]) -> tuple[str, ...]:
    """Select the fewest of a bicycle's states that slow sensors measure: the first of `_ORDER`.

    Args:
        sensors: Names of the slow sensors.

    Returns:
        Names of the states.
    """
    rows = [row for sensor in sensors for row in MEASUREMENTS[sensor].rows]
    return _ORDER[: max([2, *(1 + _ORDER.index(state) for row in rows for state in row.states)])]


def make_bicycle_model(
    sensors: tuple[str, ...],
    fast: tuple[str, ...],
    disturbances: str,
    late: bool,
    body: bool = False,
    biases: tuple[str, ...] = (),
) -> FilterModel:
    """Make the bicycle model with the states that slow sensors need.

    Args:
        sensors: Names of the slow sensors.
        fast: Names of the fast sensors.
        disturbances: Name of `DISTURBANCES`; "walk" has d_1 and d_2, "walk-all" every state's.
        late: Whether the camera measures states that lag (tie-vision (12)-(13)).
        body: Whether it rolls.
        biases: Names of `BIASES`.

    Returns:
        The model.
    """
    states, walks = select_states(sensors), {"walk": _WALK, "walk-all": _WALK_ALL}
    lags = late and "camera" in sensors
    late_states = tuple(_LATE[state] for state in states if lags and state in _LATE)
    walking = tuple(pair for pair in walks.get(disturbances, ()) if pair[1] in states)
    inputs = ("steer", "N_z", "curvature") if "psi" in states else ("steer", "N_z")
    forces, states = disturbances == "forces", states + _BODY * body
    return FilterModel(LATERAL, states, inputs, fast, walking, forces, late_states, biases)


def write_model(
    f: FilterRecord,
    model: FilterModel,
    vehicle: Vehicle,
    step: float,
    noise: Mapping[str, float],
    noise_over_speed: Mapping[str, float],
    Q: Array,
) -> None:
    """Write the model and its measurements into a filter's memory.

    Args:
        f: Memory of the filter, written.
        model: States, inputs and measurements.
        vehicle: The filter's vehicle.
        step: Step of the filter (s).
        noise: `FilterConfig.noise`.
        noise_over_speed: `FilterConfig.noise_over_speed`.
        Q: Process noise per second on top of the forces', shape (n, n).
    """
    names, dense = model.names, len(model.states) + len(model.late)
    n = len(names)
    f.kind, f.n, f.total, f.dense, f.delayed = model.kind, n, n, dense, len(model.late)
    f.forces = int(model.forces)
    for j, (_, pushed) in enumerate(model.disturbances):
        f.pushed[j] = names.index(pushed)
    f.pushed[n - len(model.biases) - dense : n - dense] = -1
    f.banked = names.index("bank") - dense if "bank" in model.biases else -1
    f.rolling = names.index("phi") if model.kind == LATERAL and "phi" in names else 0
    f.car[:] = [getattr(vehicle, name) for name in CarIndex._fields]
    body = make_roll_model(vehicle)
    f.roll_stiffness, f.roll_damping, f.roll_arm = -body.A[1, 0], -body.A[1, 1], body.B[1, 0]
    f.sway = vehicle.roll_moment_arm / vehicle.mass
    f.preview = vehicle.preview
    f.step = step
    f.Q[:n, :n] = Q * step
    f.decay[:] = 1.0
    if model.forces:  # exact discretisation of the process
        decay = math.exp(-step / noise["time"])
        f.decay[dense : dense + 2] = decay
        f.Q[dense, dense] += (1.0 - decay * decay) * noise["force"] ** 2
        f.Q[dense + 1, dense + 1] += (1.0 - decay * decay) * noise["moment"] ** 2
        f.q_known[:], f.q_share = np.diag(f.Q)[dense : dense + 2], 1.0 - decay * decay
    f.speed_state = names.index("v_x") if "v_x" in names else -1
    _write_tyres(f, model, vehicle)
    _write_signals(f, model, vehicle, noise)
    _write_rows(f, model, noise, noise_over_speed)


def _write_tyres(f: FilterRecord, model: FilterModel, vehicle: Vehicle) -> None:
    """Write where the tyres' states stand and start: at the nominal ones."""
    names = model.names
    if TYRES[0] not in names:
        return
    f.tyres, f.grip = names.index(TYRES[0]), names.index(TYRES[2]) if TYRES[2] in names else 0
    f.again = max(1, round(_EXPANSION_TIME / f.step))
    f.stiffness[:] = 2.0 * vehicle.front_stiffness, 2.0 * vehicle.rear_stiffness
    wheelbase = vehicle.front_arm + vehicle.rear_arm
    arms = np.array([vehicle.rear_arm, vehicle.front_arm])
    f.load[:] = vehicle.mass * GRAVITY * arms / wheelbase
    f.first[f.tyres : f.tyres + 2] = 1.0
    f.q_tyres[:2] = np.diag(f.Q)[f.tyres : f.tyres + 2]
    if f.grip:
        f.q_tyres[2] = f.Q[f.grip, f.grip]
        f.first[f.grip] = 1.0 / vehicle.friction


def _write_signals(
    f: FilterRecord, model: FilterModel, vehicle: Vehicle, noise: Mapping[str, float]
) -> None:
    """Write inputs and fast measurements; `build_model` writes rows that depend on speed."""
    table, names = make_signals(vehicle), model.names
    f.inputs, f.fasts = len(model.inputs), len(model.fast)
    for i, name in enumerate(model.inputs):
        f.u_column[i], f.u_factor[i] = zip(*table[name], strict=True)
    measured_state = {"gyro": "gamma", "roll_rate": "phi_rate", "wheel": "v_x"}
    for i, name in enumerate(model.fast):
        f.y_column[i], f.y_factor[i] = zip(*table[name], strict=True)
        f.r_fast[i] = noise[name] ** 2
        if name in measured_state:
            f.C_fast[i, names.index(measured_state[name])] = 1.0
    f.scaled = names.index(SCALE) if SCALE in model.biases else 0
    for bias in filter(WANDER.get, model.biases):
        f.C_fast[model.fast.index(BIASES[bias]), names.index(bias)] = 1.0
    if model.kind == LATERAL and "accel_y" in model.fast:
        f.accel_row = model.fast.index("accel_y")
    if model.kind == FORCES:  # m a_y = F_yf + F_yr
        f.C_fast[1, 1] = f.C_fast[1, 2] = 1.0 / vehicle.mass


def _write_rows(
    f: FilterRecord,
    model: FilterModel,
    noise: Mapping[str, float],
    noise_over_speed: Mapping[str, float],
) -> None:
    """Write what the used slow sensors measure."""
    used = [s for s in range(len(SLOW_NAMES)) if f.period[s] > 0]
    f.first_slow = used[0] if used else -1
    for s in used:
        sensor = MEASUREMENTS[SLOW_NAMES[s]]
        is_second_layer = model.kind == VELOCITY_ROLL
        rows = sensor.velocities if is_second_layer else sensor.rows
        f.rows[s], f.heading_fix[s] = len(rows), sensor.heading_fix and not is_second_layer
        f.hdop_column[s] = find_packet_column(SLOW_NAMES[s], "hdop")
        f.satellites_column[s] = find_packet_column(SLOW_NAMES[s], "satellites")
        f.speed_column[s] = find_packet_column(SLOW_NAMES[s], "speed")
        for i, row in enumerate(rows):
            f.angle[s, i], f.ground[s, i] = row.angle, row.ground
            f.r[s, i] = noise[row.noise] ** 2
            f.noise_over_speed[s, i] = noise_over_speed.get(row.noise, 0.0) ** 2
            for state in row.states:
                late = _LATE.get(state)
                f.C[s, i, model.names.index(late if late in model.late else state)] = 1.0
        if is_second_layer:
            f.r_speed = f.r[s, 0]
