"""From the public description (vehicle, scenario, sensors) to the kernel's packed numbers."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arguments import brief, check_choice
from ..record import Array
from ..scenarios.driver import Driver
from ..scenarios.roads import ROADS
from ..scenarios.scenario import Scenario
from ..scenarios.speed import Pace
from ..scenarios.steering import STEERING_KINDS, STEERING_WIDTH
from ..scenarios.tracks import path_of
from ..scenarios.wind import Wind
from ..sensors.camera import View
from ..sensors.gps import HDOP_LAWS, Sky
from ..sensors.link import Link, SlowSensor, link_of
from ..sensors.noise import Noise
from ..sensors.slow import SLOW_NAMES
from ..task.reference import REFERENCES, target_of
from ..ticks import FOREVER, TICK, ticks
from ..vehicle.actuators import lag_of
from ..vehicle.dynamics import Car, Motion, Road
from ..vehicle.linear import Bicycle
from ..vehicle.tyres import TYRE_LAWS
from ..vehicle.vehicle import GRAVITY, Vehicle
from .arrays import Start
from .layout import PARAMS_WIDTH, Change, Disturbance, Params, Switches, Task

SPIN_ANGLE = 0.5  # rad of sideslip: the car has spun


@dataclass(frozen=True)
class EpisodeConfig:
    """An episode before its draws.

    start: what a reset starts from, packed. vehicle, nominal: with the scenario's replacements.
    held_speed: m/s, where it is one number and held exactly.
    """

    start: Start
    vehicle: Vehicle
    nominal: Vehicle
    scenario: Scenario
    slow: dict[str, SlowSensor]
    held_speed: float | None


def car_of(vehicle: Vehicle) -> Car:
    """The plant's parameters of a vehicle."""
    return Car(
        m=vehicle.mass,
        I=vehicle.yaw_inertia,
        l_f=vehicle.front_arm,
        l_r=vehicle.rear_arm,
        C_f=vehicle.front_stiffness,
        C_r=vehicle.rear_stiffness,
        d_f=vehicle.front_track,
        d_r=vehicle.rear_track,
        r=vehicle.wheel_radius,
        T_max=vehicle.motor_torque,
        mu=vehicle.friction,
        l_pre=vehicle.preview,
        S=vehicle.roll_moment_arm,
        I_x=vehicle.roll_inertia,
        K_x=vehicle.roll_stiffness,
        C_x=vehicle.roll_damping,
        h=vehicle.gravity_height,
        ahead=vehicle.antenna_ahead,
        left=vehicle.antenna_left,
        mu_r=vehicle.friction,
        P=vehicle.motor_power,
        h_x=vehicle.transfer_height,
    )


def task_of(vehicle: Vehicle, scenario: Scenario, yaw_first: bool) -> Task:
    """The episode's length and limits."""
    return Task(
        duration=ticks(scenario.duration),
        half_width=scenario.half_width,
        yaw_scale=vehicle.yaw_moment_limit,
        yaw_first=float(yaw_first),
        spin=SPIN_ANGLE,
        authority=vehicle.steering_authority,
        slew=vehicle.steering_rate * TICK,
        stop=vehicle.steering_stop,
    )


def _pace_of(scenario: Scenario) -> Pace:
    """The driver's work along the road; the speed itself is drawn."""
    pace = Pace(speed=0.0, hold=1.0, acceleration=0.0, start=0.0, end=FOREVER, k_p=2.0, k_i=0.5)
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


def _link_in(scenario: Scenario, name: str, sensor: SlowSensor | None) -> Link:
    try:
        return link_of(sensor, getattr(scenario, f"{name}_outage", None))
    except ValueError as error:
        raise ValueError(f"scenario {brief(scenario.name)}: {name}: {error}") from None


def _road_of(scenario: Scenario) -> Road:
    """The road but for its curvature and bank, which are drawn."""
    return Road(
        curvature=0.0,
        start=scenario.curve_start,
        ramp=scenario.curve_ramp,
        across=0.0,
        along=GRAVITY * math.sin(scenario.grade),
    )


def _sky_of(scenario: Scenario, link: Link) -> Sky:
    """The satellites of a scenario, at the GPS's own period."""
    keep = math.exp(-link.period * TICK / scenario.hdop_time)
    return Sky(
        median=math.log(scenario.hdop),
        spread=scenario.hdop_spread,
        keep=keep,
        fresh=math.sqrt(1.0 - keep * keep),
        weight=HDOP_LAWS[scenario.hdop_law],
    )


def _numbers(part: Any) -> list[float]:
    """The numbers of nested tuples, in order."""
    if not isinstance(part, tuple):
        return [part]
    return [number for each in part for number in _numbers(each)]


def _trace_of(scenario: Scenario) -> list[float]:
    """What `steering.trace_at` reads, behind the packed parameters."""
    trace = scenario.trace
    return [scenario.trace_step / TICK, *trace, trace[-1]] if trace else []


def widened(params: Array, width: int) -> Array:
    """Packed parameters as long as with a longer trace: the last angle stays, none stays none."""
    traced = len(params) > PARAMS_WIDTH
    return np.pad(params, (0, width - len(params)), "edge" if traced else "constant")


def episode_config(
    scenario: Scenario,
    vehicle: Vehicle,
    nominal: Vehicle,
    slow: dict[str, SlowSensor],
    reference: str,
    motion: Array | None = None,
    all_samples: bool = False,
    with_map: bool = False,
    yaw_first: bool = True,
    fail_bad: bool = False,
) -> EpisodeConfig:
    """Pack everything that a reset does not draw; ValueError where something is out of place.

    motion: (len(Motion),), where the car starts, NaN for the default (None: of all).
    """
    check_choice("reference", reference, REFERENCES)
    vehicle = vehicle.replace(**scenario.vehicle)
    nominal = nominal.replace(**scenario.nominal)
    if scenario.roll:
        vehicle.check_roll()
    keep = math.exp(-TICK / scenario.disturbance_time)
    links = {name: _link_in(scenario, name, slow.get(name)) for name in SLOW_NAMES}
    params = Params(
        car=car_of(vehicle),
        road=_road_of(scenario),
        motor=lag_of(vehicle.motor_lag if scenario.lags else 0.0, TICK),
        steering=lag_of(vehicle.steering_lag if scenario.lags else 0.0, TICK),
        wind=Wind(0.0, 0.0, 0.0, 0.0, scenario.wind_height),  # the rest is drawn
        pace=_pace_of(scenario),
        noise=Noise()._replace(**scenario.noise),
        slow=tuple(links.values()),
        target=target_of(nominal),
        disturbance=Disturbance(
            force=scenario.disturbance_force,
            moment=scenario.disturbance_moment,
            keep=keep,
            fresh=math.sqrt(1.0 - keep * keep),
        ),
        task=task_of(vehicle, scenario, yaw_first),
        programme=(0.0,) * STEERING_WIDTH,  # drawn
        sky=_sky_of(scenario, links["gps"]),
        driver=Driver(
            preview=scenario.driver_preview,
            gain=scenario.driver_gain,
            rest=lag_of(scenario.driver_lag, TICK).end,
            slew=scenario.driver_rate * TICK,
        ),
        path=path_of(scenario.path, vehicle.width),
        change=Change(FOREVER, 1.0, 1.0),  # drawn
        sight=View(scenario.camera_heading, scenario.camera_offset),
        leader=Bicycle(*nominal.lateral),
    )
    switches = Switches(
        small_angle=int(scenario.small_angle),
        law=TYRE_LAWS.index(scenario.tyres),
        reference=REFERENCES.index(reference),
        steering=STEERING_KINDS.index(scenario.steering),
        all_samples=int(all_samples),
        with_map=int(with_map),
        fail_bad=int(fail_bad),
        roll=int(scenario.roll),
        road=ROADS.index(scenario.road),
    )
    low, high = scenario.draws()
    start = Start(
        params=np.array(_numbers(params) + _trace_of(scenario), np.float64),
        low=low,
        high=high,
        switches=np.array(switches, np.int64),
        motion=np.full(len(Motion._fields), np.nan) if motion is None else motion,
    )
    assert len(start.params) == PARAMS_WIDTH or scenario.trace
    held = scenario.held_speed if np.isnan(start.motion[0]) else None  # or it starts at another
    return EpisodeConfig(start, vehicle, nominal, scenario, slow, held)
