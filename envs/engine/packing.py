"""From the public description (vehicle, scenario, sensors) to the kernel's packed numbers."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..record import Array, SlowSensor
from ..scenarios.driver import Driver
from ..scenarios.scenario import Scenario
from ..scenarios.speed import Pace
from ..scenarios.steering import STEERING_KINDS, STEERING_WIDTH
from ..scenarios.tracks import path_of
from ..scenarios.wind import Wind
from ..sensors.gps import HDOP_LAWS, Sky
from ..sensors.link import Link, link_of
from ..sensors.noise import Noise
from ..task.reference import REFERENCES, target_of
from ..ticks import FOREVER, TICK, ticks
from ..vehicle.actuators import lag_of
from ..vehicle.dynamics import Car, Road
from ..vehicle.tyres import TYRE_LAWS
from ..vehicle.vehicle import GRAVITY, Vehicle
from .layout import Change, Disturbance, P, Switches, Task

SPIN_ANGLE = 0.5  # rad of sideslip: the car has spun


@dataclass(frozen=True)
class Template:
    """What a reset starts from.

    params: (P.end,) packed parameters. low, high: (len(Draws),) ranges. switches:
    (len(Switches),) int64.
    vehicle, nominal: with the scenario's replacements. held_speed: m/s, where it is one number
    and held exactly. duration: ticks.
    """

    params: Array
    low: Array
    high: Array
    switches: npt.NDArray[np.int64]
    vehicle: Vehicle
    nominal: Vehicle
    scenario: Scenario
    slow: dict[str, SlowSensor]
    held_speed: float | None

    @property
    def duration(self) -> int:
        """Ticks of an episode."""
        return int(self.params[P.task])


def car_of(vehicle: Vehicle) -> Car:
    """The plant's parameters of a vehicle."""
    return Car(
        vehicle.mass,
        vehicle.yaw_inertia,
        vehicle.front_arm,
        vehicle.rear_arm,
        vehicle.front_stiffness,
        vehicle.rear_stiffness,
        vehicle.front_track,
        vehicle.rear_track,
        vehicle.wheel_radius,
        vehicle.motor_torque,
        vehicle.friction,
        vehicle.preview,
        vehicle.roll_moment_arm,
        vehicle.roll_inertia,
        vehicle.roll_stiffness,
        vehicle.roll_damping,
        vehicle.gravity_height,
        vehicle.antenna_ahead,
        vehicle.antenna_left,
        vehicle.friction,
    )


def _pace_of(scenario: Scenario) -> Pace:
    """The driver's work along the road; the speed itself is drawn."""
    pace = Pace(0.0, 1.0, 0.0, 0.0, FOREVER, 2.0, 0.5)
    if scenario.acceleration is not None:
        return pace._replace(hold=0.0, acceleration=scenario.acceleration)
    if scenario.speed_change:
        start = ticks(scenario.change_start)
        pace = pace._replace(
            acceleration=scenario.speed_change / scenario.change_length,
            start=start,
            end=start + ticks(scenario.change_length),
        )
    return pace._replace(surge=scenario.surge, surge_rate=math.tau * scenario.surge_frequency)


def _road_of(scenario: Scenario) -> Road:
    """Curvature, bank and grade of the road."""
    return Road(
        0.0,  # drawn
        scenario.curve_start,
        scenario.curve_ramp,
        GRAVITY * math.sin(scenario.bank),
        GRAVITY * math.sin(scenario.grade),
    )


def _sky_of(scenario: Scenario, link: Link) -> Sky:
    """The satellites of a scenario, at the GPS's own period."""
    keep = math.exp(-link.period * TICK / scenario.hdop_time)
    return Sky(
        math.log(scenario.hdop),
        scenario.hdop_spread,
        keep,
        math.sqrt(1.0 - keep * keep),
        HDOP_LAWS[scenario.hdop_law],
    )


def template_of(
    scenario: Scenario,
    vehicle: Vehicle,
    nominal: Vehicle,
    slow: dict[str, SlowSensor],
    reference: str,
    all_samples: bool = False,
    yaw_first: bool = True,
    fail_bad: bool = False,
) -> Template:
    """Pack everything that a reset does not draw; ValueError where something is out of place."""
    if reference not in REFERENCES:
        raise ValueError(f"unknown reference {reference!r}; known: {', '.join(REFERENCES)}")
    vehicle = vehicle.replace(**scenario.vehicle)
    nominal = nominal.replace(**scenario.nominal)
    if scenario.roll:
        vehicle.check_roll()
    keep = math.exp(-TICK / scenario.disturbance_time)
    gps = link_of(slow.get("gps"), scenario.gps_outage)
    parts = (
        car_of(vehicle),
        _road_of(scenario),
        lag_of(vehicle.motor_lag if scenario.lags else 0.0, TICK),
        lag_of(vehicle.steering_lag if scenario.lags else 0.0, TICK),
        Wind(0.0, 0.0, 0.0, 0.0, scenario.wind_height),  # the rest is drawn
        _pace_of(scenario),
        Noise()._replace(**scenario.noise),
        link_of(slow.get("camera"), scenario.camera_outage),
        gps,
        target_of(nominal),
        Disturbance(
            scenario.disturbance_force,
            scenario.disturbance_moment,
            keep,
            math.sqrt(1.0 - keep * keep),
        ),
        Task(
            ticks(scenario.duration),
            scenario.half_width,
            vehicle.yaw_moment_limit,
            float(yaw_first),
            SPIN_ANGLE,
            vehicle.steering_authority,
            vehicle.steering_rate * TICK,
            vehicle.steering_stop,
        ),
        (0.0,) * STEERING_WIDTH,
        _sky_of(scenario, gps),
        Driver(
            scenario.driver_preview,
            scenario.driver_gain,
            lag_of(scenario.driver_lag, TICK).end,
            scenario.driver_rate * TICK,
        ),
        path_of(scenario.path, vehicle.width),
        Change(FOREVER, 1.0, 1.0),  # drawn
    )
    params = np.array([value for part in parts for value in part], dtype=np.float64)
    assert len(params) == P.end
    low, high = scenario.draws()
    switches = Switches(
        int(scenario.small_angle),
        TYRE_LAWS.index(scenario.tyres),
        REFERENCES.index(reference),
        STEERING_KINDS.index(scenario.steering),
        int(all_samples),
        int(fail_bad),
        int(scenario.roll),
    )
    packed = np.array(switches, dtype=np.int64)
    held = scenario.held_speed
    return Template(params, low, high, packed, vehicle, nominal, scenario, slow, held)
