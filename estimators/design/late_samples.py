"""Late samples before the first tick: the rule and its window, and how many clones it needs."""

import math

from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ..core.delay import BUFFER, CONSTANT, IGNORE, LARSEN, RULES, STORED
from ..core.memory import EVERY, FRAMES, RECENT, WIDTH, WINDOW, Memory
from .config import FilterConfig


def _frames_under_way(sensor: SlowSensor, rule: str) -> int:
    """Frames whose capture must be stored at once, by the sensor's longest delay."""
    if rule not in ("clone", "larsen"):
        return 0
    return math.ceil(sensor.longest_delay / sensor.period - 1e-9)


def place_clones(f: Memory, config: FilterConfig) -> None:
    """Lay the clones of every sensor behind the states; ValueError if there are too many."""
    rule, who = config.delay, config.name
    f.late = IGNORE if rule in ("literal", "lag") else RULES.index(rule)  # their models are late
    f.total = f.n
    for name, sensor in config.sensors.items():
        s, frames = SLOW_NAMES.index(name), _frames_under_way(sensor, rule)
        most = 1 if rule == "larsen" else FRAMES
        if frames > most:
            raise ValueError(
                f"{who}: the {name} can be {sensor.longest_delay:g} s late, {frames} of its periods"
                f" of {sensor.period:g} s; delay={rule!r} can hold {most}"
            )
        f.frames[s] = frames
        if rule == "clone":
            f.first_clone[s] = f.total
            f.total += frames * f.rows[s]
    if rule == "larsen" and f.frames.sum() > 1:
        raise ValueError(f"{who}: delay='larsen' is for one late sensor")
    if f.total > WIDTH:
        raise ValueError(
            f"{who}: {f.n} states and {f.total - f.n} clones are more than the {WIDTH} of "
            f"delay={rule!r}; delay='buffer' needs no clones"
        )


def check_window(f: Memory, config: FilterConfig) -> None:
    """ValueError for a sensor that can be later than the filter's window, and for what a rule
    cannot do."""
    dt, who, sensors = float(f.step / f.stride), config.name, config.sensors
    if f.late == CONSTANT and f.assumed >= WINDOW:
        raise ValueError(
            f"{who}: assumed_delay of {f.assumed * dt:g} s is not within the window of "
            f"{WINDOW * dt:g} s ({WINDOW} ticks)"
        )
    if f.late == LARSEN and (f.gate.any() or f.knots > 0):
        raise ValueError(
            f"{who}: delay='larsen' weighs a sample before it is here, so it takes no gate and no "
            "hdop_table"
        )
    if f.late == BUFFER and f.pace > 1:
        raise ValueError(f"{who}: delay='buffer' is for filters that listen at every tick")
    if f.late == BUFFER and config.accel_time > 0.0:
        raise ValueError(
            f"{who}: delay='buffer' filters stored ticks again and does not store the noise that "
            f"accel_time={config.accel_time:g} finds; use delay='clone'"
        )
    if f.late not in (BUFFER, STORED):
        return
    window = WINDOW - EVERY if f.late == BUFFER else WINDOW - 1
    most = 0
    for name, sensor in sensors.items():
        if sensor.longest_delay > (window + 1e-6) * dt:
            raise ValueError(
                f"{who}: the {name} can be {sensor.longest_delay:g} s late; "
                f"delay={RULES[f.late]!r} has a window of {window * dt:g} s ({window} ticks)"
            )
        most += 2 + math.ceil((sensor.longest_delay + EVERY * dt) / sensor.period)
    if f.late == BUFFER and most > RECENT:
        raise ValueError(
            f"{who}: {most} samples of {' and '.join(sensors)} can come within the longest delay; "
            f"delay='buffer' stores {RECENT}"
        )
