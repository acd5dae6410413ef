"""The power that tyres dissipate by sliding sideways."""

from typing import Any

import numpy as np

from ...envs.backend.arrays import read
from ...envs.backend.decorators import jit
from ...envs.backend.elementary import sincos
from ...envs.engine.layout import P, Z
from ...envs.engine.step import make_step_variant
from ...envs.engine.tick import apply_tyre_change, compute_static_load
from ...envs.record import Array
from ...envs.vehicle.dynamics import compute_gravity
from ...envs.vehicle.tyres import compute_tyre_forces


def compute_dissipation(params: Array, states: Array, switches: Any) -> Array:
    """Compute the power that N cars' tyres dissipate (W), shape (N,).

    It is the lateral force times the speed across the wheel, at both axles. Drive slip is not
    modelled.

    Args:
        params: Packed parameters of the engine, one row for each car.
        states: Packed states of the engine, likewise.
        switches: Packed switches of the engine, likewise.

    Returns:
        Power of each car.
    """
    out = np.empty(len(params))
    _write(params, states, switches, out)
    return out


@jit
def _write(params: Any, states: Any, switches: Any, out: Any) -> None:
    for i in range(len(params)):
        p, z = params[i], states[i]
        motion, drive, change = read(z, Z.motion), read(z, Z.drive), read(p, P.tyre_change)
        kind = make_step_variant(p, switches[i])
        car = apply_tyre_change(read(p, P.car), change, z[Z.clock.tick] >= change.tick)
        _, g_y = compute_gravity(motion, read(p, P.road), kind.small_angle)
        load = compute_static_load(drive, car, kind)
        F_yf, F_yr, _, _ = compute_tyre_forces(
            motion, load, car, g_y, kind.small_angle, kind.law, kind.roll
        )
        sin_d, cos_d = sincos(drive.delta_f)
        front = (motion.v_y + car.l_f * motion.gamma) * cos_d - motion.v_x * sin_d
        out[i] = -F_yf * front - F_yr * (motion.v_y - car.l_r * motion.gamma)
