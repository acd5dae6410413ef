"""From a filter's config to its compiled memory, one entry a layer, and its schedules."""

import math
from collections.abc import Mapping

import numpy as np

from ...envs.record import FAST, PACKET, Array
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW, SLOW_NAMES
from ...envs.vehicle.linear import make_roll_model
from ...envs.vehicle.parameters import GRAVITY, Vehicle
from ..core import late_samples as rule
from ..core import memory as size
from ..core.memory import FILTER, GAIN, FilterLayers, FilterMemory
from ..core.model import MIN_SPEED, Y_L
from .gains import kalman_gain
from .options import LATE, MEASUREMENTS, SCALE, TYRES, WANDER, FilterConfig, FilterModel
from .periodic import NO_SENSOR, Schedule, build_measurement_rows, count_ticks


def _refuse(label: str, *checks: tuple[object, str]) -> None:
    """Raise ValueError with the first message whose condition holds."""
    for is_wrong, message in checks:
        if is_wrong:
            raise ValueError(f"{label}: {message}")


def _allocate_clones(f: FilterMemory, config: FilterConfig) -> None:
    """Lay the clones of every sensor behind the states; ValueError where there are too many."""
    delay = config.delay
    f.delay_rule = rule.IGNORE if delay in ("literal", "lag") else [*rule.RULES].index(delay)
    if delay == "buffer":  # it filters the past anew while f.tick stands still
        f.linearise_every = 1
    f.total = f.n
    max_frames = 1 if delay == "larsen" else size.N_FRAMES
    for name, sensor in config.sensors.items() if delay in ("clone", "larsen") else ():
        s, frames = SLOW_NAMES.index(name), math.ceil(sensor.longest_delay / sensor.period - 1e-9)
        text = (
            f"the {name} can be {sensor.longest_delay:g} s late, {frames} of its periods of "
            f"{sensor.period:g} s; delay={delay!r} can hold {max_frames}"
        )
        _refuse(config.name, (frames > max_frames, text))
        f.frames[s] = frames
        f.first_clone[s] = f.total if delay == "clone" else rule.WEIGHED
        f.total += frames * f.rows[s] * (delay == "clone")
    is_twice = delay == "larsen" and f.frames.sum() > 1
    text = (
        f"{f.n} states and {f.total - f.n} clones are more than the {size.N_TOTAL} of "
        f"delay={delay!r}; delay='buffer' needs no clones"
    )
    twice = "delay='larsen' is for one late sensor"
    _refuse(config.name, (is_twice, twice), (f.total > size.N_TOTAL, text))


def _check_window(f: FilterMemory, config: FilterConfig) -> None:
    """Check that the window holds the longest delay and that rules go together; else ValueError."""
    dt, sensors, is_buffer = float(f.step / f.stride), config.sensors, f.delay_rule == rule.BUFFER
    window = size.WINDOW - size.SNAPSHOT_INTERVAL if is_buffer else size.WINDOW - 1
    checks = [
        (
            f.delay_rule == rule.CONSTANT and f.assumed >= size.WINDOW,
            f"assumed_delay of {f.assumed * dt:g} s is not within the window of "
            f"{size.WINDOW * dt:g} s ({size.WINDOW} ticks)",
        ),
        (
            f.delay_rule == rule.LARSEN and (f.gate.any() or f.knots > 0),
            "delay='larsen' weighs a sample before it is here, so it takes no gate and no "
            "hdop_table",
        ),
        (is_buffer and f.pace > 1, "delay='buffer' is for filters that listen at every tick"),
        (
            is_buffer and config.noise_time > 0.0,
            "delay='buffer' filters stored ticks again and does not store the noise that "
            f"noise_time={config.noise_time:g} finds; use delay='clone'",
        ),
    ]
    n_samples = 0
    for name, sensor in sensors.items() if f.delay_rule in (rule.BUFFER, rule.STORED) else ():
        text = (
            f"the {name} can be {sensor.longest_delay:g} s late; "
            f"delay={config.delay!r} has a window of {window * dt:g} s ({window} ticks)"
        )
        checks.append((sensor.longest_delay > (window + 1e-6) * dt, text))
        longest = sensor.longest_delay + size.SNAPSHOT_INTERVAL * dt
        n_samples += 2 + math.ceil(longest / sensor.period)
    text = (
        f"{n_samples} samples of {' and '.join(sensors)} can come within the longest delay; "
        f"delay='buffer' stores {size.N_RECENT}"
    )
    _refuse(config.name, *checks, (is_buffer and n_samples > size.N_RECENT, text))


_EXPANSION_TIME = 0.004  # s between two expansions of the tyres' forces
_BLOCK_TIME = 0.2  # s of a block whose mean innovations show the fast sensors' noise
_SMOOTHING_TIME = 0.015  # s, time constant of the low-pass on the measured speed
_MAX_SPEED = 80.0  # m/s, speed of the last table of gains
_SPACING = 0.5  # m/s between two tables of gains


def assemble(
    config: FilterConfig, vehicle: Vehicle, dt: float, speed: float | None
) -> tuple[FilterLayers, tuple[Schedule, ...]]:
    """Assemble a filter's memory, shape (layers,), and the schedules of its first slow sensor.

    ValueError says that a schedule does not fit ticks, that a sensor can be later than the filter's
    window, or that options do not go together.
    """
    layers, first = np.zeros(len(config.models), FILTER).view(np.recarray), 0
    for f, model in zip(layers, config.models, strict=True):
        _write_clocks(f, config, dt)
        n, f.step = len(model.names), f.stride * dt
        too_many = f"{n} states are more than the {size.SPARE} of a filter: {model.names}"
        _refuse(config.name, (n > size.SPARE, too_many))
        block = slice(first, first + n)
        _write_model(f, model, vehicle, config, config.Q[block, block] * f.step)
        f.decay[f.dense : n - len(model.biases)] *= math.exp(-config.leak * f.stride * dt)
        f.prior[:n, :n] = np.diag([config.prior[state] ** 2 for state in model.names])
        for state, time in config.bias_times.items():
            if time > 0.0:
                i, decay = model.names.index(state), math.exp(-f.step / time)
                f.decay[i], f.Q[i, i] = decay, (1.0 - decay * decay) * f.prior[i, i]
        _allocate_clones(f, config)
        f.measured, f.speed = int(speed is None), speed or 0.0
        f.smoothing = 1.0 - math.exp(-dt / _SMOOTHING_TIME) if f.measured else 0.0
        _write_trust(f, config)
        first += n
    planned = _make_schedules(layers[0], config, dt)
    for f in layers:
        f.assumed = layers[0].assumed
        _write_rules(f, config, planned)
        _check_window(f, config)
    return layers, planned


def _write_clocks(f: FilterMemory, config: FilterConfig, dt: float) -> None:
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


def _write_trust(f: FilterMemory, config: FilterConfig) -> None:
    """Write what is known of a sample's noise, and which ones are skipped."""
    f.least_satellites, f.r_scale_weight, f.robust = config.satellites, config.adapt, config.robust
    f.steer_jump, f.map_lag = config.steer_rate * f.step, config.map_lag_sd
    f.model_error, f.r_nominal[:] = config.model_error, f.r_fast
    if config.noise_time > 0.0:
        f.block = max(1, round(_BLOCK_TIME / f.step))
        f.r_share = 1.0 - math.exp(-f.block * f.step / config.noise_time)
    f.recovery_count = config.wary
    if config.gate is not None:
        from scipy.special import gammaincinv  # chi-square's quantiles: scipy.stats loads long

        f.gate[1:] = 2.0 * gammaincinv(0.5 * np.arange(1, size.N_ROWS + 1), config.gate)
    knots = () if f.r_speed > 0.0 else config.hdop_table  # of a second layer: the first applies it
    f.knots = len(knots)
    for i, (hdop, factor) in enumerate(knots):
        f.hdop[i], f.hdop_factor[i] = hdop, factor


def _write_model(
    f: FilterMemory, model: FilterModel, vehicle: Vehicle, config: FilterConfig, Q: Array
) -> None:
    """Write the model and its measurements; Q (n, n): a step's process noise besides forces'."""
    names, dense = model.names, len(model.states) + len(model.late)
    n = len(names)
    f.n, f.total, f.dense, f.delayed = n, n, dense, len(model.late)
    f.first_bias = n - len(model.biases)
    for state in ("bank", "phi", "steer_offset", "map_heading", SCALE):
        f[f"{state}_state"] = names.index(state) if state in names else size.SPARE
    f.offset_share, f.velocity = "steer_offset" in names, "v_x" in names
    f.car[:] = vehicle.lateral
    f.Q[:n, :n], f.decay[:] = Q, 1.0
    _write_constants(f, model, vehicle)
    if model.forces:  # exact discretisation of the process
        weight, arm = vehicle.mass * GRAVITY, 0.5 * (vehicle.front_arm + vehicle.rear_arm)
        force_sd = math.hypot(config.force_sd, config.force_share * weight)
        moment_sd = math.hypot(config.moment_sd, config.moment_share * weight * arm)
        times = config.disturbance_time, config.moment_time or config.disturbance_time
        decay = np.array([math.exp(-f.step / time) for time in times])
        both = range(dense, dense + 2)
        f.decay[both], f.q_share[:] = decay, 1.0 - decay * decay
        f.Q[both, both] += f.q_share * np.square([force_sd, moment_sd])
        f.q_nominal[:] = f.Q[both, both]
        f.B[1, size.N_INPUTS + 1] = 1.0 / vehicle.yaw_inertia
    _write_tyres(f, model, vehicle)
    _write_signals(f, model, vehicle, config.noise)
    _write_rows(f, model, config)


def _write_constants(f: FilterMemory, model: FilterModel, vehicle: Vehicle) -> None:
    """Write the entries of A and B that `build_model` leaves, and what it makes the others of."""
    names, inertia, phi, behind = model.names, vehicle.yaw_inertia, int(f.phi_state), size.N_INPUTS
    body, rolls = make_roll_model(vehicle), "phi" in names
    for j, (_, pushed) in enumerate(model.disturbances):
        f.B[names.index(pushed), behind + j] = 1.0
    f.planar = len(model.states) - 2 * rolls if "beta" in names else 0
    f.preview = vehicle.preview
    f.push_rate, f.push_force = f.B[0, behind], model.forces
    f.roll_stiffness, f.roll_damping = -body.A[1, 0], -body.A[1, 1]
    f.roll_arm, f.sway = rolls * body.B[1, 0], rolls * vehicle.roll_moment_arm / vehicle.mass
    f.A[phi : phi + 2, phi : phi + 2] = body.A
    if "accel_y" in model.inputs:
        f.B[phi + 1, model.inputs.index("accel_y")] = body.B[1, 0]
    if "v_x" in names:
        f.B[0, 0], f.B[1, 1], f.A[1, phi] = 1.0, 1.0, -GRAVITY  # double-layer-gps (5)
    if model.inputs == ("N_z",):
        f.B[0, 0] = f.B[0, behind] = 1.0 / inertia
    if "F_yf" in names:
        f.B[0, behind : behind + 2] = np.array([vehicle.front_arm, -vehicle.rear_arm]) / inertia


def _write_tyres(f: FilterMemory, model: FilterModel, vehicle: Vehicle) -> None:
    """Write where the tyres' states stand and start: at the nominal ones."""
    names = model.names
    f.curved_state = Y_L if {TYRES[0], "map_heading"} <= {*names} else size.SPARE
    if TYRES[0] not in names:
        return
    f.tyre_states, f.tyres = len({*TYRES} & {*names}), names.index(TYRES[0])
    f.linearise_every = max(1, round(_EXPANSION_TIME / f.step))
    f.stiffness[:] = 2.0 * vehicle.front_stiffness, 2.0 * vehicle.rear_stiffness
    wheelbase = vehicle.front_arm + vehicle.rear_arm
    arms = np.array([vehicle.rear_arm, vehicle.front_arm])
    f.load[:] = vehicle.mass * GRAVITY * arms / wheelbase
    places = slice(f.tyres, f.tyres + f.tyre_states)
    f.first[places] = (1.0, 1.0, 1.0 / vehicle.friction)[: f.tyre_states]
    f.q_tyres[: f.tyre_states] = np.diag(f.Q)[places]


def _make_signals(vehicle: Vehicle) -> dict[str, tuple[tuple[int, float], tuple[int, float]]]:
    """Make the sums of two columns of a fast row: two pairs (column, factor) by name."""
    arm = vehicle.rear_track / (2.0 * vehicle.wheel_radius)  # N_z = arm (T_r - T_l)
    single = ("gyro", "accel_y", "accel_x", "roll_rate", "steer", "curvature")
    return {name: ((getattr(FAST, name), 1.0), (getattr(FAST, name), 0.0)) for name in single} | {
        "N_z": ((FAST.torque_right, arm), (FAST.torque_left, -arm)),
        "wheel": ((FAST.wheel_left, 0.5), (FAST.wheel_right, 0.5)),
    }


def _write_signals(
    f: FilterMemory, model: FilterModel, vehicle: Vehicle, noise: Mapping[str, float]
) -> None:
    """Write inputs and fast measurements; `build_model` writes rows that depend on speed."""
    table, names = _make_signals(vehicle), model.names
    f.inputs, f.fasts = len(model.inputs), len(model.fast)
    for i, name in enumerate(model.inputs):
        f.u_column[i], f.u_factor[i] = zip(*table[name], strict=True)
    measured_state = {"gyro": "gamma", "roll_rate": "phi_rate", "wheel": "v_x"}
    for i, name in enumerate(model.fast):
        f.y_column[i], f.y_factor[i] = zip(*table[name], strict=True)
        f.r_fast[i] = noise[name] ** 2
        if name in measured_state:
            f.C_fast[i, names.index(measured_state[name])] = 1.0
    for bias in WANDER.keys() & model.biases:
        if WANDER[bias] in model.fast:
            f.C_fast[model.fast.index(WANDER[bias]), names.index(bias)] = 1.0
    f.accel_row = model.fast.index("accel_y") if "accel_y" in model.fast else size.N_FAST - 1
    f.felt[:] = f.C_fast[f.accel_row]
    f.felt[f.phi_state] = GRAVITY
    if "F_yf" in names:  # m a_y = F_yf + F_yr
        f.C_fast[1, 1] = f.C_fast[1, 2] = 1.0 / vehicle.mass


def _write_rows(f: FilterMemory, model: FilterModel, config: FilterConfig) -> None:
    """Write what the used slow sensors measure."""
    used = [s for s in range(len(SLOW_NAMES)) if f.period[s] > 0]
    f.first_slow = used[0] if used else -1
    is_second_layer = model is not config.models[0]
    for s in used:
        name = SLOW_NAMES[s]
        sensor = MEASUREMENTS[name]
        rows = sensor.velocities if is_second_layer else sensor.rows
        f.rows[s], f.heading_fix[s] = len(rows), sensor.heading_fix and not is_second_layer
        for place, value in enumerate(SLOW[s].values, PACKET.value):
            if value.name in ("hdop", "satellites", "speed"):
                f[f"{value.name}_column"][s] = place
        for i, row in enumerate(rows):
            f.angle[s, i], f.ground[s, i] = row.angle, row.ground
            f.r[s, i] = config.noise[row.noise] ** 2
            f.noise_over_speed[s, i] = config.noise_over_speed.get(row.noise, 0.0) ** 2
            for state in row.states:
                late = LATE.get(state)
                f.C[s, i, model.names.index(late if late in model.late else state)] = 1.0
        for bias in {"camera_yaw", "map_heading"} & {*model.biases} if name == "camera" else ():
            f.C[s, :2, model.names.index(bias)] = 1.0, f.preview  # they turn about the car, not y_l
        if is_second_layer:
            f.r_speed = f.r[s, 0]


def _make_schedules(f: FilterMemory, config: FilterConfig, dt: float) -> tuple[Schedule, ...]:
    """Make the schedules of the first slow sensor: one, or two extremes for random delays."""
    if not config.sensors:
        return (NO_SENSOR,)
    name, sensor = next(iter(config.sensors.items()))
    if config.delay == "constant":
        f.assumed = count_ticks(config.assumed_delay, dt, f"{config.name}: assumed_delay")
        sensor = SlowSensor(sensor.period, (config.assumed_delay,), sensor.phase)
    if config.row.family == "dual-rate":  # its rules have no delay
        sensor = SlowSensor(sensor.period, (0.0,), sensor.phase)
    label, stride, pace = f"{config.name}: the {name}", int(f.stride), int(f.pace)
    slots = max(1, int(f.frames[f.first_slow]))  # places of stored captures, which take turns
    period = count_ticks(sensor.period, dt, f"{label}'s period") // stride
    late = [count_ticks(delay, dt, f"a delay: {label}'s") for delay in sensor.delays]
    jitter = count_ticks(sensor.jitter, dt, f"{label}'s jitter")

    def make_schedule(extra: int) -> Schedule:
        # a sample is used in the first step that listens at or after its arrival
        lags = [math.ceil((lag + extra) / pace) * pace // stride for lag in late]
        lags = lags[:1] if len(set(lags)) == 1 else lags
        return Schedule(period, tuple(lags * (math.lcm(len(lags), slots) // len(lags))))

    shortest, longest = make_schedule(0), make_schedule(jitter)
    return (longest,) if shortest == longest else (shortest, longest)


def _write_rules(f: FilterMemory, config: FilterConfig, planned: tuple[Schedule, ...]) -> None:
    """Write the codes that choose what compiled code does; ValueError for a contradiction."""
    f.cycle, f.pattern = planned[-1].cycle, max(1, len(planned[-1].lags))
    f.gain_rule = _choose_gain_rule(f, config, len(planned) > 1)
    f.stored = f.n if f.delay_rule in (rule.STORED, rule.CONSTANT) or config.row.second else 0
    if f.measured and f.gain_rule > GAIN.split:
        f.low, f.high, f.spacing = MIN_SPEED, _MAX_SPEED, _SPACING
    if f.gain_rule == GAIN.split:
        C = build_measurement_rows(f)
        zero = np.zeros((len(C), len(C)))
        f.inverse[: len(C), : f.total] = kalman_gain(np.eye(f.total), C, zero).T
    text = (
        "gate, adapt, latency, delay='larsen' and delay='buffer' need gains='covariance' and no "
        f"correction between samples; got gate={config.gate}, adapt={config.adapt}, "
        f"latency={dict(config.latency)}, delay={config.delay!r}"
    )
    is_refused = f.gain_rule != GAIN.covariance and _is_covariance_needed(config)
    cannot_adapt = config.adapt > 0.0 and config.delay in ("larsen", "buffer")
    needed = f"adapt needs delay='clone', got delay={config.delay!r}"
    _refuse(config.name, (is_refused, text), (cannot_adapt, needed))


def _is_covariance_needed(config: FilterConfig) -> bool:
    uses_innovation = config.gate is not None or config.adapt > 0.0 or bool(config.latency)
    return uses_innovation or config.delay in ("larsen", "buffer")


def _choose_gain_rule(f: FilterMemory, config: FilterConfig, random: bool) -> int:
    """Choose where gains come from; `random`: whether the first sensor's delay is."""
    if config.row.family == "dual-rate":
        return GAIN.dual_rate
    if config.row.gains == "placed":
        return GAIN.joint
    pseudo = config.intersample == "pseudo-residual"
    is_multi_sensor, ignores_lag = len(config.sensors) > 1, f.frames.max() == 0
    impossible = ""
    if f.velocity > 0.0 or config.row.second:
        impossible = "its model changes with the yaw rate"
    elif pseudo:
        early = f"a sample must arrive before the next one is captured, got {config.sensors}"
        refusal = "no gains='covariance': it has one constant gain"
        is_refused = config.gains == "covariance"
        _refuse(config.name, (is_refused, refusal), (f.frames.max() > 1, early))
        return GAIN.pseudo
    elif any(model.biases for model in config.models):
        impossible = "a constant bias has no settled gain"
    elif is_multi_sensor or (random and not ignores_lag):
        impossible = "two slow sensors" if is_multi_sensor else "random delay"
    if impossible:
        text = f"no gains='periodic': {impossible}; use gains='covariance'"
        _refuse(config.name, (config.gains == "periodic", text))
        return GAIN.split if pseudo else GAIN.covariance
    default = "covariance" if _is_covariance_needed(config) else config.row.gains
    is_periodic = (config.gains or default) == "periodic"
    return GAIN.table if is_periodic else GAIN.covariance
