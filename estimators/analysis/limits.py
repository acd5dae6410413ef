"""What no estimator can do better: the least error, and which constant errors cannot be seen.

The least error is the covariance of the optimal filter of the true model. It is defined where the
plant is linear (small angles, linear tyres, speed held) and the filter knows vehicle, noise and the
disturbances' statistics; deterministic wind and biases do not change it.

A direction v of the states is unobservable where C F^k v = 0 for all k: no filter parts its states
but by their priors. The scale of the wheels' radii is no state of a filter, which takes its speed
as it is. Here it is one, of exact-kf's discrete model, linearised in a steady turn.
"""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...envs.record import Array, Record
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import COMS, Vehicle
from ..core.filter import reset_filters
from ..design.assemble import assemble
from ..design.config import parse_config
from ..design.gains import transition_matrix
from ..design.models import select_states
from ..filters import FILTERS
from ..make import make_estimator

WHEELS, GPS_SPEED = "wheel_scale", "gps speed"
UNKNOWNS = {
    "bias": 0.01,  # rad/s
    "accel_bias": 0.2,  # m/s2
    "camera_yaw": 0.005,  # rad
    "steer_offset": 0.002,  # rad
    "bank": 0.02,  # rad
    WHEELS: 0.01,
}
"""What is unknown, and its usual standard deviation, by which directions are scaled."""
_SLOW = ("camera",), ("gps",), ("camera", "gps"), ("camera", "gps", GPS_SPEED)
_FAST = ("gyro",), ("gyro", "accel_y")
_NEEDS = {"accel_bias": "accel_y", "camera_yaw": "camera"}
_ROAD = "road"  # rad, error of the road's direction, which is known at the start
_MOVING = ("beta", "gamma", "phi", "phi_rate")  # states that settle in a turn
_DRIVES = {"straight": 0.0, "steady turn": 0.1}  # rad, steering angle
_SPEED = 7.0  # m/s
_SPEED_STEP = 1e-4  # relative, of a difference by speed
_TOLERANCE = 1e-6  # of a singular value where the largest is about 1, what counts as zero


def compute_error_bound(
    vehicle: Vehicle,
    *,
    record: Record,
    sensors: Mapping[str, SlowSensor],
    speed: float,
    dt: float = TICK,
    **options: Any,
) -> Array:
    """Compute the optimal estimate of beta's standard deviation (rad) at every row, shape (K,).

    The lowest possible RMSE over a stretch of time is the root of the mean square of this. The
    start is known exactly, as it is in the environment.

    Args:
        vehicle: The true vehicle.
        record: Record with the captured and arrived ticks of the packets.
        sensors: All available slow sensors by name.
        speed: Held speed (m/s).
        dt: Tick (s).
        **options: Options of `exact-kf` for the true noise, disturbances and latencies.
    """
    prior = dict.fromkeys(select_states(tuple(sensors)), 0.0)
    options = {"slow": list(sensors), "prior": prior} | options
    exact = make_estimator(
        "exact-kf", vehicle=vehicle, sensors=sensors, dt=dt, speed=speed, **options
    )
    return exact.run(record).std[:, 0]


class _UnobservableSubspace(NamedTuple):
    """Initial states that no measurement shows."""

    names: tuple[str, ...]  # of the n states
    basis: Array  # (n, k), columns, in the states' units

    def is_observable(self, name: str) -> bool:
        """Return whether a state is the same in all that the sensors cannot tell apart."""
        return not np.abs(self.basis[self.names.index(name)]).any()


class _DiscreteModel(NamedTuple):
    names: tuple[str, ...]
    rows: Array  # (n + m, n + 3), [(F - I) / step, H / step; C, D]
    sd: Array  # (n,), by which the states are scaled
    is_ground: Array  # (m,), 1 for a direction over the ground


def _find_unobservable_subspace(
    sensors: tuple[str, ...], unknowns: tuple[str, ...], steer: float = 0.0
) -> _UnobservableSubspace:
    """Find the unobservable directions of exact-kf's model with unknown constants (Kalman)."""
    names, rows, sd, is_ground = _build_model(sensors, unknowns)
    n = len(names)
    A, C = rows[:n, :n], rows[n:, :n]
    if WHEELS in unknowns:
        turn = _settle_turn(names, rows, steer)
        slower, faster = (
            _build_model(sensors, unknowns, _SPEED * (1.0 + h)).rows @ turn
            for h in (-_SPEED_STEP, _SPEED_STEP)
        )
        slope = (slower - faster) / (2.0 * _SPEED_STEP)  # the car is slower than its wheels say
        A = np.pad(A, (0, 2))
        A[:n, n], A[n + 1, n] = slope[:n], -_SPEED * turn[-1]  # it follows less of the road
        C = np.column_stack([C, slope[n:], is_ground])
        if GPS_SPEED in sensors:
            C = np.vstack([C, np.eye(n + 2)[n]])
        names, sd = (*names, WHEELS, _ROAD), np.append(sd, [UNKNOWNS[WHEELS], 0.01])
    A, C = A * sd / sd[:, None], C * sd
    basis, size = _find_kernel(C / np.linalg.norm(C, axis=1, keepdims=True)), np.inf
    while 0 < basis.shape[1] < size:  # what leaves the directions found so far is seen later
        size = basis.shape[1]
        leaving = A @ basis - basis @ (basis.T @ A @ basis)
        basis = basis @ _find_kernel(leaving / np.linalg.norm(A))
    if _ROAD in names:
        basis = basis @ _find_kernel(basis[-1:])
    basis = np.where(np.abs(basis) > _TOLERANCE, basis, 0.0)
    return _UnobservableSubspace(names, sd[:, None] * basis)


def make_observability_table() -> list[dict[str, str]]:
    """Make the table of what is seen: one row for each set of sensors, straight on and turning.

    Returns:
        Rows: "sensors", "drive", and for each unknown "yes", "alone" (where nothing else is
        unknown), "no", or "" where the sensor with the error is missing.
    """
    lines = []
    for slow, fast, (drive, steer) in itertools.product(_SLOW, _FAST, _DRIVES.items()):
        sensors, line = fast + slow, dict.fromkeys(UNKNOWNS, "")
        unknowns = tuple(name for name in UNKNOWNS if _NEEDS.get(name, "gyro") in sensors)
        whole = _find_unobservable_subspace(sensors, unknowns, steer)
        for name in unknowns:
            single = _find_unobservable_subspace(sensors, (name,), steer)
            is_alone = "alone" if single.is_observable(name) else "no"
            line[name] = "yes" if whole.is_observable(name) else is_alone
        lines.append({"sensors": ", ".join(sensors), "drive": drive} | line)
    return lines


def _build_model(
    sensors: tuple[str, ...], unknowns: tuple[str, ...], speed: float = _SPEED
) -> _DiscreteModel:
    """Build exact-kf's model of `COMS` at a speed (m/s)."""
    slow = [name for name in sensors if name in SLOW_NAMES]
    fast = [name for name in sensors if name in ("gyro", "accel_y")]
    deviations = {f"{name}_sd": UNKNOWNS[name] for name in unknowns if name != WHEELS}
    options: dict[str, object] = {"slow": slow, "fast": fast, **deviations}
    clocks = {name: SlowSensor(0.1) for name in slow}
    config = parse_config("exact-kf", FILTERS["exact-kf"], clocks, options)
    layers, _ = assemble(config, COMS, TICK, speed)
    reset_filters(layers, 0)
    f, n, used = layers[0], len(config.states), [SLOW_NAMES.index(name) for name in slow]
    F, H = transition_matrix(f, f.G[: f.dense, :n]), np.zeros((n, 3))
    H[: f.dense] = f.H[: f.dense, :3]
    C = np.vstack([f.C_fast[: f.fasts, :n], *(f.C[s, : f.rows[s], :n] for s in used)])
    D = np.zeros((len(C), 3))
    D[: f.fasts] = f.D_fast[: f.fasts, :3]
    is_ground = np.concatenate([np.zeros(f.fasts), *(f.ground[s, : f.rows[s]] for s in used)])
    rows = np.block([[(F - np.eye(n)) / f.step, H / f.step], [C, D]])
    return _DiscreteModel(config.states, rows, np.sqrt(np.diag(f.prior)[:n]), is_ground)


def _find_kernel(M: Array) -> Array:
    """Find an orthonormal basis (n, k) of what M (m, n) maps to nothing."""
    _, values, turned = np.linalg.svd(M)
    return np.asarray(turned[(values > _TOLERANCE).sum() :].T)


def _settle_turn(names: tuple[str, ...], rows: Array, steer: float) -> Array:
    """Settle states and inputs (n + 3,) of a turn along a road of its curvature."""
    n, moving = len(names), [i for i, name in enumerate(names) if name in _MOVING]
    turn = np.zeros(n + 3)
    turn[moving] = np.linalg.solve(rows[np.ix_(moving, moving)], -rows[moving, n] * steer)
    turn[names.index("psi")] = -turn[0]  # the course is the road's
    turn[n], turn[n + 2] = steer, turn[1] / _SPEED
    return turn
