"""What no estimator can do better: the least error, and which constant errors cannot be seen.

The least error is the covariance of the optimal filter of the true, linear model (small angles,
linear tyres, speed held), which knows vehicle, noise and the disturbances' statistics;
deterministic wind and biases do not change it. A direction v of the states is unobservable where
C F^k v = 0 for all k: no filter parts its states but by their priors.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...envs.numerics.functions import TICK
from ...envs.record import Array, Record
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.vehicle.parameters import COMS, Vehicle
from ..core.filter import reset_filters
from ..design.assemble import assemble
from ..design.config import parse_config
from ..design.gains import transition_matrix
from ..design.options import select_states
from ..filters import FILTERS
from ..make import make_estimator

UNKNOWNS = {
    "bias": 0.01,  # rad/s
    "accel_bias": 0.2,  # m/s2
    "camera_yaw": 0.005,  # rad
    "steer_offset": 0.002,  # rad
    "bank": 0.02,  # rad
}
"""What is unknown, and its usual standard deviation, by which directions are scaled."""
_SLOW = ("camera",), ("gps",), ("camera", "gps")
_FAST = ("gyro",), ("gyro", "accel_y")
_NEEDS = {"accel_bias": "accel_y", "camera_yaw": "camera"}
_SPEED = 7.0  # m/s
_TOLERANCE = 1e-6  # of a singular value where the largest is about 1, what counts as zero


def compute_error_bound(
    vehicle: Vehicle, *, record: Record, sensors: Mapping[str, SlowSensor], speed: float,
    dt: float = TICK, **options: Any,
) -> Array:  # fmt: skip
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
    kf = make_estimator("exact-kf", vehicle=vehicle, sensors=sensors, dt=dt, speed=speed, **options)
    return kf.run(record).std[:, 0]


def _find_unobservable_subspace(
    sensors: tuple[str, ...], unknowns: tuple[str, ...]
) -> tuple[tuple[str, ...], Array]:
    """Find names of the n states, and a basis (n, k) of what no measurement shows of them."""
    # of exact-kf's model of `COMS` with unknown constants, in the states' units
    slow = [name for name in sensors if name in SLOW_NAMES]
    fast = [name for name in sensors if name not in slow]
    options: dict[str, object] = {"slow": slow, "fast": fast}
    options |= {f"{name}_sd": UNKNOWNS[name] for name in unknowns}
    clocks = {name: SlowSensor(0.1) for name in slow}
    config = parse_config("exact-kf", FILTERS["exact-kf"], clocks, options)
    layers, _ = assemble(config, COMS, TICK, _SPEED)
    reset_filters(layers, 0)
    f, n, used = layers[0], len(config.states), [SLOW_NAMES.index(name) for name in slow]
    sd = np.sqrt(np.diag(f.prior)[:n])
    A = (transition_matrix(f, f.G[: f.dense, :n]) - np.eye(n)) / f.step * sd / sd[:, None]
    C = np.vstack([f.C_fast[: f.fasts, :n], *(f.C[s, : f.rows[s], :n] for s in used)]) * sd
    basis, size = _find_kernel(C / np.linalg.norm(C, axis=1, keepdims=True)), np.inf
    while 0 < basis.shape[1] < size:  # what leaves the directions found so far is seen later
        size = basis.shape[1]
        leaving = A @ basis - basis @ (basis.T @ A @ basis)
        basis = basis @ _find_kernel(leaving / np.linalg.norm(A))
    basis = np.where(np.abs(basis) > _TOLERANCE, basis, 0.0)
    return config.states, sd[:, None] * basis


def make_observability_table() -> list[dict[str, str]]:
    """Make the table of what is seen: one row for each set of sensors.

    Returns:
        Rows: "sensors", and for each unknown "yes", "alone" (where nothing else is unknown), "no",
        or "" where the sensor with the error is missing.
    """
    lines = []
    for slow, fast in itertools.product(_SLOW, _FAST):
        sensors, line = fast + slow, dict.fromkeys(UNKNOWNS, "")
        unknowns = tuple(name for name in UNKNOWNS if _NEEDS.get(name, "gyro") in sensors)
        names, basis = _find_unobservable_subspace(sensors, unknowns)
        for name in unknowns:  # seen where it is the same in all that cannot be told apart
            states, directions = _find_unobservable_subspace(sensors, (name,))
            is_alone = "no" if directions[states.index(name)].any() else "alone"
            line[name] = is_alone if basis[names.index(name)].any() else "yes"
        lines.append({"sensors": ", ".join(sensors)} | line)
    return lines


def _find_kernel(M: Array) -> Array:
    """Find an orthonormal basis (n, k) of what M (m, n) maps to nothing."""
    _, values, turned = np.linalg.svd(M)
    return np.asarray(turned[(values > _TOLERANCE).sum() :].T)
