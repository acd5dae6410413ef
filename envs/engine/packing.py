"""From the public description (vehicle, scenario, sensors) to the kernel's packed numbers."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arguments import check_choice, short_repr
from ..record import Array
from ..scenarios.driver import DriverParams
from ..scenarios.roads import ROADS
from ..scenarios.scenario import Scenario
from ..scenarios.speed import SpeedProfile
from ..scenarios.steering import STEERING_KINDS, STEERING_WIDTH
from ..scenarios.tracks import make_path
from ..scenarios.wind import Wind
from ..sensors.camera import FieldOfView
from ..sensors.gps import HDOP_LAWS, SatelliteGeometry
from ..sensors.link import Link, SlowSensor, make_link
from ..sensors.noise import Noise
from ..sensors.slow import SLOW_NAMES
from ..task.reference import REFERENCES, make_reference_params
from ..ticks import FOREVER, TICK, count_ticks
from ..vehicle.actuators import make_lag
from ..vehicle.dynamics import CarParams, Motion, RoadParams
from ..vehicle.linear import Bicycle
from ..vehicle.tyres import TYRE_LAWS
from ..vehicle.vehicle import GRAVITY, Vehicle
from .arrays import EpisodeStart
from .layout import PARAMS_WIDTH, Disturbance, EpisodeParams, Switches, TaskParams, TyreChange

SPIN_ANGLE = 0.5  # rad of sideslip: the car has spun


@dataclass(frozen=True)
class EpisodeConfig:
    """An episode before its draws.

    start: what a reset starts from, packed. vehicle, nominal: with the scenario's replacements.
    held_speed: m/s, where it is one number and held exactly.
    """

    start: EpisodeStart
    vehicle: Vehicle
    nominal: Vehicle
    scenario: Scenario
    slow: dict[str, SlowSensor]
    held_speed: float | None


def make_car(vehicle: Vehicle) -> CarParams:
    """The plant's parameters of a vehicle."""
    return CarParams(
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
        forward=vehicle.antenna_ahead,
        left=vehicle.antenna_left,
        mu_r=vehicle.friction,
        P=vehicle.motor_power,
        h_x=vehicle.transfer_height,
    )


def make_task_params(vehicle: Vehicle, scenario: Scenario, yaw_first: bool) -> TaskParams:
    """The episode's length and limits."""
    return TaskParams(
        duration=count_ticks(scenario.duration),
        half_width=scenario.half_width,
        yaw_scale=vehicle.yaw_moment_limit,
        yaw_first=float(yaw_first),
        spin=SPIN_ANGLE,
        authority=vehicle.steering_authority,
        slew=vehicle.steering_rate * TICK,
        stop=vehicle.steering_stop,
    )


def _make_speed_profile(scenario: Scenario) -> SpeedProfile:
    """The driver's work along the road; the speed itself is drawn."""
    profile = SpeedProfile(
        speed=0.0, hold=1.0, acceleration=0.0, start=0.0, end=FOREVER, k_p=2.0, k_i=0.5
    )
    if scenario.acceleration is not None:
        return profile._replace(hold=0.0, acceleration=scenario.acceleration)
    if scenario.speed_change:
        start = count_ticks(scenario.change_start)
        profile = profile._replace(
            acceleration=scenario.speed_change / scenario.change_length,
            start=start,
            end=start + count_ticks(scenario.change_length),
        )
    return profile._replace(surge=scenario.surge, surge_rate=math.tau * scenario.surge_frequency)


def _make_link(scenario: Scenario, name: str, sensor: SlowSensor | None) -> Link:
    try:
        return make_link(sensor, getattr(scenario, f"{name}_outage", None))
    except ValueError as error:
        raise ValueError(f"scenario {short_repr(scenario.name)}: {name}: {error}") from None


def _make_road(scenario: Scenario) -> RoadParams:
    """The road but for its curvature and bank, which are drawn."""
    return RoadParams(
        curvature=0.0,
        start=scenario.curve_start,
        ramp=scenario.curve_ramp,
        lateral=0.0,
        longitudinal=GRAVITY * math.sin(scenario.grade),
    )


def _make_satellite_geometry(scenario: Scenario, link: Link) -> SatelliteGeometry:
    """The satellites of a scenario, at the GPS's own period."""
    decay = math.exp(-link.period * TICK / scenario.hdop_time)
    return SatelliteGeometry(
        median=math.log(scenario.hdop),
        spread=scenario.hdop_spread,
        decay=decay,
        noise_gain=math.sqrt(1.0 - decay * decay),
        weight=HDOP_LAWS[scenario.hdop_law],
    )


def _list_numbers(part: Any) -> list[float]:
    """The numbers of nested tuples, in order."""
    if not isinstance(part, tuple):
        return [part]
    return [number for item in part for number in _list_numbers(item)]


def _make_trace(scenario: Scenario) -> list[float]:
    """What `steering.interpolate_trace` reads, behind the packed parameters."""
    trace = scenario.trace
    return [scenario.trace_step / TICK, *trace, trace[-1]] if trace else []


def pad_params(params: Array, width: int) -> Array:
    """Packed parameters as long as with a longer trace: the last angle stays, none stays none."""
    has_trace = len(params) > PARAMS_WIDTH
    return np.pad(params, (0, width - len(params)), "edge" if has_trace else "constant")


def make_episode_config(
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
    decay = math.exp(-TICK / scenario.disturbance_time)
    links = {name: _make_link(scenario, name, slow.get(name)) for name in SLOW_NAMES}
    params = EpisodeParams(
        car=make_car(vehicle),
        road=_make_road(scenario),
        motor=make_lag(vehicle.motor_lag if scenario.lags else 0.0, TICK),
        steering=make_lag(vehicle.steering_lag if scenario.lags else 0.0, TICK),
        wind=Wind(0.0, 0.0, 0.0, 0.0, scenario.wind_height),  # the rest is drawn
        speed_profile=_make_speed_profile(scenario),
        noise=Noise()._replace(**scenario.noise),
        slow=tuple(links.values()),
        target=make_reference_params(nominal),
        disturbance=Disturbance(
            force=scenario.disturbance_force,
            moment=scenario.disturbance_moment,
            decay=decay,
            noise_gain=math.sqrt(1.0 - decay * decay),
        ),
        task=make_task_params(vehicle, scenario, yaw_first),
        steering_profile=(0.0,) * STEERING_WIDTH,  # drawn
        sky=_make_satellite_geometry(scenario, links["gps"]),
        driver=DriverParams(
            preview=scenario.driver_preview,
            gain=scenario.driver_gain,
            rest=make_lag(scenario.driver_lag, TICK).end,
            slew=scenario.driver_rate * TICK,
        ),
        path=make_path(scenario.path, vehicle.width),
        tyre_change=TyreChange(FOREVER, 1.0, 1.0),  # drawn
        field_of_view=FieldOfView(scenario.camera_heading, scenario.camera_offset),
        nominal_car=Bicycle(*nominal.lateral),
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
    low, high = scenario.get_draw_ranges()
    start = EpisodeStart(
        params=np.array(_list_numbers(params) + _make_trace(scenario), np.float64),
        low=low,
        high=high,
        switches=np.array(switches, np.int64),
        motion=np.full(len(Motion._fields), np.nan) if motion is None else motion,
    )
    assert len(start.params) == PARAMS_WIDTH or scenario.trace
    held_speed = (
        scenario.held_speed if np.isnan(start.motion[0]) else None
    )  # or it starts at another
    return EpisodeConfig(start, vehicle, nominal, scenario, slow, held_speed)
