"""From the public description (vehicle, scenario, sensors) to the kernel's packed numbers."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .actuators import lag_of
from .dynamics import FIALA, LINEAR, Car, Road
from .layout import Array, Disturbance, P, Task
from .programme import FOREVER, STEERING_KINDS, STEERING_WIDTH, Pace
from .record import TICK, SlowSensor
from .reference import REFERENCES, target_of
from .scenario import Scenario
from .sensors import Noise, link_of, ticks
from .switches import Switches
from .vehicle import Vehicle

SPIN_ANGLE = 0.5  # rad of sideslip: the car has spun


@dataclass(frozen=True)
class Template:
    """What a reset starts from.

    params: (P.end,) packed parameters. low, high: (len(Draws),) ranges. switches: (6,) int64.
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
    keep = math.exp(-TICK / scenario.disturbance_time)
    pace = Pace(
        0.0,
        1.0 if scenario.acceleration is None else 0.0,
        scenario.acceleration or 0.0,
        0.0,
        FOREVER,
        2.0,
        0.5,
    )
    parts = (
        car_of(vehicle),
        Road(scenario.curvature, scenario.curve_start, scenario.curve_ramp),
        lag_of(vehicle.motor_lag if scenario.lags else 0.0, TICK),
        lag_of(vehicle.steering_lag if scenario.lags else 0.0, TICK),
        (0.0, 0.0, 0.0, 0.0),  # the wind is drawn
        pace,
        Noise()._replace(**scenario.noise),
        link_of(slow.get("camera"), scenario.camera_outage),
        link_of(slow.get("gps"), scenario.gps_outage),
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
    )
    params = np.array([value for part in parts for value in part], dtype=np.float64)
    assert len(params) == P.end
    low, high = scenario.draws()
    switches = Switches(
        int(scenario.small_angle),
        LINEAR if scenario.linear_tyres else FIALA,
        REFERENCES.index(reference),
        STEERING_KINDS.index(scenario.steering),
        int(all_samples),
        int(fail_bad),
    )
    packed = np.array(switches, dtype=np.int64)
    held = scenario.held_speed
    return Template(params, low, high, packed, vehicle, nominal, scenario, slow, held)
