"""What a picture shows of a car now, read from the packed numbers of its episode."""

import math
from typing import NamedTuple

import numpy as np

from ..backend.arrays import read
from ..backend.decorators import plain
from ..backend.primitives import ARRAYS
from ..engine.layout import P, Z
from ..engine.packing import EpisodeConfig
from ..engine.step import fixed_of, kind_of
from ..engine.tick import Fixed, changed, standing_load
from ..record import Array
from ..scenarios.roads import NOMINAL_PATH, laid_by
from ..scenarios.tracks import Path, Section, path_of, path_offset, sections
from ..scenarios.wind import wind_at
from ..sensors.camera import lane_in_view
from ..vehicle.actuators import torque_limit
from ..vehicle.dynamics import Motion, curvature_at, gravity_at
from ..vehicle.tyres import LINEAR, lateral_forces, tyres_at
from ..vehicle.vehicle import Vehicle
from .trace import Shot

_fixed_of, _kind_of, _standing_load = plain(fixed_of), plain(kind_of), plain(standing_load)
_tyres_at, _lateral_forces, _changed = plain(tyres_at), plain(lateral_forces), plain(changed)
_gravity_at, _torque_limit, _wind_at = plain(gravity_at), plain(torque_limit), plain(wind_at)
_lane_in_view, _laid_by = plain(lane_in_view), plain(laid_by)
_curvature_at, _path_offset = plain(curvature_at, ARRAYS), plain(path_offset, ARRAYS)

AHEAD = 45  # m of the road that are drawn
USUAL_VIEW = 0.35  # rad to either side, drawn where the scenario's camera sees at any heading


class Wheel(NamedTuple):
    """A wheel in car axes, x ahead and y to the left of the centre of gravity."""

    x: float  # m
    y: float
    angle: float  # rad, steered
    F_x: float  # N, in the wheel's own axes, of the road on the tyre
    F_y: float
    capacity: float  # N in all directions; 0: without a limit


class Sight(NamedTuple):
    """The camera's picture."""

    ahead: float  # m, its preview distance
    half_angle: float  # rad
    sees: bool  # a lane is in view


class Scene(NamedTuple):
    """A car at an instant."""

    motion: Motion
    vehicle: Vehicle
    steer: float  # rad, front wheels
    torques: tuple[float, float]  # N m, left and right motor
    most: float  # N m, of one motor
    wheels: tuple[Wheel, ...]  # front left and right, rear left and right
    friction: float  # of the road, the mean of both sides
    wind: float  # N, to the left
    sight: Sight | None  # None without a camera
    lanes: tuple[Section, ...]  # between cones
    path: Array  # the driver's, rows (s, y) in m; (0, 2) where it is the road's centre line
    bends: Array  # 1/m, the road's curvature at each of the next AHEAD metres
    half_width: float  # m
    failure: int


def scene_of(shot: Shot) -> Scene:
    """The Scene of a Shot."""
    p, z, switches, _, config, _, ours, _ = shot
    fixed, kind = _fixed_of(p), _kind_of(p, switches)
    motion, drive, tick = read(z, Z.motion), read(z, Z.drive), float(z[Z.clock.tick])
    car = _changed(fixed.car, fixed.change, tick >= fixed.change.tick)
    load = _standing_load(drive, car, kind)
    _, g_y = _gravity_at(motion, fixed.road, kind.small_angle)
    a, b, c, d, F_x, N_z = _tyres_at(motion, load, car, g_y, kind.small_angle, kind.law, kind.roll)
    tyres = a, b, c, d
    across = _lateral_forces(*tyres, kind.law, kind.small_angle)
    turn = N_z / car.d_r
    along = 0.0, 0.0, 0.5 * F_x - turn, 0.5 * F_x + turn
    places = [(car.l_f, 0.5 * car.d_f, drive.delta_f), (car.l_f, -0.5 * car.d_f, drive.delta_f)]
    places += [(-car.l_r, 0.5 * car.d_r, 0.0), (-car.l_r, -0.5 * car.d_r, 0.0)]
    wheels = []
    for place, F_wx, F_wy, tyre in zip(places, along, across, tyres, strict=True):
        # a tyre's limit is what its drive force leaves of the friction circle
        capacity = 0.0 if kind.law == LINEAR else math.hypot(tyre.limit, F_wx)
        x, y, angle = place
        known = (F_wx, F_wy, capacity) if ours else (0.0, 0.0, 0.0)
        wheels.append(Wheel(x, y, angle, *known))
    lanes = _lanes_of(fixed.path, config)
    return Scene(
        motion,
        config.vehicle,
        float(drive.delta_f),
        (float(drive.T_l), float(drive.T_r)),
        float(_torque_limit(motion.v_x, car)),
        tuple(wheels),
        0.5 * float(car.mu + car.mu_r),
        float(_wind_at(tick, fixed.wind)[0]),
        _sight_of(p, motion) if "camera" in config.slow else None,
        lanes,
        _path_near(fixed.path, motion.s) if lanes else np.empty((0, 2)),
        _bends_ahead(fixed, z, motion, kind.road),
        float(fixed.task.half_width),
        int(z[Z.clock.failure]),
    )


def _sight_of(p: Array, motion: Motion) -> Sight:
    view = read(p, P.sight)
    angle = float(view.heading) if math.isfinite(view.heading) else USUAL_VIEW
    return Sight(float(p[P.car.l_pre]), angle, bool(_lane_in_view(motion, view)))


def _lanes_of(path: Path, config: EpisodeConfig) -> tuple[Section, ...]:
    """The lanes between the cones of the episode's track, as its seed laid them."""
    track, width = config.scenario.path, config.vehicle.width
    standard = path_of(track, width)
    if config.scenario.steering != "driver" or standard.shift_1 == 0.0:
        return ()
    scale = float(path.length_1 / standard.length_1)
    start = float(path.start_1 - scale * standard.start_1)
    return sections(track, width, start, scale, math.copysign(1.0, path.shift_1))


def _path_near(path: Path, s: float) -> Array:
    at = np.arange(s - AHEAD, s + AHEAD, 0.5)
    return np.stack([at, _path_offset(path, at)], 1)


def _bends_ahead(fixed: Fixed, z: Array, motion: Motion, road: int) -> Array:
    """The scenario's; a road that is laid tick by tick is taken to go on turning as it does now."""
    now = 0.0
    if road == NOMINAL_PATH:
        turn, _ = _laid_by(read(z, Z.lead), float(z[Z.driver]), motion.v_x, fixed.leader)
        now = turn / max(motion.v_x, 1.0)
    bends: Array = now + _curvature_at(fixed.road, motion.s + np.arange(float(AHEAD)))
    return bends
