"""What a picture shows of a car now, read from the packed numbers of its episode."""

import math
from typing import NamedTuple

import numpy as np

from ..backend.arrays import read
from ..backend.decorators import as_python
from ..backend.primitives import ARRAYS
from ..engine.layout import P, Z
from ..engine.packing import EpisodeConfig
from ..engine.step import make_step_params, make_step_variant
from ..engine.tick import StepParams, apply_tyre_change, compute_static_load
from ..record import Array
from ..scenarios.roads import NOMINAL_PATH, step_nominal_car
from ..scenarios.tracks import Section, TrackPath, compute_path_offset, make_path, make_sections
from ..scenarios.wind import compute_wind
from ..sensors.camera import compute_lane_quality
from ..vehicle.actuators import compute_torque_limit
from ..vehicle.dynamics import Motion, compute_curvature, compute_gravity
from ..vehicle.tyres import LINEAR, compute_lateral_forces, compute_tyres
from ..vehicle.vehicle import Vehicle
from .trace import RenderState

_make_step_params, _make_step_variant, _compute_static_load = (
    as_python(make_step_params),
    as_python(make_step_variant),
    as_python(compute_static_load),
)
_compute_tyres, _compute_lateral_forces, _apply_tyre_change = (
    as_python(compute_tyres),
    as_python(compute_lateral_forces),
    as_python(apply_tyre_change),
)
_compute_gravity, _compute_torque_limit, _compute_wind = (
    as_python(compute_gravity),
    as_python(compute_torque_limit),
    as_python(compute_wind),
)
_compute_lane_quality, _step_nominal_car = (
    as_python(compute_lane_quality),
    as_python(step_nominal_car),
)
_compute_curvature, _compute_path_offset = (
    as_python(compute_curvature, ARRAYS),
    as_python(compute_path_offset, ARRAYS),
)

DRAWN_LENGTH = 45  # m of the road that are drawn
DEFAULT_HALF_ANGLE = (
    0.35  # rad to either side, drawn where the scenario's camera sees at any heading
)


class Wheel(NamedTuple):
    """A wheel in car axes, x ahead and y to the left of the centre of gravity."""

    x: float  # m
    y: float
    angle: float  # rad, steered
    F_x: float  # N, in the wheel's own axes, of the road on the tyre
    F_y: float
    capacity: float  # N in all directions; 0: without a limit


class CameraOverlay(NamedTuple):
    """The camera's field of view, drawn over the road."""

    preview: float  # m, its preview distance
    half_angle: float  # rad
    has_lane: bool  # a lane is in view


class CarScene(NamedTuple):
    """A car at an instant."""

    motion: Motion
    vehicle: Vehicle
    steer: float  # rad, front wheels
    torques: tuple[float, float]  # N m, left and right motor
    max_torque: float  # N m, of one motor
    wheels: tuple[Wheel, ...]  # front left and right, rear left and right
    friction: float  # of the road, the mean of both sides
    wind: float  # N, to the left
    field_of_view: CameraOverlay | None  # None without a camera
    lanes: tuple[Section, ...]  # between cones
    path: Array  # the driver's, rows (s, y) in m; (0, 2) where it is the road's centre line
    curvatures: Array  # 1/m, the road's curvature at each of the next DRAWN_LENGTH metres
    half_width: float  # m
    failure: int


def make_car_scene(shot: RenderState) -> CarScene:
    """Make the scene of a car from its packed numbers.

    Args:
        shot: State of the car.

    Returns:
        The scene.
    """
    p, z, switches, _, config, _, has_tyre_forces, _ = shot
    params, variant = _make_step_params(p), _make_step_variant(p, switches)
    motion, drive, tick = read(z, Z.motion), read(z, Z.drive), float(z[Z.clock.tick])
    car = _apply_tyre_change(params.car, params.tyre_change, tick >= params.tyre_change.tick)
    load = _compute_static_load(drive, car, variant)
    _, g_y = _compute_gravity(motion, params.road, variant.small_angle)
    a, b, c, d, F_x, N_z = _compute_tyres(
        motion, load, car, g_y, variant.small_angle, variant.law, variant.roll
    )
    tyres = a, b, c, d
    lateral = _compute_lateral_forces(*tyres, variant.law, variant.small_angle)
    turn = N_z / car.d_r
    longitudinal = 0.0, 0.0, 0.5 * F_x - turn, 0.5 * F_x + turn
    places = [(car.l_f, 0.5 * car.d_f, drive.delta_f), (car.l_f, -0.5 * car.d_f, drive.delta_f)]
    places += [(-car.l_r, 0.5 * car.d_r, 0.0), (-car.l_r, -0.5 * car.d_r, 0.0)]
    wheels = []
    for place, F_wx, F_wy, tyre in zip(places, longitudinal, lateral, tyres, strict=True):
        # a tyre's limit is what its drive force leaves of the friction circle
        capacity = 0.0 if variant.law == LINEAR else math.hypot(tyre.limit, F_wx)
        x, y, angle = place
        forces = (F_wx, F_wy, capacity) if has_tyre_forces else (0.0, 0.0, 0.0)
        wheels.append(Wheel(x, y, angle, *forces))
    lanes = _find_lanes(params.path, config)
    return CarScene(
        motion,
        config.vehicle,
        float(drive.delta_f),
        (float(drive.T_l), float(drive.T_r)),
        float(_compute_torque_limit(motion.v_x, car)),
        tuple(wheels),
        0.5 * float(car.mu + car.mu_r),
        float(_compute_wind(tick, params.wind)[0]),
        _make_camera_overlay(p, motion) if "camera" in config.slow else None,
        lanes,
        _sample_path(params.path, motion.s) if lanes else np.empty((0, 2)),
        _sample_curvatures(params, z, motion, variant.road),
        float(params.task.half_width),
        int(z[Z.clock.failure]),
    )


def _make_camera_overlay(p: Array, motion: Motion) -> CameraOverlay:
    view = read(p, P.field_of_view)
    angle = float(view.heading) if math.isfinite(view.heading) else DEFAULT_HALF_ANGLE
    return CameraOverlay(float(p[P.car.l_pre]), angle, bool(_compute_lane_quality(motion, view)))


def _find_lanes(path: TrackPath, config: EpisodeConfig) -> tuple[Section, ...]:
    """Find the lanes between the cones of the episode's track, as its seed placed them."""
    track, width = config.scenario.path, config.vehicle.width
    standard = make_path(track, width)
    if config.scenario.steering != "driver" or standard.shift_1 == 0.0:
        return ()
    scale = float(path.length_1 / standard.length_1)
    start = float(path.start_1 - scale * standard.start_1)
    return make_sections(track, width, start, scale, math.copysign(1.0, path.shift_1))


def _sample_path(path: TrackPath, s: float) -> Array:
    distances = np.arange(s - DRAWN_LENGTH, s + DRAWN_LENGTH, 0.5)
    return np.stack([distances, _compute_path_offset(path, distances)], 1)


def _sample_curvatures(params: StepParams, z: Array, motion: Motion, road: int) -> Array:
    """Sample the curvature ahead; a nominal path is assumed to keep its present turning rate."""
    nominal_curvature = 0.0
    if road == NOMINAL_PATH:
        turn_rate, _ = _step_nominal_car(
            read(z, Z.nominal_motion), float(z[Z.driver]), motion.v_x, params.nominal_car
        )
        nominal_curvature = turn_rate / max(motion.v_x, 1.0)
    curvatures: Array = nominal_curvature + _compute_curvature(
        params.road, motion.s + np.arange(float(DRAWN_LENGTH))
    )
    return curvatures
