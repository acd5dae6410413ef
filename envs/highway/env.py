"""highway-env's worlds as our environments: its roads with vehicles, and its lane keeping.

`HighwayEnv` is our car on its roads, `KeepingEnv` its own `lane-keeping-v0`, whose car is a linear
bicycle at constant speed that is steered alone. Faults of version 1.12.1 are worked around there:
`render_mode` is set on the built environment, which takes no such argument; `step` returns the
observation from before the step (`NativeObservation` takes either); steps of 0.1 s are unstable
below 5.5 m/s, so a step is a tick; its too weak linear model is not used.
"""

import copy
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ..engine.layout import P, Z
from ..engine.window import WINDOW
from ..numerics.functions import TICK
from ..numerics.jit import as_python
from ..numerics.packed import read
from ..outside.env import PlantEnv
from ..outside.plants import OutsideInputs
from ..record import Array
from ..scenarios.manoeuvres import ScenarioSource, make_scenario
from ..scenarios.scenario import Scenario
from ..scenarios.world import Range
from ..sensors.slow import compute_preview_offset
from ..stability import StabilityEnv
from ..task import (
    COLLISION,
    DEPARTURE,
    REPORT,
    RUNNING,
    ObservationEntry,
    compute_failure_cost,
    make_space,
)
from ..validation import check_choice, check_int, check_mapping, check_options
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import Vehicle, VehicleSource
from .traffic import PERIOD, ROADS, Hazard, Traffic, TrafficStart, locate_on_lane

from highway_env.envs.lane_keeping_env import LaneKeepingEnv  # isort: skip  # after `traffic`
from highway_env.vehicle.dynamics import BicycleVehicle  # isort: skip

if TYPE_CHECKING:
    from highway_env.road.graphics import WorldSurface

MAX_VEHICLES = 40  # vehicles: a step of the road looks at every pair
_MAX_PERIOD = 20  # ticks between two looks at a lane that bends
_OWN_ROAD_FIELDS = ("road", "curvature", "path", "small_angle")
_FIXED_STATE = ("s", "theta", "X", "Y")


class HighwayEnv(StabilityEnv):
    """`StabilityEnv` in one of highway-env's road networks, with other vehicles.

    By default the vehicle ahead brakes hard on a wet road, and a late driver swerves around it into
    the free lane and back; the yaw moment decides whether that ends in a collision, off the road,
    or well. Action, observation, record, reward, info and estimators are those of `StabilityEnv`;
    camera, driver and the record's curvature refer to the lane that our car follows, which begins
    as its own and stays so while the driver swerves. Needs the extra `highway`.

    The episode's key draws the side of the free lane, the hazard, the traffic and highway-env's own
    random numbers. The road is stepped every 50 ms, whatever the control period.

    Raises ModuleNotFoundError without highway-env, ValueError for an unknown road, a number of
    vehicles out of place, a scenario with a road of its own or of small angles, one without a
    driver beside a hazard, and a start off the road's own (reset option state: s, theta, X, Y).

    ## Episode end
    `terminated` also by a "collision", or a "departure" of the whole car beyond the road's edge,
    charged as every failure is.

    Args:
        road: "straight", "curved" (bends of 400 m) or "merging" (others join from a ramp).
        hazard: Fields of `Hazard`, {} for the usual ones, None for no vehicle that brakes.
        traffic: Number of further vehicles, of highway-env's IDM, at most 40.
        sensors: "vision", "vision-uneven", "gps" or "fusion".
        scenario: Scenario as `make_scenario` reads it, with a driver where there is a hazard; bank
            and grade are there from the beginning.
        vehicle: The true vehicle, as `make_vehicle` reads it.
        reference: "zero-slip", "model", "limited" or "lagged".
        options: Further arguments of `StabilityEnv`.
    """

    def __init__(
        self, road: str = "straight",
        hazard: Mapping[str, Range] | None = {},  # never written
        traffic: int = 3, sensors: str = "fusion", scenario: ScenarioSource = "wet-evasion",
        vehicle: VehicleSource = "passenger-car", reference: str = "lagged", **options: Any,
    ) -> None:  # fmt: skip
        check_choice("road", road, ROADS)
        if hazard is not None:
            check_options("hazard", Hazard.__init__, check_mapping("hazard", hazard))
        self.road, self.hazard = road, None if hazard is None else Hazard(**hazard)
        self.traffic = check_int("traffic", traffic, "vehicles", 0, MAX_VEHICLES)
        adapted = self._adapt_scenario(make_scenario(scenario))
        super().__init__(sensors, adapted, vehicle, reference=reference, **options)
        if self.config.lead_in:
            raise ValueError("lead_in: the vehicle ahead does not wait, so an episode has none")
        if road == "curved" and (n := self.control_period) > _MAX_PERIOD:
            rule = f"the lane is found once a step: {_MAX_PERIOD} ticks at most"
            raise ValueError(f"control_period is {n} ticks; road {road!r} bends, and {rule}")
        self._traffic: Traffic | None = None

    def _adapt_scenario(self, scenario: Scenario) -> Scenario:
        """Set bank and grade from the beginning; ValueError for a road of its own or no driver."""
        defaults, name = Scenario(name=""), f"scenario {scenario.name!r}"
        for field in _OWN_ROAD_FIELDS:
            if (value := getattr(scenario, field)) != getattr(defaults, field):
                rule = "here the road is highway-env's, whose bends are driven at any angle"
                raise ValueError(f"{name}: {field} {value!r} is of our own roads; {rule}")
        if self.hazard is not None and scenario.steering != "driver":
            rule = "swerves around nothing; a hazard takes 'driver', or hazard=None"
            raise ValueError(f"{name}: steering {scenario.steering!r} {rule}")
        return scenario.replace(curve_start=-1000.0, curve_ramp=1.0)

    def _adapt_options(self, options: dict[str, Any]) -> dict[str, Any]:
        """Adapt the scenario; ValueError for a state with a place along the road."""
        if "scenario" in options:
            options["scenario"] = self._adapt_scenario(make_scenario(options["scenario"]))
        state = options.get("state", {})
        if isinstance(state, Mapping):
            if bad := [name for name in _FIXED_STATE if name in state]:
                raise ValueError(f"reset option state: {bad[0]} is where the road begins; y may be")
            if "y" in state:
                options["state"] = {**state, "Y": state["y"]}
        return options

    def _start_episode(self) -> None:
        """Make the road, its vehicles, and the driver's path around the one that brakes."""
        p, z = self._row.p, self._row.z
        speed, friction = float(p[P.speed_profile.speed]), 0.5 * float(p[P.car.mu] + p[P.car.mu_r])
        start = TrafficStart(self._episode.vehicle, self.motion, speed, friction)
        key = int(z[Z.clock.key_low]) | int(z[Z.clock.key_high]) << 32
        self._traffic = Traffic(self.road, start, self.hazard, self.traffic, key)
        if self._traffic.path is not None:
            p[list(P.path)] = self._traffic.path
        super()._start_episode()

    def _advance(self, command: npt.NDArray[np.float32]) -> int:
        """Drive a control period on the lane as it is here, then take the road's steps in it."""
        traffic, row = self._traffic, self._row
        p, z, report = row.p, row.z, row.report
        assert traffic is not None
        position = traffic.locate(self.motion)
        z[Z.motion.y], z[Z.motion.theta] = position.y, position.theta
        p[P.road.curvature] = position.curvature
        first = int(z[Z.clock.tick])
        done = super()._advance(command)
        is_running = done > 0 and report[REPORT.failure] == RUNNING
        for tick in range(first + 1, first + done + 1) if is_running else ():
            if tick % PERIOD == 0:
                traffic.step_road(read(row.window, WINDOW.track, tick - first - 1))
        if is_running and (traffic.crashed or traffic.departed):
            failure = COLLISION if traffic.crashed else DEPARTURE
            z[Z.clock.failure] = report[REPORT.failure] = failure
            report[REPORT.cost] += compute_failure_cost(p[P.task.duration], z[Z.clock.tick])
            report[REPORT.reward] = -report[REPORT.cost]
        return done

    def _draw_world(self, size: tuple[int, int], others: list[Motion]) -> "WorldSurface":
        """Draw the road around our car by highway-env, with others of ours as shadows on it."""
        import pygame
        from highway_env.road.graphics import RoadGraphics, WorldSurface
        from highway_env.vehicle.graphics import VehicleGraphics

        assert self._traffic is not None
        road, ego = self._traffic.road, self._traffic.ego
        surface = WorldSurface(size, 0, pygame.Surface(size))
        surface.scaling, surface.centering_position = 10.0, [0.3, 0.5]
        ego.set_motion(self.motion)
        surface.move_display_window_to(ego.position)
        RoadGraphics.display(road, surface)
        RoadGraphics.display_road_objects(road, surface, offscreen=True)
        for motion in others:
            shadow = copy.copy(ego)
            shadow.set_motion(motion)
            shadow.color = (170, 170, 170)
            VehicleGraphics.display(shadow, surface, offscreen=True)
        RoadGraphics.display_traffic(road, surface, offscreen=True)
        return surface

    def get_state(self) -> dict[str, Any]:
        """Copy the state, traffic included, from which `set_state` continues bit for bit."""
        return super().get_state() | {"road": self.road, "around": copy.deepcopy(self._traffic)}

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        if snapshot.get("road") != self.road:
            raise ValueError(f"the snapshot is of road {snapshot.get('road')!r}, not {self.road!r}")
        super()._restore(snapshot)
        self._traffic = copy.deepcopy(snapshot["around"])


_compute_preview_offset = as_python(compute_preview_offset)
_MASS = 1000.0  # kg; theirs is 1 kg, and only ratios to it count
KEEPING = Scenario(
    name="lane-keeping-v0", duration=16.0, speed=8.3, tyres="linear", roll=False,
    disturbance_force=0.0, disturbance_moment=0.0,
)  # fmt: skip
"""Only the controller steers; the car and its lane are highway-env's."""
STATES = ("beta", "gamma", "psi", "y_l")


def make_keeping_vehicle() -> Vehicle:
    """Make highway-env's bicycle as our `Vehicle`; the motors, roll and height are assumed."""
    car = BicycleVehicle
    return Vehicle(
        name="highway-env's bicycle", mass=_MASS, yaw_inertia=_MASS * car.INERTIA_Z / car.MASS,
        front_arm=car.LENGTH_A, rear_arm=car.LENGTH_B,
        front_stiffness=_MASS * car.FRICTION_FRONT / car.MASS,  # per tyre, as their 2 C_f has it
        rear_stiffness=_MASS * car.FRICTION_REAR / car.MASS, front_track=1.6, rear_track=1.6,
        wheel_radius=0.3, gravity_height=0.5, motor_torque=100.0, steering_authority=0.5,
        width=car.WIDTH, sprung_mass=0.9 * _MASS, roll_arm=0.3, roll_inertia=500.0,
        roll_stiffness=5e4, roll_damping=3e3,
    )  # fmt: skip


class _KeepingPlant:
    """The car of a `lane-keeping-v0`, stepped by ticks; disturbances and torques do nothing."""

    def __init__(self, render_mode: str | None = None) -> None:
        rate = round(1.0 / TICK)
        self.env = LaneKeepingEnv({"simulation_frequency": rate, "policy_frequency": rate})
        self.env.render_mode = render_mode
        self.specific_force = (0.0, 0.0)

    def start(self, seed: int) -> None:
        """Begin an episode with a seed of highway-env's environment."""
        self.last_observation, _ = self.env.reset(seed=seed)
        self.s = 0.0
        self.project()

    def project(self) -> None:
        """Project the car onto highway-env's lane; the next tick is one of its own `step`."""
        self._is_full_step = True
        x, y, heading = self.env.vehicle.state[:3, 0].tolist()
        _, self.y, self.theta, self.curvature = locate_on_lane(self.env.lane, x, -y, -heading)

    def step(self, inputs: OutsideInputs, h: float) -> None:
        """Step the car over a tick of h seconds, and integrate its place on the lane."""
        action = np.array([-inputs.steer / self.env.action_type.steering_range[1]])
        before = self.motion
        if self._is_full_step:
            self.last_observation, *_ = self.env.step(action)
        else:
            self.env.action_type.act(action)
            self.env.road.step(h)
        self._is_full_step, after = False, self.motion
        ends = zip(_compute_road_velocity(before), _compute_road_velocity(after), strict=True)
        distance, sideways = (0.5 * h * (a + b) for a, b in ends)
        ds = distance / (1.0 - self.curvature * self.y)
        self.s, self.theta = self.s + ds, self.theta + self.curvature * ds
        self.y += sideways
        rate = -float(self.env.vehicle.derivative[4, 0])
        self.specific_force = (-after.gamma * after.v_y, rate + after.gamma * after.v_x)

    @property
    def motion(self) -> Motion:
        """The car's state in our axes."""
        x, y, heading, speed, slide, turn = self.env.vehicle.state[:, 0].tolist()
        return Motion(speed, -slide, -turn, -heading, x, -y, self.s, self.y, self.theta)

    @property
    def is_finite(self) -> bool:
        """Whether the state is made of numbers."""
        return bool(np.isfinite(self.env.vehicle.state).all())

    def states(self, observation: Mapping[str, Array], preview: float) -> tuple[float, ...]:
        """Compute `STATES` of highway-env's observation, y_l at a preview distance (m)."""
        lateral, heading, slide, turn = np.ravel(observation["state"]).tolist()
        centre, lane = np.ravel(observation["reference_state"])[:2].tolist()
        psi, speed = math.remainder(lane - heading, 2.0 * math.pi), float(self.env.vehicle.speed)
        y_l = _compute_preview_offset(centre - lateral, psi, self.curvature, preview)
        return math.atan2(-slide, speed), -turn, psi, y_l


def _compute_road_velocity(motion: Motion) -> tuple[float, float]:
    """Compute the velocity (along, across) in the road's axes (m/s)."""
    angle = motion.psi - motion.theta
    cos, sin = math.cos(angle), math.sin(angle)
    return motion.v_x * cos - motion.v_y * sin, motion.v_x * sin + motion.v_y * cos


class KeepingEnv(PlantEnv):
    """`StabilityEnv` whose car and lane are those of highway-env's `lane-keeping-v0`.

    Action (its second entry steers, the first moves nothing), observation, record and cost are
    ours, so every estimator and `lane-keeping` run; `NativeObservation` has theirs. Needs the extra
    `highway`. A snapshot is refused: highway-env's environment makes none.

    Args:
        sensors: "vision", "vision-uneven", "gps" or "fusion".
        control_period: Ticks of 1 ms between two decisions; highway-env decides every 100.
        render_mode: Render mode of highway-env's environment.
        options: Further arguments of `StabilityEnv`.
    """

    def __init__(
        self, sensors: str = "vision", control_period: int = 10, render_mode: str | None = None,
        **options: Any,
    ) -> None:  # fmt: skip
        self.plant: _KeepingPlant = _KeepingPlant(render_mode)
        options = {"steering": True, "reference": "zero-slip", **options}
        car = make_keeping_vehicle()
        super().__init__(sensors, KEEPING, car, control_period=control_period, **options)

    def _adapt_options(self, options: dict[str, Any]) -> dict[str, Any]:
        if options:
            raise ValueError(f"lane-keeping-v0 starts as it is, got {', '.join(options)}")
        self.plant.start(0)  # it always starts there
        return {"state": self.plant.motion._asdict()}

    def _start_episode(self) -> None:
        self.plant.start(int(self._row.z[Z.clock.key_low]))

    def _advance(self, command: npt.NDArray[np.float32]) -> int:
        """Drive a control period on the lane as it is here, which camera and record then have."""
        plant, z = self.plant, self._row.z
        plant.project()
        self._row.p[P.road.curvature] = plant.curvature
        z[Z.motion.y], z[Z.motion.theta] = plant.y, plant.theta
        return super()._advance(command)

    @property
    def truth(self) -> tuple[float, ...]:
        """The true `STATES`."""
        motion = self.motion
        psi = motion.psi - motion.theta
        y_l = _compute_preview_offset(motion.y, psi, self.plant.curvature, self.vehicle.preview)
        return math.atan2(motion.v_y, motion.v_x), motion.gamma, psi, y_l

    def get_state(self) -> dict[str, Any]:
        """Refuse: TypeError, since highway-env makes no snapshots."""
        raise TypeError("highway-env's lane-keeping-v0 makes no snapshots")

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        self.get_state()


class NativeObservation(gym.ObservationWrapper[Any, Any, Any]):
    """A `KeepingEnv` whose estimates are highway-env's own observation.

    Args:
        env: A `KeepingEnv`.
        returned: Whether it is what `step` returns, from before the step; else the newest.
    """

    def __init__(self, env: gym.Env[Any, Any], returned: bool) -> None:
        super().__init__(env)
        self._returned = returned
        units = zip(STATES, ("rad", "rad/s", "rad", "m"), strict=True)
        entries = [ObservationEntry(f"{name}_hat", unit, -200.0, 200.0) for name, unit in units]
        self.layout = (*env.get_wrapper_attr("layout"), *entries)
        self.observation_space = make_space(self.layout)

    def observation(self, observation: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Append highway-env's `STATES` to an observation, in float32.

        Args:
            observation: That of the `KeepingEnv`.
        """
        base = self.env.unwrapped
        assert isinstance(base, KeepingEnv)
        plant = base.plant
        native = plant.last_observation if self._returned else plant.env.observation_type.observe()
        states = plant.states(native, base.vehicle.preview)
        return np.concatenate([observation, np.asarray(states, np.float32)])
