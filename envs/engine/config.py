"""The environment's configuration, checked, and that of an episode with its options."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arguments import (
    check_choice,
    check_mapping,
    check_number,
    describe_unknown,
    is_finite,
    join_names,
    short_repr,
)
from ..quantities import check_plausible
from ..record import Array
from ..scenarios.checks import MIN_GPS_PERIOD
from ..scenarios.draws import get_range
from ..scenarios.manoeuvres import make_scenario
from ..scenarios.scenario import Scenario
from ..sensors.camera.detector import DELAYS, MAX_DELAY, VISIONS, count_delay_ticks, load_detector
from ..sensors.link import MAX_IN_FLIGHT, SlowSensor
from ..sensors.slow import SENSOR_SETS, SLOW_NAMES, apply_changes
from ..task.observation import ObservationEntry, make_observation_layout
from ..ticks import TICK, count_ticks
from ..vehicle.dynamics import Motion
from ..vehicle.vehicle import Vehicle
from ..vehicle.vehicles import make_vehicle
from .packing import EpisodeConfig, make_episode_config


def apply_scenario_clocks(
    sensors: dict[str, SlowSensor], scenario: Scenario
) -> dict[str, SlowSensor]:
    """The sensors with the clocks and delays of a scenario: its fields `<sensor>_period`,
    `<sensor>_delays` and, with these, `<sensor>_jitter`, and `<sensor>_loss`, where it has them. A
    drawn `<sensor>_latency` is described by the worst case: the least of it as a delay, the rest
    as jitter."""
    changed = {}
    for name, sensor in sensors.items():
        period, delays = (getattr(scenario, f"{name}_{key}", None) for key in ("period", "delays"))
        if period is not None:
            sensor = dataclasses.replace(sensor, period=period)
        if delays is not None:
            jitter = getattr(scenario, f"{name}_jitter", 0.0)
            sensor = dataclasses.replace(sensor, delays=delays, jitter=jitter)
        if loss := getattr(scenario, f"{name}_loss", 0.0):
            sensor = dataclasses.replace(sensor, loss=loss)
        low, high = (
            count_ticks(end) for end in get_range(getattr(scenario, f"{name}_latency", 0.0))
        )
        if high > 0.0:
            sensor = dataclasses.replace(
                sensor,
                delays=tuple(delay + low * TICK for delay in sensor.delays),
                jitter=sensor.jitter + (high - low) * TICK,
            )
        changed[name] = sensor
    return changed


def count_max_packets(sensor: SlowSensor, n: int) -> int:
    """The worst case: all frames of a step, doubled, and all that were under way."""
    period = min(sensor.period, MIN_GPS_PERIOD)  # of any scenario
    return 2 * (n // int(count_ticks(period)) + 1) + MAX_IN_FLIGHT


def apply_detector_clock(camera: SlowSensor, delay: str | None) -> SlowSensor:
    """The camera whose pictures a detector looks at: its delay is described by its range.

    Raises ValueError where a picture would arrive as it is taken.
    """
    if delay == "link":
        if count_ticks(min(camera.delays)) < 1:
            raise ValueError("a picture takes a tick at least: camera delays of 0.001 s or more")
        return camera
    min_delay, max_delay = (TICK, MAX_DELAY) if delay == "measured" else load_detector().range
    first, last = count_delay_ticks(min_delay), count_delay_ticks(max_delay)
    return dataclasses.replace(camera, delays=(first * TICK,), jitter=(last - first) * TICK)


RESET_OPTIONS = ("scenario", "vehicle", "friction", "state", "duration")


@dataclass(frozen=True)
class EnvConfig:
    """The arguments of an environment, common to its episodes but for options of reset;
    `StabilityEnv` describes them.

    Raises TypeError or ValueError for an argument out of place.
    """

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
    slow_changes: Mapping[str, Mapping[str, Any] | None]

    def __post_init__(self) -> None:
        check_choice("sensors", self.sensors, SENSOR_SETS)
        if unknown := [name for name in self.slow_changes if name not in SLOW_NAMES]:
            known = [entry.name for entry in dataclasses.fields(self)][:-1]
            raise TypeError(describe_unknown("argument", unknown, [*known, *SLOW_NAMES]))
        n = self.control_period
        if isinstance(n, bool) or not isinstance(n, int | np.integer):
            raise TypeError(f"control_period is a number of ticks, got {short_repr(n)}")
        if not 1 <= n <= 1000:
            raise ValueError(f"control_period is 1 to 1000 ticks, got {short_repr(n)}")
        if not isinstance(self.fast, str) or self.fast not in ("summary", "all"):
            raise ValueError(f"fast is 'summary' or 'all', got {short_repr(self.fast)}")
        for name in ("steering", "yaw_first", "with_map", "strict"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name} is True or False, got {short_repr(getattr(self, name))}")
        bad = self.on_bad_action
        if not isinstance(bad, str) or bad not in ("raise", "fail"):
            raise ValueError(f"on_bad_action is 'raise' or 'fail', got {short_repr(bad)}")
        check_choice("vision", self.vision, VISIONS)
        if self.vision == "image" and "camera" not in SENSOR_SETS[self.sensors]:
            raise ValueError(f"vision='image' needs a camera, and {self.sensors!r} has none")
        if self.delay is not None:
            check_choice("delay", self.delay, DELAYS)
            if self.vision != "image":
                raise ValueError(f"delay={self.delay!r} is of pictures: vision='image'")

    @property
    def slow(self) -> dict[str, SlowSensor]:
        """The slow sensors, with what replaces the set's."""
        return apply_changes(SENSOR_SETS[self.sensors], self.slow_changes)

    @cached_property
    def layout(self) -> tuple[ObservationEntry, ...]:
        """The entries of an observation."""
        n, fast = int(self.control_period), self.fast
        return make_observation_layout(tuple(self.slow), n, fast, self.with_map)

    @cached_property
    def bounds(self) -> Array:
        """Their bounds, (2, len(layout))."""
        return np.array([[entry.low, entry.high] for entry in self.layout]).T.copy()

    @property
    def max_packets(self) -> int:
        """The most packets of a step."""
        n = int(self.control_period)
        return sum(count_max_packets(sensor, n) for sensor in self.slow.values())

    @property
    def action_width(self) -> int:
        """The numbers of an action."""
        return 2 if self.steering else 1

    @cached_property
    def base(self) -> EpisodeConfig:
        """An episode without options."""
        return self.make_episode(self.scenario, self.vehicle)

    def make_episode(
        self, scenario: Scenario, vehicle: Vehicle, motion: Array | None = None
    ) -> EpisodeConfig:
        """An episode of a scenario with a true vehicle and a start, as of
        `parse_initial_motion`."""
        if self.strict:
            cars = vehicle.replace(**scenario.vehicle), self.nominal.replace(**scenario.nominal)
            for part in (scenario, *cars):
                check_plausible(part)
        slow = apply_scenario_clocks(self.slow, scenario)
        if self.vision == "image":
            slow["camera"] = apply_detector_clock(slow["camera"], self.delay)
            scenario = scenario.replace(noise={**scenario.noise, **load_detector().noise})
        return make_episode_config(
            scenario,
            vehicle,
            self.nominal,
            slow,
            self.reference,
            motion,
            self.fast == "all",
            self.with_map,
            self.yaw_first,
            self.on_bad_action == "fail",
        )

    def apply_options(self, options: Mapping[str, Any]) -> EpisodeConfig:
        """An episode with options of reset; ValueError for an unknown option or state."""
        if not options:
            return self.base
        unknown = sorted(map(str, set(options) - set(RESET_OPTIONS)))
        if unknown:
            raise ValueError(
                f"unknown reset option {', '.join(unknown)}; known: {', '.join(RESET_OPTIONS)}"
            )
        scenario = make_scenario(options.get("scenario", self.scenario))
        vehicle = make_vehicle(options.get("vehicle", self.vehicle), self.strict)
        if "friction" in options:
            friction = check_number("reset option friction", options["friction"])
            scenario = scenario.replace(friction=friction)
        if "duration" in options:
            duration = check_number("reset option duration", options["duration"])
            scenario = scenario.replace(duration=duration)
        return self.make_episode(
            scenario, vehicle, parse_initial_motion(options.get("state", {}), scenario)
        )


def parse_initial_motion(state: Mapping[str, Any], scenario: Scenario) -> Array:
    """A Motion's numbers (len(Motion),), NaN where the mapping has none; ValueError for a name
    that is no state's, a value that is no number, and roll where the scenario has none."""
    remaining = dict(check_mapping("reset option state", state))
    start = np.full(len(Motion._fields), np.nan)
    for i, name in enumerate(Motion._fields):
        value = remaining.pop(name, None)
        if value is not None and not (is_finite(value) and abs(value) <= 1e6):
            got = short_repr(value)
            raise ValueError(f"reset option state: {name} is {got}, not a number up to 1e6")
        start[i] = np.nan if value is None else value
        if name.startswith("phi") and value and not scenario.roll:
            raise ValueError(
                f"reset option state: {name} is {value!r}, but scenario {scenario.name!r} "
                "has no roll"
            )
    if remaining:
        known = ", ".join(Motion._fields)
        raise ValueError(f"unknown state {join_names(map(str, remaining))}; known: {known}")
    return start
