"""HighwayEnv: our car and its sensors on highway-env's roads, among its vehicles."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arguments import check_choice, count_of
from ..backend.arrays import read
from ..engine.layout import P, Z
from ..engine.window import WINDOW
from ..rendering.trace import Shot
from ..scenarios.manoeuvres import ScenarioSource, scenario_from
from ..scenarios.scenario import Scenario
from ..stability import StabilityEnv
from ..task.cost import rest_of_cost
from ..task.failures import COLLISION, DEPARTURE, RUNNING
from ..task.info import REPORT
from ..vehicle.dynamics import Motion
from ..vehicle.vehicles import VehicleSource
from .roads import ROADS
from .traffic import PERIOD, Start, Traffic, hazard_from

MOST = 40  # vehicles: a step of the road looks at every pair
_OURS = ("road", "curvature", "path", "small_angle")
_PLACE = ("s", "theta", "X", "Y")


class HighwayEnv(StabilityEnv):
    """`StabilityEnv` in one of highway-env's road networks, with other vehicles.

    By default the vehicle ahead brakes hard on a wet road, and a late driver swerves around it into
    the free lane and back; the yaw moment decides whether that ends in a collision, off the road,
    or well. Action, observation, record, reward, info and estimators are those of `StabilityEnv`;
    camera, driver and the record's curvature see the lane that our car follows, which begins as its
    own and stays so while the driver swerves. Needs the extra `highway`.

    ## Episode end
    `terminated` also by a "collision", or a "departure" of the whole car beyond the road's edge,
    charged as every failure is.

    ## Arguments
    road: "straight", "curved" (bends of 400 m) or "merging" (others join from a ramp). hazard:
    fields of `Hazard`, {} for the usual ones, None for no vehicle that brakes. traffic: how many
    vehicles besides, of highway-env's IDM. The others are those of `StabilityEnv`. The scenario has
    a driver where there is a hazard; bank and grade are there from the beginning.

    The seed draws on which side the free lane is, the hazard and the traffic from the episode's
    key, and highway-env's own random numbers come from there too. The road is stepped every 50 ms
    at the ticks' places of our car, whatever the control period.

    Raises ModuleNotFoundError without highway-env, ValueError for an unknown road, a number of
    vehicles out of place, a scenario with a road of its own or of small angles, one without a
    driver beside a hazard, and a start off the road's own (reset option state: s, theta, X, Y).
    """

    def __init__(
        self,
        road: str = "straight",
        hazard: Mapping[str, Any] | None = {},  # never written
        traffic: int = 3,
        sensors: str = "fusion",
        scenario: ScenarioSource = "wet-evasion",
        vehicle: VehicleSource = "passenger-car",
        reference: str = "lagged",
        **options: Any,
    ) -> None:
        check_choice("road", road, ROADS)
        self.road, self.hazard = road, hazard_from(hazard)
        self.traffic = count_of("traffic", traffic, "vehicles", 0, MOST)
        on_road = self._on_road(scenario_from(scenario))
        super().__init__(sensors, on_road, vehicle, reference=reference, **options)
        self._around: Traffic | None = None

    def _on_road(self, scenario: Scenario) -> Scenario:
        """The scenario with its bank and grade from the beginning; ValueError where it has more of
        a road, or nobody to swerve."""
        defaults = Scenario(name="")
        for field in _OURS:
            if (value := getattr(scenario, field)) != getattr(defaults, field):
                raise ValueError(
                    f"scenario {scenario.name!r}: {field} {value!r} is of our own roads; here the "
                    "road is highway-env's, whose bends are driven at any angle"
                )
        if self.hazard is not None and scenario.steering != "driver":
            raise ValueError(
                f"scenario {scenario.name!r}: steering {scenario.steering!r} swerves around "
                "nothing; a hazard takes 'driver', or hazard=None"
            )
        return scenario.replace(curve_start=-1000.0, curve_ramp=1.0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see `StabilityEnv`."""
        asked = dict(options or {})
        if "scenario" in asked:
            asked["scenario"] = self._on_road(scenario_from(asked["scenario"]))
        state = asked.get("state", {})
        if isinstance(state, Mapping):
            if off := [name for name in _PLACE if name in state]:
                raise ValueError(f"reset option state: {off[0]} is where the road begins; y may be")
            if "y" in state:
                asked["state"] = {**state, "Y": state["y"]}
        return super().reset(seed=seed, options=asked)

    def _begin(self) -> None:
        """The road, the vehicles on it, and the driver's path around the one that brakes."""
        p, z = self._params, self._state
        friction = 0.5 * float(p[P.car.mu] + p[P.car.mu_r])
        start = Start(self._now.vehicle, self.motion, float(p[P.pace.speed]), friction)
        key = int(z[Z.clock.key_low]) | int(z[Z.clock.key_high]) << 32
        self._around = Traffic(self.road, start, self.hazard, self.traffic, key)
        if self._around.path is not None:
            p[list(P.path)] = self._around.path
        super()._begin()

    def _advance(self, force: npt.NDArray[np.float32]) -> int:
        """One control period of our car on the lane as it is here, then the road's steps in it."""
        around, p, z = self._around, self._params, self._state
        assert around is not None
        here = around.place(self.motion)
        z[Z.motion.y], z[Z.motion.theta] = here.y, here.theta
        p[P.road.curvature] = here.curvature
        first = int(z[Z.clock.tick])
        done = super()._advance(force)
        running = done > 0 and self._report[REPORT.failure] == RUNNING
        for tick in range(first + 1, first + done + 1) if running else ():
            if tick % PERIOD == 0:
                around.follow(read(self._window, WINDOW.track, tick - first - 1))
        if running and (around.crashed or around.departed):
            self._fail(COLLISION if around.crashed else DEPARTURE)
        return done

    def _fail(self, failure: int) -> None:
        """End the episode, the rest of it charged."""
        z, report = self._state, self._report
        z[Z.clock.failure] = report[REPORT.failure] = failure
        report[REPORT.cost] += rest_of_cost(self._params[P.task.duration], z[Z.clock.tick])
        report[REPORT.reward] = -report[REPORT.cost]

    def shot(self, row: int = 0) -> Shot:
        """What a picture is drawn from, its road by highway-env's own graphics."""
        return super().shot(row)._replace(world=self._world)

    def _world(self, size: tuple[int, int], others: list[Motion]) -> Any:
        """The road around our car as highway-env draws it, and others of ours as shadows on it."""
        import pygame
        from highway_env.road.graphics import RoadGraphics, WorldSurface
        from highway_env.vehicle.graphics import VehicleGraphics

        assert self._around is not None
        road, ours = self._around.road, self._around.ours
        world = WorldSurface(size, 0, pygame.Surface(size))
        world.scaling, world.centering_position = 10.0, [0.3, 0.5]
        ours.put(self.motion)
        world.move_display_window_to(ours.position)
        RoadGraphics.display(road, world)
        RoadGraphics.display_road_objects(road, world, offscreen=True)
        for motion in others:
            shadow = copy.copy(ours)
            shadow.put(motion)
            shadow.color = (170, 170, 170)
            VehicleGraphics.display(shadow, world, offscreen=True)
        RoadGraphics.display_traffic(road, world, offscreen=True)
        return world

    def get_state(self) -> dict[str, Any]:
        """A snapshot that `set_state` continues from, bit for bit, traffic included."""
        return super().get_state() | {"road": self.road, "around": copy.deepcopy(self._around)}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Go back to a snapshot of this env or of one built with the same arguments."""
        if snapshot.get("road") != self.road:
            raise ValueError(f"the snapshot is of road {snapshot.get('road')!r}, not {self.road!r}")
        super().set_state(snapshot)
        self._around = copy.deepcopy(snapshot["around"])
