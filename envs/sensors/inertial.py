"""The fast sensors: gyro, accelerometers, roll rate, wheel speeds, applied inputs."""

from typing import Any, NamedTuple

from ..backend.decorators import inlined


class Chance(NamedTuple):
    """The random numbers of a tick, four standard normal ones each."""

    inertial: Any
    wheels: Any


@inlined
def fast_row(motion: Any, accel: Any, acted: Any, d_f: Any, noise: Any, chance: Any) -> Any:
    """The fast sensors at a tick, columns as in `Fast`.

    accel: (a_x, a_y) specific forces. acted: what acted, in the order of `Fast` from `steer` on.
    """
    n, wheels = chance.inertial, chance.wheels
    half = 0.5 * d_f * motion.gamma
    return (
        motion.gamma + noise.gyro_bias + noise.gyro * n[0],
        accel[1] + noise.accel_y_bias + noise.accel * n[1],
        accel[0] + noise.accel * n[2],
        motion.phi_dot + noise.roll_rate * n[3],
        motion.v_x - half + noise.wheel * wheels[0],
        motion.v_x + half + noise.wheel * wheels[1],
        acted[0],
        acted[1],
        acted[2],
        acted[3],
        acted[4],
    )
