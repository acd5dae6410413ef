"""Reset: draw an episode from a key and deliver tick 0; compiled."""

from typing import Any

from ..backend.arrays import fixed_tuple
from ..backend.decorators import apart, copied, jit, store
from ..backend.primitives import select
from ..backend.random import CHANNELS, normals
from ..record import CAMERA, FAST
from ..scenarios.draws import realise
from ..scenarios.driver import Driver, wanted_angle
from ..scenarios.steering import DRIVER, STEERING_WIDTH, steering_at, write_steering
from ..scenarios.tracks import Path, laid
from ..sensors.inertial import Chance, fast_row
from ..sensors.link import Link, clock_phase
from ..sensors.noise import Noise
from ..task.info import REPORT
from ..task.reference import Target, reference
from ..ticks import FOREVER, NEVER, whole_ticks
from ..vehicle.dynamics import Car, Motion, Road, gravity_at, sideslip_angle
from ..vehicle.vehicle import GRAVITY
from .layout import P, Z
from .observe import observe, write_report
from .packets import FAR, sense_slow

_CAR, _MOTION, _LINK, _TARGET = (len(each._fields) for each in (Car, Motion, Link, Target))
_ROAD, _DRIVER, _PATH, _NOISE = (len(each._fields) for each in (Road, Driver, Path, Noise))
_S = Motion._fields.index("s")


@jit
def _write_surroundings(p: Any, d: Any, s: Any, v_x: Any) -> None:
    """Friction, wind, the road and the path from what was drawn, for a car that starts at s, v_x.

    The path begins where the car is at the onset; a mirrored bend leans to the other side.
    """
    mirrored = d.side < 0.5
    right = select(d.friction_right > 0.0, d.friction_right, d.friction)
    p[P.car + 10] = select(mirrored, right, d.friction)
    p[P.car + 19] = select(mirrored, d.friction, right)
    p[P.wind] = select(d.wind_side < 0.5, -d.wind_force, d.wind_force)
    p[P.wind + 1] = d.wind_arm
    p[P.wind + 2] = whole_ticks(d.wind_start)
    p[P.wind + 3] = p[P.wind + 2] + whole_ticks(d.wind_length)
    p[P.road] = select(mirrored, 0.0 - d.curvature, d.curvature)
    p[P.road + 3] = select(mirrored, 0.0 - p[P.road + 3], p[P.road + 3])
    scaled = d.path_speed > 0.0
    scale = select(scaled, d.speed, 1.0) / select(scaled, d.path_speed, 1.0)
    path = Path(*fixed_tuple(p[P.path :], _PATH))
    store(p, P.path, laid(path, s + d.onset * v_x, scale, select(mirrored, -1.0, 1.0)))


@apart
def reset_vehicle(
    template: Any,
    low: Any,
    high: Any,
    switches: Any,
    start: Any,
    drawn: Any,
    key_low: int,
    key_high: int,
    bounds: Any,
    p: Any,
    z: Any,
    obs: Any,
    rows: Any,
    packets: Any,
    report: Any,
) -> None:
    """Draw the episode from a key and deliver tick 0.

    template: packed parameters with the vehicle and everything the scenario does not draw.
    start: a Motion whose NaN entries are the default (standing on the road at the drawn speed).
    """
    for i in range(P.end):
        p[i] = template[i]
    d, redraws = realise(low, high, key_low, key_high, Car(*fixed_tuple(p, _CAR)), drawn)
    p[P.car + 4] = p[P.car + 4] * d.front_stiffness
    p[P.car + 5] = p[P.car + 5] * d.rear_stiffness
    change = select(d.tyre_change_time > 0.0, whole_ticks(d.tyre_change_time), FOREVER)
    store(p, P.change, (change, d.front_change, d.rear_change))
    write_steering(switches[3], d, p[P.steering :])
    p[P.pace] = d.speed
    for i in range(Z.end):
        z[i] = 0.0
    z[Z.motion] = d.speed
    for i in range(_MOTION):
        if start[i] == start[i]:
            z[Z.motion + i] = start[i]
    _write_surroundings(p, d, z[Z.motion + _S], z[Z.motion])
    z[Z.sky] = p[P.sky + 1] * normals(key_low, key_high, 0, CHANNELS.sky)[1]
    n = normals(key_low, key_high, 0, CHANNELS.initial)
    road = Road(*fixed_tuple(p[P.road :], _ROAD))
    motion = Motion(*fixed_tuple(z[Z.motion :], _MOTION))
    target = Target(*fixed_tuple(p[P.target :], _TARGET))
    steer = steering_at(0.0, fixed_tuple(p[P.steering :], STEERING_WIDTH))
    if switches[3] == DRIVER:
        person = Driver(*fixed_tuple(p[P.driver :], _DRIVER))
        path = Path(*fixed_tuple(p[P.path :], _PATH))
        steer = wanted_angle(motion, path, road, target, person, p[P.task + 7])
    z[Z.drive + 2] = steer
    z[Z.driver] = steer
    z[Z.drive + 4] = p[P.disturbance] * n[0]
    z[Z.drive + 5] = p[P.disturbance + 1] * n[1]
    store(z, Z.clock, (key_low * 1.0, key_high * 1.0, 0.0, 0.0, redraws * 1.0, FAR))
    for sensor in range(2):
        at = Z.camera if sensor == CAMERA else Z.gps
        link = Link(*fixed_tuple(p[P.camera if sensor == CAMERA else P.gps :], _LINK))
        z[at + 1] = select(link.period > 0.0, clock_phase(link, key_low, key_high, sensor), NEVER)
        z[at + 2] = NEVER
    beta = sideslip_angle(motion.v_x, motion.v_y, switches[0])
    fast = normals(key_low, key_high, 0, CHANNELS.inertial)
    wheels = normals(key_low, key_high, 0, CHANNELS.wheels)
    acted = (steer, 0.0, 0.0, steer, 0.0)
    g_x, g_y = gravity_at(motion, road, switches[0])
    accel = (g_x, g_y + GRAVITY * motion.phi)
    noise = Noise(*fixed_tuple(p[P.noise :], _NOISE))
    store(rows[0], 0, fast_row(motion, accel, acted, p[P.car + 6], noise, Chance(fast, wheels)))
    count = sense_slow(p, z, motion, 0.0, switches[0], packets, 0)
    v = 0.5 * (rows[0, FAST.wheel_left] + rows[0, FAST.wheel_right])
    refs = reference(steer, v, target, switches[2])
    if switches[4]:  # every sample of the step is asked for: tick 0 stands for all of them
        for j in range(1, len(rows)):
            copied(rows[0], rows[j])
        observe(p, z, switches, rows, len(rows), count, packets, refs, bounds, obs)
    else:
        observe(p, z, switches, rows, 1, count, packets, refs, bounds, obs)
    write_report(report, z)
    report[REPORT.beta] = beta
    report[REPORT.beta_ref], report[REPORT.gamma_ref] = refs
    report[REPORT.steer] = steer
    report[REPORT.yaw_moment] = 0.0
    report[REPORT.cost] = 0.0
    report[REPORT.reward] = 0.0
    report[REPORT.packets] = count
    report[REPORT.ended] = 0.0
