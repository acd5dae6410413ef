"""The scene of a car and its road from above: lane or cones, trail, the camera's field of view.

The road's direction at the car is drawn to the right, its left is up.
"""

import math
from typing import NamedTuple

import numpy as np

from ..engine.layout import EpisodeConfig, P, Z
from ..engine.step import make_step_params, make_step_variant
from ..engine.tick import StepParams, apply_tyre_change
from ..numerics.jit import as_python
from ..numerics.packed import read
from ..numerics.primitives import ARRAYS
from ..record import Array
from ..scenarios import road as tracks
from ..scenarios.driver import compute_wind
from ..sensors.slow import compute_lane_quality
from ..vehicle.actuators import compute_torque_limit
from ..vehicle.dynamics import Motion, compute_curvature, compute_gravity
from ..vehicle.parameters import Vehicle
from ..vehicle.tyres import LINEAR, compute_lateral_forces, compute_tyre_load, compute_tyres
from .canvas import Box, Canvas
from .palette import INK, PALETTE, mix_colours
from .trace import TRACE_POINT, RenderState

_make_step_params, _make_step_variant = as_python(make_step_params), as_python(make_step_variant)
_compute_tyre_load, _compute_tyres = as_python(compute_tyre_load), as_python(compute_tyres)
_compute_lateral_forces = as_python(compute_lateral_forces)
_apply_tyre_change, _compute_gravity = as_python(apply_tyre_change), as_python(compute_gravity)
_compute_torque_limit, _compute_wind = as_python(compute_torque_limit), as_python(compute_wind)
_compute_lane_quality = as_python(compute_lane_quality)
_step_nominal_car = as_python(tracks.step_nominal_car)
_compute_curvature = as_python(compute_curvature, ARRAYS)
_compute_path_offset = as_python(tracks.compute_path_offset, ARRAYS)

_KNOWN_LENGTH = 45  # m of road in a scene before the car, and behind it; fewer are drawn
_DEFAULT_HALF_ANGLE = 0.35  # rad to either side, where the scenario's camera sees at any heading


class _Body(NamedTuple):
    """The extent of a car's body from its centre of gravity (m)."""

    front: float
    rear: float  # negative
    half: float  # of the width

    @property
    def outline(self) -> Array:
        """A box with bevelled corners, more at the front: points in car axes (m), (8, 2)."""
        front, rear, half = self
        left = np.array([
            (front, 0.6 * half), (front - 0.1 * (front - rear), half), (rear + 0.2, half),
            (rear, 0.8 * half),
        ])  # fmt: skip
        return np.concatenate([left, left[::-1] * (1.0, -1.0)])


class Wheel(NamedTuple):
    """A wheel in car axes, x ahead and y to the left of the centre of gravity."""

    x: float  # m
    y: float
    angle: float  # rad, steered
    F_x: float  # N, in the wheel's own axes, of the road on the tyre
    F_y: float
    capacity: float  # N in all directions; 0: without a limit

    def outline(self, r: float) -> Array:
        """Make the corners in car axes (m), shape (4, 2).

        Args:
            r: Radius of the wheel (m).
        """
        w, cos, sin = 0.3 * r, np.cos(self.angle), np.sin(self.angle)
        corners = np.array([(r, w), (r, -w), (-r, -w), (-r, w)])
        rotated: Array = corners @ np.array([(cos, sin), (-sin, cos)]) + (self.x, self.y)
        return rotated


class _CameraOverlay(NamedTuple):
    """The camera's field of view, drawn over the road."""

    preview: float  # m, its preview distance
    half_angle: float  # rad
    has_lane: bool  # a lane is in view


class CarScene(NamedTuple):
    """A car at an instant."""

    motion: Motion
    vehicle: Vehicle
    torques: tuple[float, float]  # N m, left and right motor
    max_torque: float  # N m, of one motor
    wheels: tuple[Wheel, ...]  # front left and right, rear left and right
    friction: float  # of the road, the mean of both sides
    wind: float  # N, to the left
    field_of_view: _CameraOverlay | None  # None without a camera
    lanes: tuple[tracks.Section, ...]  # between cones
    path: Array  # the driver's, rows (s, y) in m; (0, 2) where it is the road's centre line
    curvatures: Array  # 1/m, the road's curvature at each of the next _KNOWN_LENGTH metres
    half_width: float  # m
    failure: int


def make_car_scene(shot: RenderState) -> CarScene:
    """Make the scene of a car from its packed numbers.

    Args:
        shot: State of the car.
    """
    p, z, switches, _, config, *_ = shot.episode
    params, variant = _make_step_params(p), _make_step_variant(p, switches)
    motion, drive, tick = read(z, Z.motion), read(z, Z.drive), float(z[Z.clock.tick])
    car = _apply_tyre_change(params.car, params.tyre_change, tick >= params.tyre_change.tick)
    load = _compute_tyre_load(drive, car, variant)
    _, g_y = _compute_gravity(motion, params.road, variant.small_angle)
    a, b, c, d, F_x, N_z = _compute_tyres(motion, load, car, g_y, variant)
    tyres = a, b, c, d
    lateral = _compute_lateral_forces(*tyres, variant.law, variant.small_angle)
    turn = N_z / car.d_r
    longitudinal = 0.0, 0.0, 0.5 * F_x - turn, 0.5 * F_x + turn
    axles = (car.l_f, car.d_f, drive.delta_f), (-car.l_r, car.d_r, 0.0)
    places = [(x, 0.5 * side * track, angle) for x, track, angle in axles for side in (1, -1)]
    wheels = []
    for place, F_wx, F_wy, tyre in zip(places, longitudinal, lateral, tyres, strict=True):
        # a tyre's limit is what its drive force leaves of the friction circle
        capacity = 0.0 if variant.law == LINEAR else math.hypot(tyre.limit, F_wx)
        forces = (F_wx, F_wy, capacity) if shot.has_tyre_forces else (0.0, 0.0, 0.0)
        wheels.append(Wheel(*place, *forces))
    lanes, view, overlay = _find_lanes(params.path, config), read(p, P.field_of_view), None
    s = np.arange(motion.s - _KNOWN_LENGTH, motion.s + _KNOWN_LENGTH, 0.5) if lanes else np.empty(0)
    if "camera" in config.slow:
        angle = float(view.heading) if math.isfinite(view.heading) else _DEFAULT_HALF_ANGLE
        has_lane = bool(_compute_lane_quality(motion, view))
        overlay = _CameraOverlay(float(p[P.car.l_pre]), angle, has_lane)
    return CarScene(
        motion=motion, vehicle=config.vehicle, torques=(float(drive.T_l), float(drive.T_r)),
        max_torque=float(_compute_torque_limit(motion.v_x, car)), wheels=tuple(wheels),
        friction=0.5 * float(car.mu + car.mu_r), wind=float(_compute_wind(tick, params.wind)[0]),
        field_of_view=overlay, lanes=lanes,
        path=np.stack([s, _compute_path_offset(params.path, s)], 1),
        curvatures=_sample_curvatures(params, z, motion, variant.road),
        half_width=float(params.task.half_width), failure=int(z[Z.clock.failure]),
    )  # fmt: skip


def _find_lanes(path: tracks.TrackPath, config: EpisodeConfig) -> tuple[tracks.Section, ...]:
    """Find the lanes between the cones of the episode's track, as its seed placed them."""
    track, width = config.scenario.path, config.vehicle.width
    standard = tracks.make_path(track, width)
    if config.scenario.steering != "driver" or standard.shift_1 == 0.0:
        return ()
    scale = float(path.length_1 / standard.length_1)
    start = float(path.start_1 - scale * standard.start_1)
    return tracks.make_sections(track, width, start, scale, math.copysign(1.0, path.shift_1))


def _sample_curvatures(params: StepParams, z: Array, motion: Motion, road: int) -> Array:
    """Sample the curvature ahead; a nominal path is assumed to keep its present turning rate."""
    distances = motion.s + np.arange(float(_KNOWN_LENGTH))
    curvatures: Array = _compute_curvature(params.road, distances)
    if road == tracks.NOMINAL_PATH:
        nominal_motion, driver = read(z, Z.nominal_motion), float(z[Z.driver])
        turn_rate, _ = _step_nominal_car(nominal_motion, driver, motion.v_x, params.nominal_car)
        curvatures = turn_rate / max(motion.v_x, 1.0) + curvatures
    return curvatures


BLUE, ORANGE = PALETTE[0], PALETTE[1]
ASPHALT, GRASS, PAINT, SOFT = "#D9DCE0", "#E2E9DA", "#FFFFFF", "#6B7177"
_TYRE = "#23272B"
_CAR_LENGTH, _SCALES = 96.0, (22.0, 30.0)  # pixels of a car; of a metre, at least and at most
_LANE = 1.75  # m to either side of the centre line, where the scenario sets no limit
_LENGTH_RATIO = 1.62  # length of every car's body over its wheelbase


class CarTrack(NamedTuple):
    """A car to draw: its scene, its past, the colour of its body, and a name."""

    scene: CarScene
    truth: Array  # trace of the true motion, rows of `TracePoint`
    colour: str
    name: str = ""  # above the road, in its colour


class Projection(NamedTuple):
    """A projection from the ground, or a car's axes, to pixels."""

    centre: tuple[float, float]  # pixels
    scale: float  # pixels a metre
    x: float = 0.0  # m, the place that is drawn at `centre`
    y: float = 0.0
    cos: float = 1.0  # of the direction that is drawn to the right
    sin: float = 0.0

    def __call__(self, points: Array) -> Array:
        """Project places to pixels, both of shape (n, 2)."""
        rel = np.asarray(points, float) - (self.x, self.y)
        right = rel[:, 0] * self.cos + rel[:, 1] * self.sin
        up = rel[:, 1] * self.cos - rel[:, 0] * self.sin
        return np.stack([self.centre[0] + self.scale * right, self.centre[1] - self.scale * up], 1)


class _CentreLine:
    """The centre line of the road: as the car drove along it, and its continuation."""

    def __init__(self, scene: CarScene, truth: Array) -> None:
        X, Y, s, y, theta = truth.T[TRACE_POINT.X :]
        X, Y = X + y * np.sin(theta), Y - y * np.cos(theta)
        backward, forward = np.arange(-_KNOWN_LENGTH, 0.0), np.arange(1.0, _KNOWN_LENGTH + 1.0)
        directions = theta[-1] + np.cumsum(scene.curvatures)
        middle = directions - 0.5 * scene.curvatures
        next_X, next_Y = X[-1] + np.cumsum(np.cos(middle)), Y[-1] + np.cumsum(np.sin(middle))
        self._s = np.concatenate([s[0] + backward, s, s[-1] + forward])
        self._X = np.concatenate([X[0] + backward * np.cos(theta[0]), X, next_X])
        self._Y = np.concatenate([Y[0] + backward * np.sin(theta[0]), Y, next_Y])
        self._theta = np.concatenate([theta[0] + 0.0 * backward, theta, directions])

    def locate(self, s: Array, y: Array) -> Array:
        """Locate points of the road, s ahead and y to the left (m), on the ground: shape (n, 2)."""
        X, Y, theta = (np.interp(s, self._s, line) for line in (self._X, self._Y, self._theta))
        return np.stack([X - y * np.sin(theta), Y + y * np.cos(theta)], 1)


class _RoadPicture(NamedTuple):
    """The road around a car, drawn in a box of a canvas."""

    canvas: Canvas
    box: Box
    project: Projection
    centre_line: _CentreLine
    scene: CarScene
    s: Array  # m, places along the road that are drawn

    def locate(self, s: Array, y: Array) -> Array:
        """Locate points of the road, s ahead and y to the left (m), in the picture (px), (n, 2)."""
        return self.project(self.centre_line.locate(s, y))

    def fill_band(self, s: Array, offset: float, half: float, colour: str) -> None:
        """Fill a strip of the road about a lateral offset (m), of a half width."""
        y = np.repeat([offset - half, offset + half], len(s))
        self.canvas.draw_polygon(self.locate(np.concatenate([s, s[::-1]]), y), colour)

    def draw_surface(self) -> None:
        """Draw grass and asphalt, or a wide proving ground; the lanes between cones are lighter."""
        is_ground = self.scene.half_width > 10.0 or bool(self.scene.lanes)
        self.canvas.draw_box(self.box, ASPHALT if is_ground else GRASS)
        if not is_ground:
            self.fill_band(self.s, 0.0, self.scene.half_width + 0.6, ASPHALT)
        for lane in self.scene.lanes:
            ends, shade = [lane.start, lane.start + lane.length], mix_colours(PAINT, ASPHALT, 0.5)
            self.fill_band(np.array(ends), lane.offset, 0.5 * lane.width, shade)

    def draw_camera_overlay(self, overlay: _CameraOverlay) -> None:
        """Draw the camera's field of view to the preview point, and the offset that it measures."""
        m, colour = self.scene.motion, PALETTE[5] if overlay.has_lane else ORANGE
        angles = np.linspace(-overlay.half_angle, overlay.half_angle, 9)
        reach = overlay.preview / np.cos(angles)
        x, y = m.X + reach * np.cos(m.psi + angles), m.Y + reach * np.sin(m.psi + angles)
        wedge = self.project(np.stack([np.append(m.X, x), np.append(m.Y, y)], 1))
        self.canvas.draw_polygon(wedge, mix_colours(colour, ASPHALT, 0.2))
        if overlay.has_lane:
            lane = self.locate(np.array([m.s + overlay.preview]), np.array([0.0]))[0]
            self.canvas.draw_line([lane, wedge[5]], colour, 2.5)  # the ray straight ahead
            self.canvas.draw_disc(lane, 3.0, colour)

    def draw_markings(self) -> None:
        """Draw lane markings, or cones with the driver's path; a thin line every ten metres."""
        canvas, scene, s = self.canvas, self.scene, self.s
        for place in np.arange(10.0 * np.ceil(s[0] / 10.0), s[-1], 10.0):
            ends = self.locate(np.full(2, place), np.array([-30.0, 30.0]))
            canvas.draw_line(ends, mix_colours(PAINT, ASPHALT, 0.35), 1.0)
            foot = ends[:, 0].mean() + 4.0, self.box[1] + self.box[3] - 10.0
            canvas.draw_text(foot, f"{place:.0f} m", SOFT, 11)
        if scene.lanes:
            path = scene.path[(scene.path[:, 0] > s[0]) & (scene.path[:, 0] < s[-1])]
            canvas.draw_line(self.locate(*path.T), SOFT, 1.0, (2.0, 4.0))
        else:
            edge = scene.half_width if scene.half_width <= 10.0 else _LANE
            for side in (-edge, edge):
                canvas.draw_line(self.locate(s, np.full_like(s, side)), PAINT, 2.0)
            for start in np.arange(9.0 * np.floor(s[0] / 9.0), s[-1], 9.0):
                canvas.draw_line(self.locate(start + np.arange(4.0), np.zeros(4)), PAINT, 2.0)
        for lane in scene.lanes:
            count = max(round(lane.length / 3.0), 2) + 1
            places = np.linspace(lane.start, lane.start + lane.length, count)
            sides = lane.offset + np.array([-0.5, 0.5]) * lane.width
            for place in places[np.abs(places - s.mean()) < 30.0]:
                for cone in self.locate(np.full(2, place), sides):
                    canvas.draw_disc(cone, 3.6, ORANGE)
                    canvas.draw_disc(cone, 1.4, PAINT)


def draw_road(canvas: Canvas, box: Box, cars: list[CarTrack]) -> None:
    """Draw the road around the last of the cars, in a box; the others are ghosts beside it.

    Args:
        canvas: Canvas of the picture.
        box: Part of the canvas that the road fills (px).
        cars: Cars with their traces, at least one.
    """
    scene, truth, *_ = cars[-1]
    motion, road = scene.motion, _CentreLine(scene, truth)
    front, rear, _ = compute_body(scene.vehicle)
    scale = min(max(_CAR_LENGTH / (front - rear), _SCALES[0]), _SCALES[1])
    reach = box[3] / scale / 2.0 - 2.5  # the view follows a car that would leave it
    y = motion.y - min(max(motion.y, -reach), reach)
    x_0, y_0 = road.locate(np.array([motion.s]), np.array([y]))[0]
    centre = box[0] + 0.3 * box[2], box[1] + 0.5 * box[3]
    view = Projection(centre, scale, x_0, y_0, np.cos(motion.theta), np.sin(motion.theta))
    s = np.arange(motion.s - 16.0, motion.s + 34.0, 1.0)
    picture = _RoadPicture(canvas, box, view, road, scene, s)
    canvas.set_clip(box)
    picture.draw_surface()
    if scene.field_of_view is not None:
        picture.draw_camera_overlay(scene.field_of_view)
    picture.draw_markings()
    for car in cars:
        trail = view(car.truth[-400:, [TRACE_POINT.X, TRACE_POINT.Y]])
        if len(trail) > 1:
            canvas.draw_line(trail, mix_colours(car.colour, ASPHALT, 0.55), 2.0)
    for car in cars:
        heading = car.scene.motion.psi - motion.theta
        x, y = view(np.array([[car.scene.motion.X, car.scene.motion.Y]]))[0]
        turned = Projection((x, y), scale, cos=np.cos(heading), sin=-np.sin(heading))
        _draw_car(canvas, turned, car.scene, car.colour)
    canvas.set_clip(None)
    left = box[0] + 16.0
    for car in reversed(cars):
        place = left, box[1] + 12.0
        left += canvas.draw_text(place, car.name, mix_colours(car.colour, INK, 0.6), 12) + 18.0


def _draw_car(canvas: Canvas, project: Projection, scene: CarScene, colour: str) -> None:
    """Draw a car by the projection of its axes."""
    body = front, rear, half = compute_body(scene.vehicle)
    for wheel in scene.wheels:  # further out than they are, to be seen
        shown = wheel._replace(y=np.sign(wheel.y) * half)
        canvas.draw_polygon(project(shown.outline(scene.vehicle.wheel_radius)), _TYRE)
    canvas.draw_polygon(project(body.outline), colour)
    shares = ((0.62, 0.86), (0.74, 0.72)), ((0.14, 0.74), (0.21, 0.86))  # of length and width
    for corners in np.array(shares) * (front - rear, half) + (rear, 0.0):
        window = np.concatenate([corners, corners[::-1] * (1.0, -1.0)])
        canvas.draw_polygon(project(window), mix_colours(INK, colour, 0.55))


def compute_body(vehicle: Vehicle) -> _Body:
    """Compute the front, rear and half width (m) of a car's body.

    Args:
        vehicle: Vehicle with the axles' places and the width.
    """
    over = 0.5 * (_LENGTH_RATIO - 1.0) * vehicle.wheelbase
    return _Body(vehicle.front_arm + over, -vehicle.rear_arm - over, 0.5 * vehicle.width)
