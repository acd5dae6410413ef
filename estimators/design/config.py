"""The options of a call, parsed to a `FilterConfig`; each error names filter, option and value."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.validation import describe_unknown
from ..core.late_samples import RULES
from ..core.memory import N_KNOTS
from ..filters import FilterDefinition
from .gains import DUAL_RATE_GAINS, DUAL_RATE_RULES, INVERSES, check_covariance
from .options import (
    BIASES,
    COURSE_SPEED,
    FAST_CHANNELS,
    FIND,
    INERTIAL,
    LATE,
    MEASUREMENTS,
    MODELS,
    NOISE,
    NOT_NEGATIVE,
    NUMBER,
    OPTIONS,
    POSITIVE,
    SCALE,
    STATES,
    TUNINGS,
    TYRES,
    WANDER,
    FilterConfig,
    FilterModel,
    NumberRule,
    select_states,
)

_GATE_PROBABILITY = 1.0 - 1e-9
_MAX_LATENCY = 0.5  # s, largest latency that may be configured
_LATENCY = NumberRule(f"is 0 to {_MAX_LATENCY} s or {FIND!r}", lambda v: 0.0 <= v <= _MAX_LATENCY)
_Values = dict[str, Any]  # options by name


# options that every filter has
_NUMBERS = ("satellites", "robust", "map_lag_sd", "noise_time", "adapt", "allow_unstable")
_DISTURBANCES = {"F_d", "N_d", "d", "d1", "d2", "d3"}
_BODY = ("phi", "phi_rate")  # of a bicycle whose accelerometer or roll rate is measured
_WALK = (("d1", "beta"), ("d2", "gamma"))  # dakf-stability (8)-(9), (14)
# states that disturbances are, and what they push; dual-rate (4): one for every state of (37)
_WALKS = {"none": (), "walk": _WALK, "walk-all": (*_WALK, ("d3", "psi")), "forces": ()}


class _Reader:
    """Keyword arguments of a filter by name; `check_unread` refuses those that were not read."""

    def __init__(self, name: str, options: Mapping[str, object]) -> None:
        self.name, self.passed, self._known = name, frozenset(options), list[str]()
        self._unread = dict(options)

    def add_defaults(self, defaults: Mapping[str, object]) -> None:
        """Add options that the caller left out."""
        self._unread = dict(defaults) | self._unread

    def read_raw(self, key: str, default: object = None) -> Any:
        """Read an option as it is."""
        self._known.append(key)
        return self._unread.pop(key, default)

    def read(self, *keys: str, default: object = None) -> _Values:
        """Read options that are numbers or flags, by their defaults and limits."""
        values: _Values = {}
        for key in keys:
            about, usual = OPTIONS[key].metadata, OPTIONS[key].default
            value = self.read_raw(key, usual if default is None else default)
            limits, unit = about["limits"], about["unit"]
            if value is not None or usual is not None:
                value = self.check_number(key, value, limits, unit) if limits else bool(value)
            values[key] = value
        return values

    def read_number(self, key: str, default: float, limits: NumberRule, unit: str = "") -> float:
        """Read a number that `OPTIONS` does not name; errors as in `check_number`."""
        return self.check_number(key, self.read_raw(key, default), limits, unit)

    def make_error(self, key: str, expected: str, value: object) -> ValueError:
        """Make the error for a value that an option cannot have; expected: "is ..."."""
        return ValueError(f"{self.name}: {key} {expected}, got {value!r}")

    def read_choice(self, key: str, default: str, known: Sequence[str]) -> str:
        """Read an option that is one of some words; else ValueError."""
        value = self.read_raw(key, default)
        if value not in known:
            raise self.make_error(key, f"is one of {', '.join(filter(None, known))}", value)
        return str(value)

    def check_number(self, key: str, value: object, limits: NumberRule, unit: str = "") -> float:
        """Convert to a number that fits; TypeError for no number, ValueError where it does not."""
        try:
            number = float(value)  # type: ignore[arg-type]  # anything that a user passes
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} is a number, got {value!r}") from None
        if not limits.fits(number):
            raise self.make_error(key, limits.expected.format(unit=unit), number)
        return number

    def read_array(self, key: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Convert an option's value to a new array of numbers; else TypeError."""
        try:
            return np.array(value, np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} holds numbers, got {value!r}") from None

    def check_unread(self) -> None:
        """Check that every option was read; else TypeError."""
        if self._unread:
            message = describe_unknown("option", sorted(self._unread), sorted(self._known))
            raise TypeError(f"{self.name}: {message}")


def parse_config(
    name: str, row: FilterDefinition, sensors: Mapping[str, SlowSensor],
    options: Mapping[str, object],
) -> FilterConfig:  # fmt: skip
    """Parse the options of a filter.

    TypeError says that an option is unknown or a value of the wrong type. ValueError says that a
    sensor is absent, a value out of range, or that options exclude each other.

    Args:
        name: Name of the filter.
        row: Its definition.
        sensors: Available slow sensors by name.
        options: Options of `make_estimator`.
    """
    reader = _Reader(name, options)
    used = _select_slow_sensors(row, sensors, reader)
    reader.add_defaults(_select_defaults(row, used, options))
    chosen: _Values = {"slow": used} | _parse_rules(row, used, reader)
    chosen |= _parse_inertial(row, used, reader)
    if row.model == "bicycle":
        disturbances = reader.read_choice("disturbances", row.disturbances, list(_WALKS))
        chosen |= {"disturbances": disturbances} | reader.read("steer_rate")
        first = _make_bicycle_model(used, chosen, rolls=chosen["fast"] != row.fast)
    else:
        first = MODELS[row.model]
    layers = (first, MODELS[row.second]) if row.second else (first,)
    states = [state for model in layers for state in model.names]
    if chosen["poles"] and len(chosen["poles"]) != len(states):
        text = f"are one for each of {', '.join(states)}"
        raise reader.make_error("poles", text, chosen["poles"])
    rows = [row for sensor in MEASUREMENTS.values() for row in sensor.rows]
    growing = [row.noise for row in rows if row.over_speed and f"{row.noise}_noise" not in options]
    noise = {
        key.removesuffix("_noise"): reader.read_number(key, sd, POSITIVE)
        for key, sd in NOISE.items()
    }
    if _DISTURBANCES & {*states}:
        chosen |= reader.read("leak")
    if first.forces:
        chosen |= reader.read("force_sd", "moment_sd", "disturbance_time", "moment_time")
        chosen |= reader.read("force_share", "moment_share")
    if first.forces and TYRES[0] in states:
        chosen |= reader.read("model_error")
    Q = _parse_covariance(states, TUNINGS.get((name, ",".join(used)), {}), reader)
    chosen |= {"noise": noise, "hdop_table": _parse_hdop_table(row, reader)}
    count = int(reader.read("wary")["wary"])
    wary = count if chosen["delay"] in ("clone", "buffer") else 0
    chosen |= reader.read(*_NUMBERS) | {"wary": wary}
    chosen |= reader.read("gate", default=_GATE_PROBABILITY if wary else None)
    chosen["latency"] = _parse_latency(reader, bool(used) and TYRES[0] in states)
    prior = _parse_prior(states, first.forces, chosen, reader)
    reader.check_unread()
    chosen["noise_over_speed"] = {key: noise[key] * COURSE_SPEED for key in growing}
    chosen["sensors"] = {sensor: sensors[sensor] for sensor in used}
    return FilterConfig(name=name, row=row, models=layers, Q=Q, prior=prior, **chosen)


def _make_bicycle_model(sensors: tuple[str, ...], chosen: _Values, rolls: bool) -> FilterModel:
    """Make the bicycle model with the states that slow sensors need; `rolls`: the body does."""
    states = select_states(sensors)
    lags = chosen["delay"] in ("literal", "lag") and "camera" in sensors  # tie-vision (12)-(13)
    late = tuple(LATE[state] for state in states if lags and state in LATE)
    walking = tuple(pair for pair in _WALKS[chosen["disturbances"]] if pair[1] in states)
    inputs = ("steer", "N_z", "curvature") if "psi" in states else ("steer", "N_z")
    forces, states = chosen["disturbances"] == "forces", states + _BODY * rolls
    biases = tuple(chosen["bias_sds"])
    return FilterModel(states, inputs, chosen["fast"], walking, forces, late, biases)


def _select_slow_sensors(
    row: FilterDefinition, available: Mapping[str, SlowSensor], reader: _Reader
) -> tuple[str, ...]:
    """Select the slow sensors to use, in the order of `SLOW_NAMES`."""
    slow = reader.read_raw("slow", None)
    if not row.slow:
        if slow is not None:
            raise ValueError(f"{reader.name} uses no slow sensor, got slow={slow!r}")
        return ()
    if slow is None:
        requested = [sensor for sensor in row.slow if sensor in available]
        requested = requested if row.uses_all else requested[:1]
        inertial = "accel_y" in dict(row.options).get("fast", row.fast)
        if not requested and (available or not inertial):
            requested = [" or ".join(row.slow)]
    else:
        requested = list(slow) if isinstance(slow, list | tuple) else [slow]
    for sensor in requested:
        if slow is not None and sensor not in row.slow:
            raise ValueError(f"{reader.name} can use {' or '.join(row.slow)}, got slow={slow!r}")
        if sensor not in available:
            present = ", ".join(available) or "none"
            raise ValueError(f"{reader.name} needs the slow sensor {sensor}; there is: {present}")
    return tuple(sensor for sensor in SLOW_NAMES if sensor in requested)


def _select_defaults(
    row: FilterDefinition, used: Sequence[str], options: Mapping[str, object]
) -> _Values:
    """Select a definition's options but those of states without a sensor or a deviation."""
    defaults = dict(row.options)
    fast = options.get("fast", defaults.get("fast", row.fast))
    sensors = {*used, *(fast if isinstance(fast, list | tuple) else [fast]), ""}
    left_out = set[str]()
    for name, sensor in BIASES.items():
        if sensor not in sensors or options.get(f"{name}_sd") == 0.0:
            left_out |= {f"{name}_sd", f"{name}_time", f"q_{name}"}
            left_out |= {"model_error"} if name == TYRES[0] else set()
    return {key: value for key, value in defaults.items() if key not in left_out}


def _parse_rules(row: FilterDefinition, used: Sequence[str], reader: _Reader) -> _Values:
    """Parse how gains are computed, and what happens to late samples and between samples."""
    is_dual_rate, is_placed = row.family == "dual-rate", row.gains == "placed"
    chosen: _Values = {"intersample": row.family, "poles": row.poles}
    if is_dual_rate or row.second:
        words = DUAL_RATE_RULES if is_dual_rate else (row.family, "predict")
        default = "pseudo" if is_dual_rate else row.family
        chosen["intersample"] = reader.read_choice("intersample", default, words)
    known_gains = DUAL_RATE_GAINS if is_dual_rate else ("", "periodic", "covariance")
    gains = row.gains if is_placed else reader.read_choice("gains", known_gains[0], known_gains)
    rule = chosen["intersample"]
    if gains == "from-29" and rule != "pseudo":
        raise reader.make_error("intersample", "is 'pseudo' for gains='from-29'", rule)
    if row.family == "single-rate":
        chosen["between"] = reader.read_choice("between", "hold", ("hold", "predict"))
        if chosen["between"] == "hold" and len(used) > 1:
            raise reader.make_error("slow", "is one sensor for between='hold'", used)
    inverse = reader.read_choice("inverse", INVERSES[0], INVERSES)
    delay = reader.read_choice("delay", row.delay, tuple(RULES))
    if delay in ("literal", "lag") and "camera" not in used:
        raise reader.make_error("delay", "needs the camera for tie-vision's rules", delay)
    if delay == "constant":
        chosen |= reader.read("assumed_delay")
    if gains == "placed":
        poles = reader.read_array("poles", reader.read_raw("poles", row.poles))
        is_negative = (poles < 0.0) & np.isfinite(poles)
        if poles.ndim != 1 or not len(poles) or not is_negative.all():
            raise reader.make_error("poles", "are negative numbers in rad/s", poles.tolist())
        chosen["poles"] = tuple(poles.tolist())
    return chosen | {"gains": gains, "inverse": inverse, "delay": delay}


def _parse_inertial(row: FilterDefinition, used: Sequence[str], reader: _Reader) -> _Values:
    """Parse the fast sensors, and the deviations and times of their biases by state."""
    if row.model != "bicycle" or row.gains != "covariance" or row.second:
        return {"fast": row.fast, "bias_sds": {}}
    value, known = reader.read_raw("fast", row.fast), INERTIAL
    words = list(value) if isinstance(value, list | tuple) else [value]
    fast = tuple(word for word in known if word in words)
    if len(fast) != len(words) or known[0] not in fast:
        raise reader.make_error("fast", f"is {known[0]!r} and any of {', '.join(known[1:])}", value)
    biases = {
        name: reader.read_number(f"{name}_sd", 0.0, NOT_NEGATIVE, STATES[name].unit)
        for name in BIASES
    }
    nominal = [name for name in TYRES if not biases[name] > 0.0]
    if nominal not in (list(TYRES), list(TYRES[2:]), []):
        raise ValueError(f"{reader.name}: {nominal[0]}_sd is above 0 where another tyre's state is")
    if biases[SCALE] > 0.0 and TYRES[0] in nominal:
        raise ValueError(f"{reader.name}: {SCALE}_sd needs tyres among the states: {TYRES[0]}_sd")
    biases = {name: sd for name, sd in biases.items() if sd > 0.0}
    times: dict[str, float] = {}
    for name in biases:
        option, usable = ("slow", used) if BIASES[name] in SLOW_NAMES else ("fast", fast)
        if BIASES[name] not in (*usable, ""):
            raise reader.make_error(f"{name}_sd", f"needs {BIASES[name]} among {option}", usable)
        if name in WANDER:
            key = f"{name}_time"
            times[name] = reader.read_number(key, 0.0, NOT_NEGATIVE, "s")
            if times[name] > 0.0 and f"q_{name}" in reader.passed:
                text = f"q_{name} is not used beside {key}, {times[name]:g} s, and {name}_sd"
                raise ValueError(f"{reader.name}: {text}")
    return {"fast": fast, "bias_sds": biases, "bias_times": times}


def _parse_latency(reader: _Reader, is_findable: bool) -> dict[str, float | str]:
    """Parse the latencies above zero (s, or `FIND` for one of them) by channel."""
    value = reader.read_raw("latency", {})
    if not isinstance(value, Mapping):
        raise TypeError(f"{reader.name}: latency is seconds by channel, got {value!r}")
    for channel in value:
        if channel not in FAST_CHANNELS:
            expected = f"is of {', '.join(FAST_CHANNELS)}"
            raise reader.make_error("latency", expected, dict(value))
    latencies: dict[str, float | str] = {}
    for channel, late in value.items():
        if late == FIND:
            latencies[channel] = FIND
        elif seconds := reader.check_number(f"latency of {channel}", late, _LATENCY):
            latencies[channel] = seconds
    if list(latencies.values()).count(FIND) > (1 if is_findable else 0):
        expected = f"is {FIND!r} for one channel of a filter with tyres as states and slow sensors"
        raise reader.make_error("latency", expected, dict(value))
    return latencies


def _parse_hdop_table(row: FilterDefinition, reader: _Reader) -> tuple[tuple[float, float], ...]:
    """Parse the knots (HDOP, factor on the GPS's standard deviation), or none."""
    table = reader.read_raw("hdop_table", row.hdop_table)
    if table is None or (isinstance(table, tuple) and not table):
        return ()
    knots = reader.read_array("hdop_table", table)
    is_valid = knots.ndim == 2 and knots.shape[1] == 2 and 2 <= len(knots) <= N_KNOTS
    if not (is_valid and (np.diff(knots[:, 0]) > 0.0).all() and (knots[:, 1] > 0.0).all()):
        expected = f"is 2 to {N_KNOTS} pairs (HDOP, factor) with rising HDOP and positive factors"
        raise reader.make_error("hdop_table", expected, table)
    return tuple((float(hdop), float(factor)) for hdop, factor in knots)


def _parse_covariance(states: Sequence[str], tuning: Mapping[str, float], reader: _Reader) -> Array:
    """Parse Q per second, shape (n, n): the tuning's or the option's, with each `q_STATE` in it."""
    n, matrix = len(states), reader.read_raw("Q")
    tuned_diagonal = [tuning.get(state, 0.0) for state in states]
    Q = reader.read_array("Q", tuned_diagonal if matrix is None else matrix)
    if Q.shape not in ((n,), (n, n)):
        raise ValueError(f"{reader.name}: Q has shape ({n}, {n}) or ({n},), got {Q.shape}")
    Q = np.diag(Q) if Q.ndim == 1 else Q
    for i, state in enumerate(states):
        Q[i, i] = reader.read_number(f"q_{state}", float(Q[i, i]), NUMBER)
    check_covariance(f"{reader.name}: Q", Q)
    return Q


def _parse_prior(
    states: Sequence[str], has_forces: bool, chosen: _Values, reader: _Reader
) -> dict[str, float]:
    """Parse the standard deviation of every state at the start, in the state's unit."""
    deviations: dict[str, float] = {state: STATES[state].prior for state in states}
    deviations |= chosen["bias_sds"]
    if has_forces:
        deviations |= {"F_d": chosen["force_sd"], "N_d": chosen["moment_sd"]}
    prior = reader.read_raw("prior", {})
    if not isinstance(prior, Mapping):
        raise TypeError(f"{reader.name}: prior is standard deviations by state, got {prior!r}")
    for state, value in prior.items():
        if state not in states:
            text = f"has no state {state!r}; it has: {', '.join(states)}; prior={prior}"
            raise ValueError(f"{reader.name} {text}")
        sd = reader.read_array(f"the prior of {state}", value)
        if sd.ndim > 0 or not 0.0 <= sd < math.inf:
            raise reader.make_error(f"the prior of {state}", "is a standard deviation", value)
        deviations[state] = float(sd)
    return deviations
