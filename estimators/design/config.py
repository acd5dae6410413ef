"""The options of a filter: `FilterConfig` holds them, `parse_config` parses and checks them.

Each error names filter, option and value.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ..core.innovation import RULES
from ..core.record import N_KNOTS
from ..filters import FilterDefinition
from . import dual_rate
from .kalman import INVERSES, check_covariance
from .models import (
    BIASES,
    COURSE_SPEED,
    DISTURBANCES,
    INERTIAL,
    MEASUREMENTS,
    MODELS,
    SCALE,
    STATES,
    TYRES,
    WANDER,
    FilterModel,
    make_bicycle_model,
)
from .options import (
    DISTURBANCE,
    EXTRA_NOISE,
    FAST_CHANNELS,
    FIND,
    NOISE,
    TUNINGS,
    OptionReader,
)

_GATE_PROBABILITY = 1.0 - 1e-9
_MIN_SATELLITES = 4.0  # double-layer-gps 4.3
_ASSUMED_DELAY = 0.033  # s
_MAX_LATENCY = 0.5  # s, of a latency that is known
_MAX_MEMBERS = 8
_N_IMM_MEMBERS = 4


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """Decisions about a filter before its design: its name in `FILTERS` and its options.

    Options, as `make_estimator` takes them
    ---------------------------------------
    slow: the slow sensor to use (default: the first of the row's that is there). A filter with
        gains "covariance" also takes several.
    gains: "periodic" (precomputed for a schedule that repeats) or "covariance"; of dual-rate
        "constant", "from-29" or "placed" (with poles).
    delay: the rule for late samples, see `sideslip.estimators.core.innovation`: "clone" or "buffer"
        (exact), "larsen", "stored", "constant" (with assumed_delay, s), "literal", "lag", "ignore".
    between: of single-rate-kf, "hold" (default) or "predict" between its steps.
    intersample: of double-layer "pseudo-residual" (default) or "predict"; of dual-rate "pseudo"
        (default), "predict", "hold" or "oh".
    inverse: the generalised inverse of the pseudo-residual rule, "moore-penrose", "p-weighted",
        "tikhonov" or "bayes".
    poles: negative numbers in rad/s, one for each state, where gains are placed: of the filter's
        error, of dual-rate as `sideslip.estimators.DualRate` says.
    disturbances: of a bicycle, "none", "walk" (d1 and d2 push beta and gamma), "walk-all" (d3
        pushes psi) or "forces" (an Ornstein-Uhlenbeck force and moment).
    leak: 1/s, by which disturbances decay on top of that.
    fast: of exact-kf, course-kf and dakf, what is measured in every row: "gyro" (default), and any
        of "accel_y" and "roll_rate", with which the body rolls: states phi and phi_rate.
    front_tyres_sd, rear_tyres_sd, inverse_friction_sd: of the same, above 0 (default of all but
        joint) states: factors on both stiffnesses, and the reciprocal of friction, tyres having no
        limit where it is known. The model is then expanded at the estimate (an EKF).
    accel_scale_sd: of joint, above 0 (default) a state: the fraction by which the accelerometer
        measures too much, as one does whose roll is not known.
    bias_sd (rad/s), accel_bias_sd (m/s2), bank_sd (rad): of the same, above 0 (default) a state
        `bias`, `accel_bias` or `bank`, a constant of this deviation that the sensor adds, or by
        which the road leans, the left side up; with q_bias, ... it walks, with bias_time, ... (s)
        above 0 it wanders about 0 with that deviation and forgets within that time.
    q_beta, q_gamma, ...: process noise of a state per second, (unit)^2/s; or Q, (n, n) or (n,)
        (default: of `tunings.toml`).
    gyro_noise (rad/s), psi_noise (rad), y_l_noise (m), course_noise (rad at every speed; default
        0.14 deg at 60 km/h growing as 1/V), accel_y_noise (m/s2), roll_rate_noise (rad/s),
        wheel_noise, gps_speed_noise (m/s): standard deviations.
    hdop_table: pairs (HDOP, factor on the GPS's noise), linear in between; None for one noise at
        every HDOP (default: the factor is the HDOP for double-layer, None for the others).
    satellites: the least that a GPS fix needs (default 4).
    robust: standard deviations of an innovation from which it counts less (Huber); 0: none does.
    steer_rate: rad/s; a steering angle that changes faster is skipped until the next row confirms
        it; 0 (default of all but joint-robust): none is.
    force_share, moment_share: fractions of the car's weight, and of that at half the wheelbase,
        that are added to force_sd and moment_sd, as variances (default 0).
    model_error: of joint, the fraction of the axles' forces by which its tyres err, added likewise.
    accel_time: s; above 0 the accelerometer's noise is found while driving, over so long; then
        `accel_y_noise` is the least.
    members: of joint, the number of filters side by side, of which the least likely forgets the
        tyres twice a second (default: one for each of `levels`).
    levels: of joint, factors on force_sd and moment_sd, or pairs of one for each, which its members
        take in turn; the likeliest counts most (default (1,)).
    sudden: of joint, True runs four filters side by side that interact: nothing happens, a gust
        blows, the tyres have just changed, they settle; then neither members nor levels.
    gate: a probability; a sample whose innovation is less likely than 1 - gate is skipped.
    wary: 0 is off (default; joint and joint-robust have 10). Above, with delay "clone" or "buffer":
        a packet that repeats the last one while the car moves is skipped; the gate is 1 - 1e-9
        where none is configured, a sensor's first sample passes it, and after so many gated samples
        in a row that agree with each other the filter begins anew with the sensor.
    adapt: fraction of a new innovation in an R that follows them (0: R as configured).
    force_sd (N), moment_sd (N m), disturbance_time (s): of disturbances that are forces.
    latency: s by which fast channels (steer, gyro, accel_x, accel_y, roll_rate, wheels) stand too
        late in the record, {"gyro": 0.06}; "find" for one that joint finds while driving.
    prior: standard deviations of states at the start, by state.
    allow_unstable: build a filter whose error grows.
    """

    name: str
    row: FilterDefinition
    sensors: Mapping[str, SlowSensor]  # `slow`, in the order of SLOW_NAMES
    models: tuple[FilterModel, ...]  # of each layer
    gains: str  # "": the row's, where that can be
    delay: str
    assumed_delay: float
    between: str
    intersample: str
    inverse: str
    poles: tuple[float, ...]
    leak: float
    Q: Array  # (n, n) per second, of the states of all layers
    noise: Mapping[str, float]  # standard deviations, names without "_noise"; force, moment, time
    noise_over_speed: Mapping[str, float]  # of those that grow as 1/V, times V in m/s
    hdop_table: tuple[tuple[float, float], ...]
    satellites: float
    gate: float | None
    wary: int
    members: int
    levels: Array  # (count, 2), of force_sd, moment_sd
    sudden: bool
    robust: float
    steer_rate: float
    model_error: float
    accel_time: float
    shares: tuple[float, float]
    times: Mapping[str, float]  # s, of biases
    adapt: float
    prior: Mapping[str, float]  # of all states
    latency: Mapping[str, float | str]  # s, or "find", by channel; none that is punctual
    allow_unstable: bool

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states of all layers."""
        return tuple(self.prior)


def parse_config(
    name: str, row: FilterDefinition, sensors: Mapping[str, SlowSensor], options: Mapping[str, Any]
) -> FilterConfig:
    """Parse the options of a filter.

    TypeError says that an option is unknown or a value of the wrong type. ValueError says that a
    sensor is absent, a value out of range, or that options exclude each other.

    Args:
        name: Name of the filter.
        row: Its definition.
        sensors: Available slow sensors by name.
        options: Options of `make_estimator`.

    Returns:
        The complete options.

    Raises:
        reader.make_error: The ValueError for poles that are not one a state.
    """
    reader = OptionReader(name, dict(row.options) | dict(options))
    used = _select_slow_sensors(row, sensors, reader)
    rules = _parse_rules(row, used, reader)
    fast, biases = _parse_inertial(row, reader)
    if row.model == "bicycle":
        disturbances = reader.read_choice("disturbances", row.disturbances, DISTURBANCES)
        late, rolls = rules["delay"] in ("literal", "lag"), fast != row.fast
        first = make_bicycle_model(used, fast, disturbances, late, rolls, tuple(biases))
    else:
        first = MODELS[row.model]
    models = (first, MODELS[row.second]) if row.second else (first,)
    states = [state for model in models for state in model.names]
    if rules["poles"] and len(rules["poles"]) != len(states):
        raise reader.make_error("poles", f"are one for each of {', '.join(states)}", rules["poles"])
    noise, noise_over_speed = _parse_noise(models[0].forces, reader)
    steered = models[0].inputs[0] == "steer"
    config = FilterConfig(
        name=name,
        row=row,
        sensors={sensor: sensors[sensor] for sensor in used},
        models=models,
        **rules,
        leak=reader.read_non_negative("leak", "1/s"),
        Q=_parse_process_noise(states, TUNINGS.get((name, ",".join(used)), {}), reader),
        noise=noise,
        noise_over_speed=noise_over_speed,
        hdop_table=_parse_hdop_table(row, reader),
        satellites=reader.read_number("satellites", _MIN_SATELLITES),
        **_parse_gate(rules["delay"], reader),
        **_parse_bank(states, models[0].forces, rules["delay"], reader),
        robust=reader.read_non_negative("robust", "standard deviations"),
        steer_rate=reader.read_non_negative("steer_rate", "rad/s") if steered else 0.0,
        model_error=reader.read_non_negative("model_error", "shares of a force"),
        accel_time=reader.read_non_negative("accel_time", "s"),
        shares=(
            reader.read_non_negative("force_share", "1"),
            reader.read_non_negative("moment_share", "1"),
        ),
        times={
            name: reader.read_non_negative(f"{name}_time", "s") for name in biases if name in WANDER
        },
        adapt=reader.read_number("adapt", 0.0, "is a share from 0 to 1", lambda v: 0.0 <= v < 1.0),
        prior=_parse_prior(states, noise, biases, reader),
        latency=_parse_latency(reader, bool(used) and TYRES[0] in states),
        allow_unstable=bool(reader.read_value("allow_unstable", False)),
    )
    reader.check_unread()
    return config


def _select_slow_sensors(
    row: FilterDefinition, available: Mapping[str, SlowSensor], reader: OptionReader
) -> tuple[str, ...]:
    """Select the slow sensors to use, in the order of `SLOW_NAMES`."""
    slow = reader.read_value("slow", None)
    if not row.slow:
        if slow is not None:
            raise ValueError(f"{reader.name} uses no slow sensor, got slow={slow!r}")
        return ()
    if slow is None:
        requested = [sensor for sensor in row.slow if sensor in available][:1]
        inertial = "accel_y" in dict(row.options).get("fast", row.fast)
        if not requested and (available or not inertial):
            requested = [" or ".join(row.slow)]
    else:
        requested = list(slow) if isinstance(slow, list | tuple) else [slow]
    for sensor in requested:
        if slow is not None and sensor not in row.slow:
            raise ValueError(f"{reader.name} can use {' or '.join(row.slow)}, got slow={slow!r}")
        if sensor not in available:
            present_names = ", ".join(available) or "none"
            raise ValueError(
                f"{reader.name} needs the slow sensor {sensor}; there is: {present_names}"
            )
    return tuple(sensor for sensor in SLOW_NAMES if sensor in requested)


def _parse_rules(
    row: FilterDefinition, used: Sequence[str], reader: OptionReader
) -> dict[str, Any]:
    """Parse how gains are computed, and what happens to late samples and between samples."""
    is_dual_rate, is_placed = row.intersample == "dual-rate", row.gains == "placed"
    intersample, between, assumed, poles = row.intersample, "hold", 0.0, row.poles
    if is_dual_rate:
        intersample = reader.read_choice("intersample", "pseudo", dual_rate.RULES)
    elif row.second:
        intersample = reader.read_choice("intersample", intersample, (intersample, "predict"))
    known_gains = dual_rate.GAINS if is_dual_rate else ("", "periodic", "covariance")
    gains = row.gains if is_placed else reader.read_choice("gains", known_gains[0], known_gains)
    if gains == "from-29" and intersample != "pseudo":
        raise reader.make_error("intersample", "is 'pseudo' for gains='from-29'", intersample)
    if intersample == "single-rate":
        between = reader.read_choice("between", between, ("hold", "predict"))
        if between == "hold" and len(used) > 1:
            raise reader.make_error("slow", "is one sensor for between='hold'", used)
    inverse = reader.read_choice("inverse", INVERSES[0], INVERSES)
    delay = reader.read_choice("delay", row.delay, RULES)
    if delay in ("literal", "lag") and "camera" not in used:
        raise reader.make_error("delay", "needs the camera for tie-vision's rules", delay)
    if delay == "constant":
        assumed = reader.read_positive("assumed_delay", _ASSUMED_DELAY)
    if gains == "placed":
        placed = reader.read_array("poles", reader.read_value("poles", poles))
        negative = (placed < 0.0) & np.isfinite(placed)
        if placed.ndim != 1 or not len(placed) or not negative.all():
            raise reader.make_error("poles", "are negative numbers in rad/s", placed.tolist())
        poles = tuple(placed.tolist())
    names = ("gains", "delay", "assumed_delay", "between", "intersample", "inverse", "poles")
    values = (gains, delay, assumed, between, intersample, inverse, poles)
    return dict(zip(names, values, strict=True))


def _parse_inertial(
    row: FilterDefinition, reader: OptionReader
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Parse the fast sensors, and the standard deviations of their biases by state."""
    if row.model != "bicycle" or row.gains != "covariance" or row.second:
        return row.fast, {}
    fast = reader.read_choices("fast", row.fast, INERTIAL)
    biases = {name: reader.read_non_negative(f"{name}_sd", STATES[name].unit) for name in BIASES}
    known_tyres = [name for name in TYRES if not biases[name] > 0.0]
    if known_tyres not in (list(TYRES), list(TYRES[2:]), []):
        raise ValueError(
            f"{reader.name}: {known_tyres[0]}_sd is above 0 where another tyre's state is"
        )
    if biases[SCALE] > 0.0 and TYRES[0] in known_tyres:
        raise ValueError(f"{reader.name}: {SCALE}_sd needs tyres among the states: {TYRES[0]}_sd")
    for name, sd in biases.items():
        if sd > 0.0 and BIASES[name] not in (*fast, ""):
            raise reader.make_error(f"{name}_sd", f"needs {BIASES[name]} among fast", fast)
    return fast, {name: sd for name, sd in biases.items() if sd > 0.0}


def _parse_gate(delay: str, reader: OptionReader) -> dict[str, Any]:
    """Parse `gate` and `wary` of a `FilterConfig`."""
    count = reader.read_number("wary", 0.0, "is a number of samples", lambda v: v in range(1000))
    wary = int(count) if delay in ("clone", "buffer") else 0
    gate = reader.read_value("gate", _GATE_PROBABILITY if wary else None)
    if gate is not None:
        expected = "is a probability between 0 and 1"
        gate = reader.check_number("gate", gate, expected, lambda v: 0.0 < v < 1.0)
    return {"gate": gate, "wary": wary}


def _parse_latency(reader: OptionReader, is_findable: bool) -> dict[str, float | str]:
    """Parse the latencies above zero (s, or `FIND` for one of them) by channel."""
    value: Any = reader.read_value("latency", {})
    if not isinstance(value, Mapping):
        raise TypeError(f"{reader.name}: latency is seconds by channel, got {value!r}")
    for channel in value:
        if channel not in FAST_CHANNELS:
            raise reader.make_error("latency", f"is of {', '.join(FAST_CHANNELS)}", dict(value))
    latencies: dict[str, float | str] = {}
    for channel, late in value.items():
        expected = f"is 0 to {_MAX_LATENCY} s or {FIND!r}"
        if late == FIND:
            latencies[channel] = FIND
        elif reader.check_number(
            f"latency of {channel}", late, expected, lambda s: 0 <= s <= _MAX_LATENCY
        ):
            latencies[channel] = float(late)
    if list(latencies.values()).count(FIND) > (1 if is_findable else 0):
        expected = f"is {FIND!r} for one channel of a filter with tyres as states and slow sensors"
        raise reader.make_error("latency", expected, dict(value))
    return latencies


def _parse_noise(forces: bool, reader: OptionReader) -> tuple[dict[str, float], dict[str, float]]:
    """Parse `FilterConfig.noise` and `FilterConfig.noise_over_speed`."""
    rows = [row for sensor in MEASUREMENTS.values() for row in sensor.rows]
    speed_dependent = [
        row.noise for row in rows if row.over_speed and f"{row.noise}_noise" not in reader
    ]
    levels = NOISE | EXTRA_NOISE
    noise = {
        key.removesuffix("_noise"): reader.read_positive(key, sd) for key, sd in levels.items()
    }
    if forces:
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: reader.read_positive(key, default) for short, (key, default) in keys}
    return noise, {name: noise[name] * COURSE_SPEED for name in speed_dependent}


def _parse_hdop_table(
    row: FilterDefinition, reader: OptionReader
) -> tuple[tuple[float, float], ...]:
    """Parse the knots (HDOP, factor on the GPS's standard deviation), or none."""
    table = reader.read_value("hdop_table", row.hdop)
    if table is None or (isinstance(table, tuple) and not table):
        return ()
    knots = reader.read_array("hdop_table", table)
    is_valid = knots.ndim == 2 and knots.shape[1] == 2 and 2 <= len(knots) <= N_KNOTS
    if not (is_valid and (np.diff(knots[:, 0]) > 0.0).all() and (knots[:, 1] > 0.0).all()):
        expected = f"is 2 to {N_KNOTS} pairs (HDOP, factor) with rising HDOP and positive factors"
        raise reader.make_error("hdop_table", expected, table)
    return tuple((float(hdop), float(factor)) for hdop, factor in knots)


def _parse_bank(
    states: Sequence[str], forces: bool, delay: str, reader: OptionReader
) -> dict[str, Any]:
    """Parse `members`, `levels` and `sudden` of a `FilterConfig`."""
    value = reader.read_value("levels", (1.0,))
    levels = reader.read_array("levels", value)
    pairs = levels.reshape(-1, 1).repeat(2, 1) if levels.ndim < 2 else levels
    fits = pairs.shape[1:] == (2,) and 1 <= len(pairs) <= _MAX_MEMBERS
    if not (fits and (pairs > 0.0).all() and np.isfinite(pairs).all()):
        raise reader.make_error(
            "levels", f"are 1 to {_MAX_MEMBERS} positive factors or pairs", value
        )
    expected = f"is a number of filters from 1 to {_MAX_MEMBERS}"
    count = reader.read_number(
        "members", len(pairs), expected, lambda v: v in range(1, _MAX_MEMBERS + 1)
    )
    if count > 1 and TYRES[0] not in states:
        raise reader.make_error("members", "is 1 where tyres are known", count)
    if (pairs != 1.0).any() and not (forces and 1 < count >= len(pairs)):
        raise reader.make_error("levels", "need disturbances='forces' and a member each", value)
    sudden = bool(reader.read_value("sudden", False))
    if sudden and not (count == 1 and TYRES[0] in states and forces and delay == "clone"):
        expected = "needs unknown tyres, disturbances='forces', delay='clone', no members or levels"
        raise reader.make_error("sudden", expected, sudden)
    return {"members": _N_IMM_MEMBERS if sudden else int(count), "levels": pairs, "sudden": sudden}


def _parse_process_noise(
    states: Sequence[str], tuning: Mapping[str, float], reader: OptionReader
) -> Array:
    """Parse Q per second, shape (n, n): the tuning's or the option's, with each `q_STATE` in it."""
    n, matrix = len(states), reader.read_value("Q", None)
    tuned_diagonal = [tuning.get(state, 0.0) for state in states]
    Q = reader.read_array("Q", tuned_diagonal if matrix is None else matrix)
    if Q.shape not in ((n,), (n, n)):
        raise ValueError(f"{reader.name}: Q has shape ({n}, {n}) or ({n},), got {Q.shape}")
    Q = np.diag(Q) if Q.ndim == 1 else Q
    for i, state in enumerate(states):
        Q[i, i] = reader.read_number(f"q_{state}", float(Q[i, i]))
    check_covariance(f"{reader.name}: Q", Q)
    return Q


def _parse_prior(
    states: Sequence[str],
    noise: Mapping[str, float],
    biases: Mapping[str, float],
    reader: OptionReader,
) -> dict[str, float]:
    """Parse the standard deviation of every state at the start, in the state's unit."""
    deviations = {state: STATES[state].prior for state in states} | dict(biases)
    if "force" in noise:
        deviations |= {"F_d": noise["force"], "N_d": noise["moment"]}
    prior = reader.read_value("prior", {})
    if not isinstance(prior, Mapping):
        raise TypeError(f"{reader.name}: prior is standard deviations by state, got {prior!r}")
    for state, value in prior.items():
        if state not in states:
            known = ", ".join(states)
            raise ValueError(
                f"{reader.name} has no state {state!r}; it has: {known}; prior={prior}"
            )
        sd = reader.read_array(f"the prior of {state}", value)
        if sd.ndim > 0 or not 0.0 <= sd < math.inf:
            raise reader.make_error(f"the prior of {state}", "is a standard deviation", value)
        deviations[state] = float(sd)
    return deviations
