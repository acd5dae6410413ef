"""`HighwayEnv`: our car and its sensors on highway-env's roads, among its vehicles."""

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..engine.layout import P, Z
from ..engine.window import WINDOW
from ..numerics.packed import read
from ..scenarios.draws import Range
from ..scenarios.manoeuvres import ScenarioSource, make_scenario
from ..scenarios.scenario import Scenario
from ..stability import StabilityEnv
from ..task import COLLISION, DEPARTURE, REPORT, RUNNING, compute_failure_cost
from ..validation import check_choice, check_int, check_mapping, check_options
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import VehicleSource
from .traffic import PERIOD, ROADS, Hazard, Traffic, TrafficStart

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
        self,
        road: str = "straight",
        hazard: Mapping[str, Range] | None = {},  # never written
        traffic: int = 3,
        sensors: str = "fusion",
        scenario: ScenarioSource = "wet-evasion",
        vehicle: VehicleSource = "passenger-car",
        reference: str = "lagged",
        **options: Any,
    ) -> None:
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
