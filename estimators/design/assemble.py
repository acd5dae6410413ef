"""From a filter's config to its compiled memory, one record a layer, and its schedules."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ..core.innovation import (
    BUFFER,
    CONSTANT,
    DUAL_RATE,
    IGNORE,
    LARSEN,
    NONE,
    PSEUDO,
    RULES,
    STORED,
)
from ..core.model import KINEMATIC, MIN_SPEED, VELOCITY_ROLL
from ..core.multiple_model import CHANGED, GUSTY, MIN_LOG_WEIGHT
from ..core.record import (
    FILTER,
    N_FRAMES,
    N_RECENT,
    N_ROWS,
    N_TOTAL,
    SNAPSHOT_INTERVAL,
    WINDOW,
    FilterRecord,
)
from .kalman import kalman_gain
from .models import NONLINEAR, write_model
from .options import FilterConfig
from .periodic import NO_SENSOR, Schedule, build_measurement_rows, count_ticks


def _count_frames(sensor: SlowSensor, rule: str) -> int:
    """Count the frames whose capture must be stored at once, by the sensor's longest delay."""
    if rule not in ("clone", "larsen"):
        return 0
    return math.ceil(sensor.longest_delay / sensor.period - 1e-9)


def _allocate_clones(f: FilterRecord, config: FilterConfig) -> None:
    """Lay the clones of every sensor behind the states; ValueError where there are too many."""
    rule, label = config.delay, config.name
    f.late = IGNORE if rule in ("literal", "lag") else RULES.index(rule)  # late states instead
    f.total = f.n
    for name, sensor in config.sensors.items():
        s, frames = SLOW_NAMES.index(name), _count_frames(sensor, rule)
        max_frames = 1 if rule == "larsen" else N_FRAMES
        if frames > max_frames:
            raise ValueError(
                f"{label}: the {name} can be {sensor.longest_delay:g} s late, {frames} of its "
                f"periods of {sensor.period:g} s; delay={rule!r} can hold {max_frames}"
            )
        f.frames[s] = frames
        if rule == "clone":
            f.first_clone[s] = f.total
            f.total += frames * f.rows[s]
    if rule == "larsen" and f.frames.sum() > 1:
        raise ValueError(f"{label}: delay='larsen' is for one late sensor")
    if f.total > N_TOTAL:
        raise ValueError(
            f"{label}: {f.n} states and {f.total - f.n} clones are more than the {N_TOTAL} of "
            f"delay={rule!r}; delay='buffer' needs no clones"
        )


def _check_window(f: FilterRecord, config: FilterConfig) -> None:
    """Check that the window holds the longest delay and that rules go together; else ValueError."""
    dt, label, sensors = float(f.step / f.stride), config.name, config.sensors
    if f.late == CONSTANT and f.assumed >= WINDOW:
        raise ValueError(
            f"{label}: assumed_delay of {f.assumed * dt:g} s is not within the window of "
            f"{WINDOW * dt:g} s ({WINDOW} ticks)"
        )
    if f.late == LARSEN and (f.gate.any() or f.knots > 0):
        raise ValueError(
            f"{label}: delay='larsen' weighs a sample before it is here, so it takes no gate "
            "and no hdop_table"
        )
    if f.late == BUFFER and f.pace > 1:
        raise ValueError(f"{label}: delay='buffer' is for filters that listen at every tick")
    if f.late == BUFFER and config.accel_time > 0.0:
        raise ValueError(
            f"{label}: delay='buffer' filters stored ticks again and does not store the noise that "
            f"accel_time={config.accel_time:g} finds; use delay='clone'"
        )
    if f.late not in (BUFFER, STORED):
        return
    window = WINDOW - SNAPSHOT_INTERVAL if f.late == BUFFER else WINDOW - 1
    n_samples = 0
    for name, sensor in sensors.items():
        if sensor.longest_delay > (window + 1e-6) * dt:
            raise ValueError(
                f"{label}: the {name} can be {sensor.longest_delay:g} s late; "
                f"delay={RULES[f.late]!r} has a window of {window * dt:g} s ({window} ticks)"
            )
        n_samples += 2 + math.ceil((sensor.longest_delay + SNAPSHOT_INTERVAL * dt) / sensor.period)
    if f.late == BUFFER and n_samples > N_RECENT:
        raise ValueError(
            f"{label}: {n_samples} samples of {' and '.join(sensors)} can come within the "
            f"longest delay; delay='buffer' stores {N_RECENT}"
        )


_SMOOTHING_TIME = 0.015  # s, time constant of the low-pass on the measured speed
_MAX_SPEED = 80.0  # m/s, speed of the last table of gains
_SPACING = 0.5  # m/s between two tables of gains
REPLACE_TIME = 0.5  # s between two replacements of a bank's least likely member
HAZARD = 0.2  # 1/s, rate at which tyres change
_TYRE_VARIANCE = 0.06  # variance that a change adds to the factors on the stiffness
# 1/s, variance per second of a new member's factors until the next one: the change may be later
_TYRE_WALK = 0.02
_IMM_TIME = 0.2  # s between two steps of members that interact
_GUST = (8.0, 2.0)  # standard deviations of a gust's force and moment over those configured


def assemble(
    config: FilterConfig, vehicle: Vehicle, dt: float, speed: float | None
) -> tuple[Any, tuple[Schedule, ...]]:
    """Assemble the memory of a filter and the schedules of its first slow sensor.

    ValueError says that a schedule does not fit ticks, that a sensor can be later than the filter's
    window, or that options do not go together.

    Args:
        config: Parsed options of the filter.
        vehicle: The filter's vehicle.
        dt: Tick (s).
        speed: Speed (m/s) if it is held, None where it is measured.

    Returns:
        Memory, shape (layers,), and schedules.
    """
    layers, first = np.zeros(len(config.models), FILTER).view(np.recarray), 0
    for f, model in zip(layers, config.models, strict=True):
        _write_clocks(f, config, dt)
        n, step = len(model.names), f.stride * dt
        block = slice(first, first + n)
        noise = _scale_noise(config, vehicle), config.noise_over_speed
        write_model(f, model, vehicle, step, *noise, config.Q[block, block])
        f.decay[f.dense : n - len(model.biases)] *= math.exp(-config.leak * f.stride * dt)
        f.prior[:n, :n] = np.diag([config.prior[state] ** 2 for state in model.names])
        for state, time in config.times.items():
            if time > 0.0:
                i, decay = model.names.index(state), math.exp(-step / time)
                f.decay[i], f.Q[i, i] = decay, (1.0 - decay * decay) * f.prior[i, i]
        _allocate_clones(f, config)
        f.measured, f.speed = int(speed is None), speed or 0.0
        f.smoothing = 1.0 - math.exp(-dt / _SMOOTHING_TIME)
        _write_trust(f, config)
        first += n
    planned = _make_schedules(layers[0], config, dt)
    for f in layers:
        f.assumed = layers[0].assumed
        _write_rules(f, config, planned)
        _check_window(f, config)
    layers[0].store_predictions |= len(layers) > 1
    return _build_bank(layers, config, dt), planned


def _scale_noise(config: FilterConfig, vehicle: Vehicle) -> dict[str, float]:
    """Compute the noise with the fractions of the car's weight in it."""
    noise, weight = dict(config.noise), vehicle.mass * GRAVITY
    arm = 0.5 * (vehicle.front_arm + vehicle.rear_arm)
    for name, share, size in zip(("force", "moment"), config.shares, (1.0, arm), strict=True):
        if share > 0.0:
            noise[name] = math.hypot(noise[name], share * weight * size)
    return noise


def _build_bank(layers: Any, config: FilterConfig, dt: float) -> Any:
    """Build the mixture and the members of a bank of the filter; the filter itself without one."""
    if config.members < 2:
        return layers
    f = layers[0]
    f.members, f.respawn, f.spread = config.members, round(REPLACE_TIME / dt), _TYRE_VARIANCE
    f.hazard, f.level[:], f.alert = math.log(HAZARD * REPLACE_TIME), 1.0, _TYRE_WALK * f.step
    bank = np.repeat(layers, 1 + config.members).view(np.recarray)
    for m, f in enumerate(bank[1:]):
        # of two members with equal levels the later one is replaced first
        f.odds = MIN_LOG_WEIGHT if m >= len(config.levels) else 0.0
        f.level[:] = np.square(config.levels[m % len(config.levels)])
        if f.forces:
            both = range(f.dense, f.dense + 2)
            f.q_known *= f.level
            f.Q[both, both] *= f.level
            f.prior[both, both] *= f.level
    if config.sudden:
        _set_imm_members(bank, dt)
    return bank


def _set_imm_members(bank: Any, dt: float) -> None:
    """Set what the interacting members differ in."""
    bank.respawn = round(_IMM_TIME / dt)
    for f in bank:
        f.burst[:] = np.square(_GUST) * f.q_known / f.q_share
    gusty, changed = bank[GUSTY], bank[CHANGED]
    gusty.decay[gusty.dense : gusty.dense + 2] = 1.0
    changed.q_tyres[:2] += _TYRE_WALK * changed.step


def select_first_sensor(config: FilterConfig) -> FilterConfig:
    """Reduce a filter to its first slow sensor.

    Args:
        config: Parsed options of the filter.

    Returns:
        Its options with that sensor alone.
    """
    return replace(config, sensors=dict(list(config.sensors.items())[:1]))


def remove_tyre_states(config: FilterConfig) -> FilterConfig:
    """Reduce a filter to nominal tyres and scale instead of states: that one is linear.

    Args:
        config: Parsed options of the filter.

    Returns:
        Its options without these states.
    """
    if not any(name in NONLINEAR for name in config.states):
        return config
    indices = [i for i, name in enumerate(config.states) if name not in NONLINEAR]
    models = tuple(
        replace(model, biases=tuple(name for name in model.biases if name not in NONLINEAR))
        for model in config.models
    )
    prior = {name: sd for name, sd in config.prior.items() if name not in NONLINEAR}
    Q = config.Q[np.ix_(indices, indices)]
    return replace(config, models=models, Q=Q, prior=prior, members=1)


def _write_clocks(f: FilterRecord, config: FilterConfig, dt: float) -> None:
    """Write periods, the filter's own step, and by how much late states follow in it."""
    for name, sensor in config.sensors.items():
        label = f"{config.name}: the {name}'s period"
        f.period[SLOW_NAMES.index(name)] = count_ticks(sensor.period, dt, label)
    f.pace = int(f.period.max()) if config.intersample == "single-rate" else 1
    f.stride = f.pace if config.between == "hold" else 1
    f.relax = 1.0
    if config.delay == "lag":  # a first-order lag of the mean delay
        camera = config.sensors["camera"]
        delay = float(np.mean(camera.delays)) + 0.5 * camera.jitter
        f.relax = 1.0 - math.exp(-dt / max(delay, dt))


def _write_trust(f: FilterRecord, config: FilterConfig) -> None:
    """Write what is known of a sample's noise, and which ones are skipped."""
    f.least_satellites, f.adapt, f.robust = config.satellites, config.adapt, config.robust
    f.steer_jump = config.steer_rate * f.step
    f.model_error, f.r_told = config.model_error, config.noise["accel_y"] ** 2
    if config.accel_time > 0.0 and f.accel_row > 0:
        f.r_share = 1.0 - math.exp(-f.step / config.accel_time)
    f.wary = config.wary
    if config.gate is not None:
        from scipy.stats import chi2  # slow to load

        f.gate[1:] = chi2.ppf(config.gate, np.arange(1, N_ROWS + 1))
    knots = config.hdop_table if f.kind != VELOCITY_ROLL else ()  # applied by the first layer
    f.knots = len(knots)
    for i, (hdop, factor) in enumerate(knots):
        f.hdop[i], f.hdop_factor[i] = hdop, factor


def _make_schedules(f: FilterRecord, config: FilterConfig, dt: float) -> tuple[Schedule, ...]:
    """Make the schedules of the first slow sensor: one, or two extremes for random delays."""
    if not config.sensors:
        return (NO_SENSOR,)
    name, sensor = next(iter(config.sensors.items()))
    if config.delay == "constant":
        f.assumed = count_ticks(config.assumed_delay, dt, f"{config.name}: assumed_delay")
        sensor = SlowSensor(sensor.period, (config.assumed_delay,), sensor.phase)
    if config.row.intersample == "dual-rate":  # its rules have no delay
        sensor = SlowSensor(sensor.period, (0.0,), sensor.phase)
    label, stride, pace = f"{config.name}: the {name}", int(f.stride), int(f.pace)
    slots = max(1, int(f.frames[f.first_slow]))  # places of stored captures, which take turns
    period = count_ticks(sensor.period, dt, f"{label}'s period") // stride
    late = [count_ticks(delay, dt, f"a delay: {label}'s") for delay in sensor.delays]
    jitter = count_ticks(sensor.jitter, dt, f"{label}'s jitter")

    def make_schedule(extra: int) -> Schedule:
        # a sample is used in the first step that listens at or after its arrival
        lags = [math.ceil((lag + extra) / pace) * pace // stride for lag in late]
        if len(set(lags)) == 1:
            lags = lags[:1]
        return Schedule(period, tuple(lags * (math.lcm(len(lags), slots) // len(lags))))

    shortest, longest = make_schedule(0), make_schedule(jitter)
    return (longest,) if shortest == longest else (shortest, longest)


def _write_rules(f: FilterRecord, config: FilterConfig, planned: tuple[Schedule, ...]) -> None:
    """Write the codes that choose what compiled code does; ValueError for a contradiction."""
    f.cycle, f.pattern = planned[-1].cycle, max(1, len(planned[-1].lags))
    pseudo = config.intersample == "pseudo-residual"
    shared = config.row.intersample == "dual-rate"
    f.between = PSEUDO if pseudo else DUAL_RATE if shared else NONE
    f.periodic = _is_periodic(f, config, len(planned) > 1)
    f.joint = config.row.gains == "placed" or (pseudo and f.periodic)
    f.store_predictions = f.late in (STORED, CONSTANT)
    if f.measured and f.periodic:
        f.low, f.high, f.spacing = MIN_SPEED, _MAX_SPEED, _SPACING
    if pseudo:
        C = build_measurement_rows(f, 0)
        zero = np.zeros((len(C), len(C)))
        f.inverse[: len(C), : f.total] = kalman_gain(np.eye(f.total), C, zero).T
    if _is_covariance_needed(config) and (f.periodic or f.between != NONE):
        raise ValueError(
            f"{config.name}: gate, adapt, latency, delay='larsen' and delay='buffer' need "
            f"gains='covariance' and no correction between samples; got gate={config.gate}, "
            f"adapt={config.adapt}, latency={dict(config.latency)}, delay={config.delay!r}"
        )
    if config.adapt > 0.0 and config.delay in ("larsen", "buffer"):
        raise ValueError(f"{config.name}: adapt needs delay='clone', got delay={config.delay!r}")


def _is_covariance_needed(config: FilterConfig) -> bool:
    uses_innovation = config.gate is not None or config.adapt > 0.0 or bool(config.latency)
    return uses_innovation or config.delay in ("larsen", "buffer")


def _is_periodic(f: FilterRecord, config: FilterConfig, random: bool) -> bool:
    """Return whether gains are precomputed; `random`: whether the first sensor's delay is."""

    def refuse(reason: str) -> ValueError:
        return ValueError(f"{config.name}: no gains={config.gains!r}: {reason}")

    if f.between == DUAL_RATE or config.row.gains == "placed":
        return True
    is_multi_sensor, ignores_lag = len(config.sensors) > 1, f.frames.max() == 0
    impossible = ""
    if f.kind in (KINEMATIC, VELOCITY_ROLL) or config.row.second:
        impossible = "its model changes with the yaw rate"
    elif f.between == PSEUDO:
        if config.gains == "covariance":
            raise refuse("it has one constant gain")
        if f.frames.max() > 1:
            raise ValueError(
                f"{config.name}: a sample must arrive before the next one is captured, got "
                f"{config.sensors}"
            )
        return True
    elif any(model.biases for model in config.models):
        impossible = "a constant bias has no settled gain"
    elif is_multi_sensor or (random and not ignores_lag):
        impossible = "two slow sensors" if is_multi_sensor else "random delay"
    if impossible:
        if config.gains == "periodic":
            raise refuse(f"{impossible}; use gains='covariance'")
        return False
    default = "covariance" if _is_covariance_needed(config) else config.row.gains
    return (config.gains or default) == "periodic"
