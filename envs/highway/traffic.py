"""highway-env's road networks and vehicles, one of which brakes, with our car among them.

Our car begins at the origin, along x, at the centre of its own lane; the free lane beside it is to
its left (side 1) or to its right (-1). Every road begins straight.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..numerics import require_extra
from ..record import Array
from ..rendering import canvas
from ..rendering.road import compute_body
from ..scenarios.road import TrackPath
from ..scenarios.world import Range, get_range
from ..validation import is_finite
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import GRAVITY, Vehicle

with require_extra("highway", "roads and traffic need highway-env"):
    from highway_env.road.lane import AbstractLane, CircularLane, LineType, SineLane, StraightLane
    from highway_env.road.road import RoadNetwork

from highway_env.road.road import Road  # isort: skip  # after those above, which name the extra
from highway_env.vehicle.behavior import IDMVehicle  # isort: skip
from highway_env.vehicle.kinematics import Vehicle as HighwayVehicle  # isort: skip
from highway_env.vehicle.objects import Obstacle  # isort: skip

assert canvas  # which keeps pygame from greeting
WIDTH = StraightLane.DEFAULT_WIDTH  # m
# m: length of the first straight, where roads begin, where they end
ENTRY, _BEHIND, _BEYOND = 60.0, -300.0, 3000.0
RADIUS, ANGLE = 400.0, math.radians(60.0)  # of either bend
_LINE, _DASHES, _NONE = LineType.CONTINUOUS_LINE, LineType.STRIPED, LineType.NONE
_FAST = 60.0  # m/s, no limit
_DIFFERENCE = 0.05  # m, of differences along a lane


class _RoadLayout:
    """A network of two lanes whose first straight lies behind our car, and its way through it."""

    def __init__(self, side: int) -> None:
        self.side = side  # of the free lane
        self.network = RoadNetwork()
        self.ramp: tuple[str, str, int] | None = None  # where others merge from
        self.route: list[AbstractLane] = []  # our lanes, one after the other
        self.add_straight("start", "a", _BEHIND, 0.0)
        self.route.clear()

    def list_lanes(self) -> list[tuple[float, tuple[int, int]]]:
        """List both lanes from left to right: (offset in m to the right of ours, its lines)."""
        left = -WIDTH if self.side > 0 else 0.0
        return [(left, (_LINE, _DASHES)), (left + WIDTH, (_NONE, _LINE))]

    def add_straight(self, a: str, b: str, start: float, end: float, y: float = 0.0) -> None:
        """Add both lanes of a straight stretch from x = start to end, ours at y."""
        for offset, lines in self.list_lanes():
            ends = [start, y + offset], [end, y + offset]
            lane = StraightLane(*ends, WIDTH, lines, speed_limit=_FAST)
            self.network.add_lane(a, b, lane)
            self.route += [lane] * (offset == 0.0)


class LanePosition(NamedTuple):
    """Position of a point on a lane, in our axes."""

    longitudinal: float  # the lane's own coordinate, which need not be an arc length
    y: float  # m, left of the lane's centre line
    theta: float  # rad, the lane's direction
    curvature: float  # 1/m, left positive


def _make_straight(side: int) -> _RoadLayout:
    """Make two lanes straight ahead."""
    road = _RoadLayout(side)
    road.add_straight("a", "b", 0.0, _BEYOND)
    return road


def _make_curved(side: int) -> _RoadLayout:
    """Make two lanes through a bend to the left and one to the right, with circular arcs."""
    road = _RoadLayout(side)
    road.add_straight("a", "b", 0.0, ENTRY)
    position, heading = np.array([ENTRY, 0.0]), 0.0
    for first, last, turn in (("b", "c", 1.0), ("c", "d", -1.0)):
        centre = position + turn * RADIUS * np.array([math.sin(heading), -math.cos(heading)])
        phase = heading + turn * 0.5 * math.pi
        for offset, lines in road.list_lanes():
            radius, ends = RADIUS + turn * offset, (phase, phase - turn * ANGLE)
            lane = CircularLane(centre, radius, *ends, turn < 0.0, WIDTH, lines, speed_limit=_FAST)
            road.network.add_lane(first, last, lane)
            road.route += [lane] * (offset == 0.0)
        arc = road.route[-1]
        position, heading = arc.position(arc.length, 0.0), heading - turn * ANGLE
    road.add_straight("d", "e", position[0], position[0] + _BEYOND, position[1])
    return road


def _make_merging(side: int) -> _RoadLayout:
    """Make two lanes straight ahead that others join from a ramp on the right, as on `merge-v0`."""
    road = _RoadLayout(side)
    road.add_straight("a", "b", 0.0, 200.0)
    road.add_straight("b", "c", 200.0, 350.0)
    road.add_straight("c", "d", 350.0, _BEYOND)
    edge, sway = max(offset for offset, _ in road.list_lanes()) + WIDTH, 3.25
    far = edge + 2.0 * sway
    style = {"line_types": (_LINE, _LINE), "forbidden": True, "speed_limit": _FAST}
    ends = [120.0, far - sway], [200.0, far - sway]
    ramp = StraightLane([_BEHIND, far], [120.0, far], **style)
    bend = SineLane(*ends, sway, math.pi / 80.0, 0.5 * math.pi, **style)
    final = StraightLane([200.0, edge], [350.0, edge], **style | {"line_types": (_NONE, _LINE)})
    for first, last, lane in (("j", "k", ramp), ("k", "b", bend), ("b", "c", final)):
        road.network.add_lane(first, last, lane)
    road.ramp = ("j", "k", 0)
    return road


ROADS: dict[str, Callable[[int], _RoadLayout]] = {
    "straight": _make_straight, "curved": _make_curved, "merging": _make_merging,
}  # fmt: skip
"""The function that makes each road, for the side of the free lane."""


def locate_on_lane(lane: AbstractLane, X: float, Y: float, psi: float) -> LanePosition:
    """Locate a point of our axes on a lane of highway-env's.

    `local_coordinates` is exact on straight and circular lanes. On others, whose coordinate is no
    arc length or whose lateral is not at right angles, Newton's method finds the foot.

    Args:
        lane: Lane of highway-env.
        X: Coordinate along our first axis, which is highway-env's x (m).
        Y: Coordinate to the left (m); highway-env's y is -Y, to the right.
        psi: Heading in our axes (rad), to whose turn the lane's direction is unwrapped.
    """
    point = np.array([X, -Y])
    longitudinal, right = lane.local_coordinates(point)
    if isinstance(lane, CircularLane):
        bend = -lane.direction / lane.radius
    elif type(lane) is StraightLane:
        bend = 0.0
    else:
        for _ in range(4):
            heading = lane.heading_at(longitudinal)
            direction = np.array([math.cos(heading), math.sin(heading)])
            offset = point - lane.position(longitudinal, 0.0)
            longitudinal += float(direction @ offset) / _compute_scale(lane, longitudinal)
            right = float(direction[0] * offset[1] - direction[1] * offset[0])
        turn = lane.heading_at(longitudinal + _DIFFERENCE)
        turn -= lane.heading_at(longitudinal - _DIFFERENCE)
        bend = -turn / (2.0 * _DIFFERENCE * _compute_scale(lane, longitudinal))
    lane_direction = -lane.heading_at(longitudinal)
    theta = lane_direction + 2.0 * math.pi * round((psi - lane_direction) / (2.0 * math.pi))
    return LanePosition(float(longitudinal), -float(right), float(theta), float(bend))


def _compute_scale(lane: AbstractLane, longitudinal: float) -> float:
    """Compute the metres of a unit of a lane's own coordinate."""
    before, after = longitudinal - _DIFFERENCE, longitudinal + _DIFFERENCE
    chord = lane.position(after, 0.0) - lane.position(before, 0.0)
    return float(np.hypot(*chord)) / (2.0 * _DIFFERENCE)


PERIOD = 50  # ticks between two steps of the road
_SHORTEST = 0.8  # s, in which no driver changes lanes faster


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hazard:
    """The vehicle ahead that brakes, and the driver who swerves around it late.

    Each field is a number, or a range (low, high) that the seed draws from, of numbers from 0 on.
    Other values raise ValueError.
    """

    headway: Range = (0.5, 0.8)  # s, between the bumpers at equal speed
    onset: Range = (0.3, 0.8)  # s, when the vehicle brakes
    braking: Range = (0.8, 1.0)  # fraction of the road's grip that it brakes with
    reaction: Range = (0.7, 1.0)  # s, after which our driver swerves
    haste: Range = (1.0, 1.9)  # time of the lane change over that until the cars would meet
    stay: Range = (0.0, 0.5)  # s in the free lane, behind the standing vehicle, before returning

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            ends = list(value) if isinstance(value, list | tuple) else [value, value]
            if len(ends) != 2 or not all(map(is_finite, ends)) or not 0.0 <= ends[0] <= ends[1]:
                rule = f"{name} is a number or (low, high) from 0 on"
                raise ValueError(f"hazard: {rule}, got {value}")
            object.__setattr__(self, name, tuple(map(float, ends)))


class TrafficStart(NamedTuple):
    """The drawn start of an episode."""

    vehicle: Vehicle
    motion: Motion
    speed: float  # m/s, that our driver holds
    friction: float


class _EgoVehicle(HighwayVehicle):  # type: ignore[misc]
    """Our car among highway-env's vehicles, which its own simulation moves."""

    color = (50, 200, 0)  # highway-env's own for the car that is driven

    def __init__(self, road: Road, start: TrafficStart) -> None:
        front, rear, half = compute_body(start.vehicle)
        self.LENGTH, self.WIDTH, self._centre = front - rear, 2.0 * half, 0.5 * (front + rear)
        self.target_speed = start.speed  # which those who would merge ahead of it ask for
        super().__init__(road, [0.0, 0.0])
        self.set_motion(start.motion)
        self.on_state_update()

    def set_motion(self, motion: Motion) -> None:
        """Move to a `Motion` of our car; the body's centre is not the centre of gravity."""
        direction = np.array([math.cos(motion.psi), -math.sin(motion.psi)])
        self.position = np.array([motion.X, -motion.Y]) + self._centre * direction
        self.heading: float = -motion.psi
        self.speed: float = motion.v_x
        leftward = np.array([direction[1], -direction[0]])
        self._velocity: Array = motion.v_x * direction + motion.v_y * leftward

    @property
    def velocity(self) -> Array:
        """Velocity (m/s), shape (2,), with the sideslip that other vehicles do not have."""
        return self._velocity

    def act(self, action: object = None) -> None:
        """Do nothing: its driver is ours."""

    def step(self, dt: float) -> None:
        """Crash where the last step foresaw an impact, as highway-env's own vehicles do."""
        self.crashed |= self.impact is not None
        self.on_state_update()


class _BrakingVehicle(IDMVehicle):  # type: ignore[misc]
    """An IDM vehicle in its lane that from a time (s) on brakes (m/s2) until it stands."""

    def __init__(
        self, road: Road, position: Array, speed: float, onset: float, rate: float
    ) -> None:
        super().__init__(road, position, speed=speed, target_speed=speed, enable_lane_change=False)
        self.time_left, self.rate = onset, rate
        self.speed: float = speed

    def act(self, action: object = None) -> None:
        """Follow the road; brake from the onset on."""
        super().act(action)
        if self.time_left <= 0.0 and not self.crashed:
            self.action["acceleration"] = -self.rate

    def step(self, dt: float) -> None:
        """Step the vehicle by dt (s); it never goes backwards."""
        self.time_left -= dt
        super().step(dt)
        self.speed = max(self.speed, 0.0)


class Traffic:
    """A road with its vehicles in an episode, and our car's place on its lanes.

    Args:
        road: Name of the road, of `ROADS`.
        start: Drawn start of the episode.
        hazard: The vehicle that brakes; None for none.
        others: Number of vehicles besides the braking one.
        key: Key of the episode, from which all that is random is drawn.
    """

    def __init__(
        self, road: str, start: TrafficStart, hazard: Hazard | None, others: int, key: int
    ) -> None:
        random = np.random.Generator(np.random.Philox(key=[key, 0]))
        self.course = ROADS[road](1 if random.random() < 0.5 else -1)
        options = {"np_random": random, "neighbour_vehicles_connected_lanes": True}
        self.road = Road(self.course.network, **options)
        self.ego = _EgoVehicle(self.road, start)
        self.road.vehicles.append(self.ego)
        self._lane = 0
        self.path = None if hazard is None else self._add_hazard(hazard, start)
        self._add_vehicles(others, start)

    def _add_hazard(self, hazard: Hazard, start: TrafficStart) -> TrackPath:
        """Add the vehicle that brakes ahead of us; return the path of the swerving driver."""
        random = self.road.np_random
        draw = {name: random.uniform(*get_range(ends)) for name, ends in vars(hazard).items()}
        v, rate = start.speed, max(draw["braking"] * start.friction * GRAVITY, 0.1)
        gap = draw["headway"] * v
        distance = 0.5 * (self.ego.LENGTH + _BrakingVehicle.LENGTH) + gap
        position = np.array([self.ego.position[0] + distance, 0.0])
        self.road.vehicles.append(_BrakingVehicle(self.road, position, v, draw["onset"], rate))
        meeting = math.sqrt(2.0 * gap / rate)  # s after the onset, while it still moves
        if meeting > v / rate:  # it already stands
            meeting = gap / v + 0.5 * v / rate
        begin, shift = v * (draw["onset"] + draw["reaction"]), self.course.side * WIDTH
        length = v * max(draw["haste"] * (meeting - draw["reaction"]), _SHORTEST)
        stop = position[0] + v * draw["onset"] + 0.5 * v * v / rate + _BrakingVehicle.LENGTH
        back = max(begin + length, stop) + v * draw["stay"]
        return TrackPath(shift, begin, length, -shift, back, length)

    def _add_vehicles(self, others: int, start: TrafficStart) -> None:
        """Add IDM vehicles ahead and behind in both lanes, and on the ramp if there is one."""
        random, course = self.road.np_random, self.course
        ego, free = int(course.side > 0), int(course.side < 0)
        slots = [(free, 80.0), (ego, -35.0), (ego, 120.0), (free, -45.0)]  # lane, m ahead
        for i in range(others):
            speed, heading = start.speed * random.uniform(0.95, 1.05), 0.0
            if course.ramp is not None and i == 0:
                lane = course.network.get_lane(course.ramp)
                position = lane.position(110.0 - lane.start[0] - 60.0 * random.random(), 0.0)
            else:
                index, offset = slots[i % len(slots)]
                far = offset + math.copysign(45.0 * (i // len(slots)), offset)
                position = np.array([far + random.uniform(-8.0, 8.0), WIDTH * (index - ego)])
                along, right = position - (ENTRY, 0.0)
                for bend in (lane for lane in course.route if isinstance(lane, CircularLane)):
                    if along > 0.0:
                        position, heading = bend.position(along, right), bend.heading_at(along)
                    along -= bend.length
            other = IDMVehicle(self.road, position, heading, speed, target_speed=speed)
            self.road.vehicles.append(other)
        if course.ramp is not None:
            end = course.network.graph["b"]["c"][-1]
            self.road.objects.append(Obstacle(self.road, end.position(end.length, 0.0)))

    def step_road(self, motion: Motion) -> None:
        """Step the road by `PERIOD` ticks; the motion is that at their end."""
        self.ego.set_motion(motion)
        self.road.act()
        self.road.step(1e-3 * PERIOD)

    @property
    def crashed(self) -> bool:
        """Whether our car hit another."""
        return bool(self.ego.crashed)

    @property
    def departed(self) -> bool:
        """Whether the whole of our car's width is beyond the road's edge line."""
        return not bool(self.ego.lane.on_lane(self.ego.position, margin=0.5 * self.ego.WIDTH))

    def locate(self, motion: Motion) -> LanePosition:
        """Locate our car on the present lane of its route."""
        while True:
            lane = self.course.route[self._lane]
            position = locate_on_lane(lane, motion.X, motion.Y, motion.psi)
            if lane is self.course.route[-1] or not position.longitudinal > lane.length:
                return position
            self._lane += 1
