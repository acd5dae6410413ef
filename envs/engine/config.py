"""Configuration of an environment, checked, and of an episode, packed for the kernels."""

import copy
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from ..numerics.functions import FOREVER, TICK, count_ticks
from ..record import FAST_WIDTH, PACKET_WIDTH, Array
from ..scenarios.driver import STEERING_KINDS, STEERING_WIDTH, DriverParams, SpeedProfile, Wind
from ..scenarios.manoeuvres import make_scenario
from ..scenarios.road import ROADS, make_path
from ..scenarios.scenario import MIN_GPS_PERIOD, Scenario
from ..scenarios.world import IDEAL, World, get_range
from ..sensors.inertial import IDEAL_SENSORS, Noise
from ..sensors.link import MAX_IN_FLIGHT, Link, SlowSensor, make_link
from ..sensors.slow import (
    DELAYS,
    HDOP_LAWS,
    MAX_DELAY,
    SENSOR_SETS,
    SLOW_NAMES,
    VISIONS,
    FieldOfView,
    SatelliteGeometry,
    apply_changes,
    count_delay_ticks,
    load_detector,
)
from ..task import (
    REFERENCES,
    REPORT,
    ObservationEntry,
    make_observation_layout,
    make_reference_params,
    make_space,
)
from ..validation import (
    check_choice,
    check_int,
    check_mapping,
    check_number,
    check_plausible,
    describe_unknown,
    is_finite,
    join_names,
    short_repr,
)
from ..vehicle.actuators import make_lag
from ..vehicle.dynamics import CarParams, Motion, RoadParams
from ..vehicle.linear import Bicycle
from ..vehicle.parameters import GRAVITY, Vehicle, make_vehicle
from ..vehicle.tyres import TYRE_LAWS
from .layout import (
    FLAGS,
    PARAMS_WIDTH,
    STATE_WIDTH,
    Disturbance,
    EpisodeArrays,
    EpisodeConfig,
    EpisodeParams,
    EpisodeStart,
    FrictionWave,
    Switches,
    TaskParams,
    TyreChange,
)
from .window import make_window

_SPIN_ANGLE = 0.5  # rad of sideslip: the car has spun


_SlowChanges = Mapping[str, Mapping[str, Any] | None]  # by name, as `apply_changes` takes them


def make_car(vehicle: Vehicle) -> CarParams:
    """Make the plant's parameters of a vehicle.

    Args:
        vehicle: Vehicle whose parameters are taken.
    """
    return CarParams(
        m=vehicle.mass, I=vehicle.yaw_inertia, l_f=vehicle.front_arm, l_r=vehicle.rear_arm,
        C_f=vehicle.front_stiffness, C_r=vehicle.rear_stiffness, d_f=vehicle.front_track,
        d_r=vehicle.rear_track, r=vehicle.wheel_radius, T_max=vehicle.motor_torque,
        mu=vehicle.friction, l_pre=vehicle.preview, S=vehicle.roll_moment_arm,
        I_x=vehicle.roll_inertia, K_x=vehicle.roll_stiffness, C_x=vehicle.roll_damping,
        h=vehicle.gravity_height, forward=vehicle.antenna_ahead, left=vehicle.antenna_left,
        mu_r=vehicle.friction, P=vehicle.motor_power, h_x=vehicle.transfer_height, k_l=1.0, k_r=1.0,
        relaxation=vehicle.relaxation,
    )  # fmt: skip


def make_task_params(
    vehicle: Vehicle, scenario: Scenario, yaw_first: bool, lead_in: float = 0.0,
    world: World = IDEAL,
) -> TaskParams:  # fmt: skip
    """Make the episode's length and limits.

    Args:
        vehicle: The true vehicle.
        scenario: Scenario with the duration and the limits.
        yaw_first: Whether the yaw moment comes before acceleration.
        lead_in: Ticks before the manoeuvre.
        world: World with the cost of the yaw moment's rate.
    """
    return TaskParams(
        duration=lead_in + count_ticks(scenario.duration), half_width=scenario.half_width,
        yaw_scale=vehicle.yaw_moment_limit, yaw_first=float(yaw_first), spin=_SPIN_ANGLE,
        authority=vehicle.steering_authority, slew=vehicle.steering_rate * TICK,
        stop=vehicle.steering_stop, torque_slew=0.0, lead_in=lead_in, moment_rate=world.moment_rate,
    )  # fmt: skip


def _make_speed_profile(scenario: Scenario, lead_in: float) -> SpeedProfile:
    """Make the driver's speed profile behind a lead-in (ticks); the speed itself is drawn."""
    profile = SpeedProfile(
        speed=0.0, hold=1.0, acceleration=0.0, start=0.0, end=FOREVER, k_p=2.0, k_i=0.5
    )
    if scenario.acceleration is not None:
        return profile._replace(hold=0.0, acceleration=scenario.acceleration)
    if scenario.speed_change:
        start, length = scenario.change_start, scenario.change_length
        rate, tick = scenario.speed_change / length, lead_in + count_ticks(start)
        profile = profile._replace(acceleration=rate, start=tick, end=tick + count_ticks(length))
    return profile._replace(surge=scenario.surge, surge_rate=math.tau * scenario.surge_frequency)


def _make_link(
    scenario: Scenario, name: str, sensor: SlowSensor | None, lead_in: float, world: World
) -> Link:
    """Make a slow sensor's link with the scenario's outage behind a lead-in (ticks)."""
    try:
        outage = getattr(scenario, f"{name}_outage", None)
        if outage is not None:
            outage = tuple(time + lead_in * TICK for time in outage)
        max_stamp = get_range(world.gps_stamp)[1] if name == "gps" else 0.0
        return make_link(sensor, outage, max_stamp)
    except ValueError as error:
        raise ValueError(f"scenario {short_repr(scenario.name)}: {name}: {error}") from None


def _compute_gains(exponent: float) -> tuple[float, float]:
    """Compute (decay, noise gain) of an Ornstein-Uhlenbeck process over a step."""
    decay = math.exp(exponent)
    return decay, math.sqrt(1.0 - decay * decay)


def _apply_scenario_clocks(
    sensors: dict[str, SlowSensor], scenario: Scenario, changes: _SlowChanges
) -> dict[str, SlowSensor]:
    """Replace clocks and delays of the sensors by the fields `<sensor>_...` of a scenario.

    The env's own changes to the sensors come over these, a drawn latency on top of both.
    """
    changed = {}
    for name, sensor in sensors.items():
        clock = {key: getattr(scenario, f"{name}_{key}", None) for key in ("period", "delays")}
        clock["loss"] = getattr(scenario, f"{name}_loss", 0.0) or None
        if clock["delays"] is not None:
            clock["jitter"] = getattr(scenario, f"{name}_jitter", 0.0)
        set_fields = {key: value for key, value in clock.items() if value is not None}
        sensor = dataclasses.replace(sensor, **set_fields)
        sensor = apply_changes({name: sensor}, {name: changes.get(name)})[name]
        low, high = map(count_ticks, get_range(getattr(scenario, f"{name}_latency", 0.0)))
        if high > 0.0:  # the worst case: the smallest latency as a delay, the rest as jitter
            delays = tuple(delay + low * TICK for delay in sensor.delays)
            jitter = sensor.jitter + (high - low) * TICK
            sensor = dataclasses.replace(sensor, delays=delays, jitter=jitter)
        changed[name] = sensor
    return changed


def _replace_parameters(car: Vehicle, changes: Mapping[str, float], tier: str) -> Vehicle:
    """Replace parameters by a scenario's; what a tier assumes yields to what a car states."""
    stated = {x for x in ("motor_power", "transfer_height") if tier and getattr(car, x) > 0.0}
    return car.replace(**{name: value for name, value in changes.items() if name not in stated})


def _check_later_start(scenario: Scenario) -> None:
    """Raise ValueError for a scenario whose manoeuvre cannot begin later."""
    starts = scenario.range("initial_beta") + scenario.range("initial_gamma")
    for holds, text in (
        (scenario.steering in ("trace", "wander"), f"steers by {scenario.steering} from 0 s on"),
        (scenario.acceleration is not None, "accelerates from 0 s on"),
        (bool(scenario.surge), "surges from 0 s on"),
        (any(starts), "begins with a slip or a yaw rate"),
    ):
        if holds:
            raise ValueError(f"lead_in: scenario {short_repr(scenario.name)} {text}")


def _apply_detector_clock(camera: SlowSensor, delay: str | None) -> SlowSensor:
    """Describe the delay of a camera with a detector by its range; it is a tick at least."""
    if delay == "link":
        if count_ticks(min(camera.delays)) < 1:
            raise ValueError("a picture takes a tick at least: camera delays of 0.001 s or more")
        return camera
    min_delay, max_delay = (TICK, MAX_DELAY) if delay == "measured" else load_detector().range
    first, last = count_delay_ticks(min_delay), count_delay_ticks(max_delay)
    return dataclasses.replace(camera, delays=(first * TICK,), jitter=(last - first) * TICK)


_RESET_OPTIONS = ("scenario", "vehicle", "friction", "state", "duration")


@dataclass(frozen=True)
class EnvConfig:
    """Arguments of an environment, as `StabilityEnv` describes them; errors name the argument."""

    sensors: str
    scenario: Scenario
    vehicle: Vehicle
    nominal: Vehicle
    control_period: int
    reference: str
    fast: str
    with_map: bool
    yaw_first: bool
    steering: bool
    on_bad_action: str
    vision: str
    delay: str | None
    strict: bool
    slow_changes: _SlowChanges
    world: World = IDEAL
    lead_in: float = 0.0  # s

    def __post_init__(self) -> None:
        copied = {
            name: copy.deepcopy(dict(x)) if isinstance(x, Mapping) else x
            for name, x in self.slow_changes.items()
        }
        object.__setattr__(self, "slow_changes", copied)
        check_choice("sensors", self.sensors, SENSOR_SETS)
        if unknown := [name for name in self.slow_changes if name not in SLOW_NAMES]:
            names = [entry.name for entry in dataclasses.fields(self)]
            known = [name for name in names if name != "slow_changes"]
            raise TypeError(describe_unknown("argument", unknown, [*known, *SLOW_NAMES]))
        check_int("control_period", self.control_period, "ticks", 1, 1000)
        for name in ("steering", "yaw_first", "with_map", "strict"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name} is True or False, got {short_repr(getattr(self, name))}")
        check_choice("fast", self.fast, ("summary", "all"))
        check_choice("on_bad_action", self.on_bad_action, ("raise", "fail"))
        check_choice("vision", self.vision, VISIONS)
        if self.vision == "image" and "camera" not in SENSOR_SETS[self.sensors]:
            raise ValueError(f"vision='image' needs a camera, and {self.sensors!r} has none")
        if not 0.0 <= check_number("lead_in", self.lead_in) <= 3600.0:
            raise ValueError(f"lead_in is 0 to 3600 s, got {self.lead_in!r}")
        if self.delay is not None:
            check_choice("delay", self.delay, DELAYS)
            if self.vision != "image":
                raise ValueError(f"delay={self.delay!r} is of pictures: vision='image'")

    @property
    def slow(self) -> dict[str, SlowSensor]:
        """The slow sensors by name, with the changes to the sensor set's."""
        return apply_changes(SENSOR_SETS[self.sensors], self.slow_changes)

    @cached_property
    def layout(self) -> tuple[ObservationEntry, ...]:
        """The entries of an observation."""
        kinds = int(self.control_period), self.fast, self.with_map
        return make_observation_layout(tuple(self.slow), *kinds)

    @cached_property
    def bounds(self) -> Array:
        """Bounds of the observation's entries, shape (2, len(layout))."""
        return np.array([[entry.low, entry.high] for entry in self.layout]).T.copy()

    @property
    def max_packets(self) -> int:
        """Largest number of packets in a step: its frames, doubled, and those under way before."""
        n = int(self.control_period)
        periods = [min(sensor.period, MIN_GPS_PERIOD) for sensor in self.slow.values()]
        return sum(2 * (n // int(count_ticks(period)) + 1) + MAX_IN_FLIGHT for period in periods)

    @property
    def action_width(self) -> int:
        """Width of an action."""
        return 2 if self.steering else 1

    def make_spaces(self) -> "tuple[gym.spaces.Box[np.float32], gym.spaces.Box[np.float32]]":
        """Make the spaces of observations and actions."""
        actions = gym.spaces.Box(-1.0, 1.0, (self.action_width,), np.float32)
        return make_space(self.layout), actions

    def make_arrays(self) -> EpisodeArrays:
        """Make the arrays of one car's episode, zeros but for the bounds."""
        n = int(self.control_period)
        switches, obs = np.zeros(len(FLAGS), np.int64), np.zeros(len(self.layout), np.float32)
        rows, packets = np.zeros((n, FAST_WIDTH)), np.zeros((self.max_packets, PACKET_WIDTH))
        report, window = np.zeros(len(REPORT)), make_window(n)
        p, z = np.zeros(PARAMS_WIDTH), np.zeros(STATE_WIDTH)
        return EpisodeArrays(p, z, switches, obs, rows, packets, report, self.bounds, window)

    @cached_property
    def base(self) -> EpisodeConfig:
        """An episode without options."""
        return self._make_episode(self.scenario, self.vehicle)

    def _make_episode(
        self, scenario: Scenario, vehicle: Vehicle, motion: Array | None = None
    ) -> EpisodeConfig:
        """Pack all that a reset does not draw; motion (len(Motion),) is NaN where it is default."""
        vehicle = _replace_parameters(vehicle, scenario.vehicle, scenario.tier)
        nominal = _replace_parameters(self.nominal, scenario.nominal, scenario.tier)
        world, n = self.world, int(self.control_period)
        if self.strict:
            for part in (scenario, vehicle, nominal, world):
                check_plausible(part)
        if self.lead_in:
            _check_later_start(scenario)
        lead_in = n * math.ceil(count_ticks(self.lead_in) / n)  # in whole steps
        slow = _apply_scenario_clocks(self.slow, scenario, self.slow_changes)
        if "gps" in slow and get_range(world.gps_stamp) != (0.0, 0.0):  # its clock is its own
            slow["gps"] = dataclasses.replace(slow["gps"], phase=None)
        if self.vision == "image":
            slow["camera"] = _apply_detector_clock(slow["camera"], self.delay)
            scenario = scenario.replace(noise={**scenario.noise, **load_detector().noise})
        check_choice("reference", self.reference, REFERENCES)
        if scenario.roll:
            vehicle.check_roll()
        links = {
            name: _make_link(scenario, name, slow.get(name), lead_in, world) for name in SLOW_NAMES
        }
        if "gps" in slow:  # the delays that packets seem to have whose stamps are off
            gps, (low_stamp, high_stamp) = slow["gps"], get_range(world.gps_stamp)
            delays = tuple(max(delay - high_stamp, 0.0) for delay in gps.delays)
            jitter = gps.jitter + (high_stamp - low_stamp)
            slow["gps"] = dataclasses.replace(gps, delays=delays, jitter=jitter)
        hdop_gains = _compute_gains(-links["gps"].period * TICK / scenario.hdop_time)
        gains = _compute_gains(-TICK / scenario.disturbance_time)
        params = EpisodeParams(
            car=make_car(vehicle),
            road=RoadParams(  # curvature and bank are drawn
                0.0, scenario.curve_start, scenario.curve_ramp, 0.0,
                GRAVITY * math.sin(scenario.grade),
            ),
            motor=make_lag(vehicle.motor_lag if scenario.lags else 0.0, TICK),
            steering=make_lag(vehicle.steering_lag if scenario.lags else 0.0, TICK),
            wind=Wind(0.0, 0.0, 0.0, 0.0, scenario.wind_height),  # the rest is drawn
            speed_profile=_make_speed_profile(scenario, lead_in),
            noise=Noise()._replace(**scenario.noise),
            slow=tuple(links.values()),
            target=make_reference_params(nominal),
            disturbance=Disturbance(
                scenario.disturbance_force, scenario.disturbance_moment, *gains
            ),
            task=make_task_params(vehicle, scenario, self.yaw_first, lead_in, world),
            steering_profile=(0.0,) * STEERING_WIDTH,  # drawn
            sky=SatelliteGeometry(
                math.log(scenario.hdop), scenario.hdop_spread, *hdop_gains,
                HDOP_LAWS[scenario.hdop_law],
            ),
            driver=DriverParams(
                preview=scenario.driver_preview, gain=scenario.driver_gain,
                rest=make_lag(scenario.driver_lag, TICK).end, slew=scenario.driver_rate * TICK,
            ),
            path=make_path(scenario.path, vehicle.width),
            tyre_change=TyreChange(FOREVER, 1.0, 1.0, 1.0),  # drawn
            field_of_view=FieldOfView(scenario.camera_heading, scenario.camera_offset),
            nominal_car=Bicycle(*nominal.lateral),
            errors=IDEAL_SENSORS,
            friction_wave=FrictionWave(0.0, 0.0, 0.0),  # drawn
        )  # fmt: skip
        switches = Switches(
            small_angle=int(scenario.small_angle),
            law=TYRE_LAWS.index(world.tyres or scenario.tyres),
            reference=REFERENCES.index(self.reference),
            steering=STEERING_KINDS.index(scenario.steering), all_samples=int(self.fast == "all"),
            with_map=int(self.with_map), fail_bad=int(self.on_bad_action == "fail"),
            roll=int(scenario.roll), road=ROADS.index(scenario.road),
            has_errors=int(not world.is_ideal),
        )  # fmt: skip
        low, high = scenario.get_draw_ranges(world)
        angles = scenario.trace  # as `steering.interpolate_trace` reads them
        trace = [scenario.trace_step / TICK, *angles, angles[-1]] if angles else []
        packed = np.concatenate([*map(np.ravel, params), trace])
        motion = np.full(len(Motion._fields), np.nan) if motion is None else motion
        start = EpisodeStart(packed, low, high, np.array(switches, np.int64), motion)
        assert len(start.params) == PARAMS_WIDTH or scenario.trace
        held_speed = scenario.held_speed if np.isnan(motion[0]) else None
        return EpisodeConfig(start, vehicle, nominal, scenario, slow, held_speed)

    def apply_options(self, options: Mapping[str, Any]) -> EpisodeConfig:
        """Make an episode with options of reset; ValueError for an unknown option or state.

        Args:
            options: Options by name, as `StabilityEnv` lists them.
        """
        if not options:
            return self.base
        if unknown := ", ".join(sorted(map(str, set(options) - set(_RESET_OPTIONS)))):
            known = ", ".join(_RESET_OPTIONS)
            raise ValueError(f"unknown reset option {unknown}; known: {known}")
        scenario = make_scenario(options.get("scenario", self.scenario))
        vehicle = make_vehicle(options.get("vehicle", self.vehicle), self.strict)
        for name in ("friction", "duration"):
            if name in options:
                number = check_number(f"reset option {name}", options[name])
                scenario = scenario.replace(**{name: number})
        motion = _parse_initial_motion(options.get("state", {}), scenario, vehicle, self.world)
        return self._make_episode(scenario, vehicle, motion)


def _parse_initial_motion(
    state: Mapping[str, Any], scenario: Scenario, vehicle: Vehicle, world: World
) -> Array:
    """Parse a start `Motion` (len(Motion),) from a mapping, NaN where it has no value."""
    remaining = dict(check_mapping("reset option state", state))
    start = np.full(len(Motion._fields), np.nan)
    relaxation = scenario.vehicle.get("relaxation", vehicle.relaxation)
    is_relaxing = (world.tyres or scenario.tyres) == "magic-formula" and relaxation > 0.0
    lacks = {"phi": "" if scenario.roll else "no roll"}
    lacks["slip"] = "" if is_relaxing else "no tyres that relax"
    for i, name in enumerate(Motion._fields):
        value = remaining.pop(name, None)
        if value is not None and not (is_finite(value) and abs(value) <= 1e6):
            got = short_repr(value)
            raise ValueError(f"reset option state: {name} is {got}, not a number up to 1e6")
        start[i] = np.nan if value is None else value
        if value and (lack := lacks.get(name.partition("_")[0])):
            reason = f"but scenario {scenario.name!r} has {lack}"
            raise ValueError(f"reset option state: {name} is {value!r}, {reason}")
    if remaining:
        unknown, known = join_names(map(str, remaining)), ", ".join(Motion._fields)
        raise ValueError(f"unknown state {unknown}; known: {known}")
    return start
