"""The options of a call, parsed to a `FilterConfig`; each error names filter, option and value."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ...envs.sensors.slow import SLOW_NAMES
from ...envs.validation import describe_unknown
from ..core.innovation import RULES
from ..core.record import N_KNOTS
from ..filters import FilterDefinition
from . import dual_rate, models
from .kalman import INVERSES, check_covariance
from .models import BIASES, SCALE, STATES, TYRES, WANDER
from .options import DISTURBANCE, EXTRA_NOISE, FAST_CHANNELS, FIND, NOISE, TUNINGS
from .options import FilterConfig as FilterConfig

_GATE_PROBABILITY = 1.0 - 1e-9
_MIN_SATELLITES = 4.0  # double-layer-gps 4.3
_ASSUMED_DELAY = 0.033  # s
_MAX_LATENCY = 0.5  # s, largest latency that may be configured
_MAX_MEMBERS = 8
_N_IMM_MEMBERS = 4


_Fits = Callable[[float], bool]


class _Reader:
    """Keyword arguments of a filter by name; `check_unread` refuses those that were not read."""

    def __init__(self, name: str, options: Mapping[str, object]) -> None:
        self.name, self._unread, self._known = name, dict(options), list[str]()

    def __contains__(self, key: str) -> bool:
        return key in self._unread

    def read_value(self, key: str, default: Any) -> Any:
        """Read an option as it is."""
        self._known.append(key)
        return self._unread.pop(key, default)

    def make_error(self, key: str, expected: str, value: object) -> ValueError:
        """Make the error for a value that an option cannot have; expected: "is ..."."""
        return ValueError(f"{self.name}: {key} {expected}, got {value!r}")

    def read_choice(self, key: str, default: str, known: Sequence[str]) -> str:
        """Read an option that is one of some words; else ValueError."""
        value = self.read_value(key, default)
        if value not in known:
            raise self.make_error(key, f"is one of {', '.join(filter(None, known))}", value)
        return str(value)

    def read_choices(
        self, key: str, default: Sequence[str], known: Sequence[str]
    ) -> tuple[str, ...]:
        """Read the first of some words and any others, in the order of `known`; else ValueError."""
        value = self.read_value(key, default)
        words = list(value) if isinstance(value, list | tuple) else [value]
        chosen = tuple(word for word in known if word in words)
        if len(chosen) != len(words) or known[0] not in chosen:
            raise self.make_error(key, f"is {known[0]!r} and any of {', '.join(known[1:])}", value)
        return chosen

    def read_non_negative(self, key: str, unit: str) -> float:
        """Read a number that is 0 or more."""
        expected = f"is in {unit} and not negative"
        return self.read_number(key, 0.0, expected, lambda v: 0.0 <= v < np.inf)

    def read_number(
        self, key: str, default: float, expected: str = "", fits: _Fits = lambda _: True
    ) -> float:
        """Read an option that is a number; errors as in `check_number`."""
        return self.check_number(key, self.read_value(key, default), expected, fits)

    def read_positive(self, key: str, default: float) -> float:
        """Read a number above zero."""
        expected = "must be positive and finite"
        return self.read_number(key, default, expected, lambda v: 0.0 < v < np.inf)

    def check_number(
        self, key: str, value: object, expected: str = "", fits: _Fits = lambda _: True
    ) -> float:
        """Convert to a number that fits; TypeError for no number, ValueError where it does not."""
        try:
            number = float(value)  # type: ignore[arg-type]  # anything that a user passes
        except (TypeError, ValueError):
            raise TypeError(f"{self.name}: {key} is a number, got {value!r}") from None
        if not fits(number):
            raise self.make_error(key, expected, number)
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
    name: str,
    row: FilterDefinition,
    sensors: Mapping[str, SlowSensor],
    options: Mapping[str, object],
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
    reader = _Reader(name, dict(row.options) | dict(options))
    used = _select_slow_sensors(row, sensors, reader)
    rules = _parse_rules(row, used, reader)
    fast, biases = _parse_inertial(row, reader)
    if row.model == "bicycle":
        disturbances = reader.read_choice("disturbances", row.disturbances, models.DISTURBANCES)
        late, rolls = rules["delay"] in ("literal", "lag"), fast != row.fast
        first = models.make_bicycle_model(used, fast, disturbances, late, rolls, tuple(biases))
    else:
        first = models.MODELS[row.model]
    layers = (first, models.MODELS[row.second]) if row.second else (first,)
    states = [state for model in layers for state in model.names]
    if rules["poles"] and len(rules["poles"]) != len(states):
        raise reader.make_error("poles", f"are one for each of {', '.join(states)}", rules["poles"])
    noise, noise_over_speed = _parse_noise(first.forces, reader)
    is_steered = first.inputs[0] == "steer"
    config = FilterConfig(
        name=name,
        row=row,
        sensors={sensor: sensors[sensor] for sensor in used},
        models=layers,
        **rules,
        leak=reader.read_non_negative("leak", "1/s"),
        Q=_parse_process_noise(states, TUNINGS.get((name, ",".join(used)), {}), reader),
        noise=noise,
        noise_over_speed=noise_over_speed,
        hdop_table=_parse_hdop_table(row, reader),
        satellites=reader.read_number("satellites", _MIN_SATELLITES),
        **_parse_gate(rules["delay"], reader),
        **_parse_bank(states, first.forces, rules["delay"], reader),
        robust=reader.read_non_negative("robust", "standard deviations"),
        steer_rate=reader.read_non_negative("steer_rate", "rad/s") if is_steered else 0.0,
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
    row: FilterDefinition, available: Mapping[str, SlowSensor], reader: _Reader
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
            present = ", ".join(available) or "none"
            raise ValueError(f"{reader.name} needs the slow sensor {sensor}; there is: {present}")
    return tuple(sensor for sensor in SLOW_NAMES if sensor in requested)


def _parse_rules(row: FilterDefinition, used: Sequence[str], reader: _Reader) -> dict[str, Any]:
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
    row: FilterDefinition, reader: _Reader
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Parse the fast sensors, and the standard deviations of their biases by state."""
    if row.model != "bicycle" or row.gains != "covariance" or row.second:
        return row.fast, {}
    fast = reader.read_choices("fast", row.fast, models.INERTIAL)
    biases = {name: reader.read_non_negative(f"{name}_sd", STATES[name].unit) for name in BIASES}
    known = [name for name in TYRES if not biases[name] > 0.0]
    if known not in (list(TYRES), list(TYRES[2:]), []):
        raise ValueError(f"{reader.name}: {known[0]}_sd is above 0 where another tyre's state is")
    if biases[SCALE] > 0.0 and TYRES[0] in known:
        raise ValueError(f"{reader.name}: {SCALE}_sd needs tyres among the states: {TYRES[0]}_sd")
    for name, sd in biases.items():
        if sd > 0.0 and BIASES[name] not in (*fast, ""):
            raise reader.make_error(f"{name}_sd", f"needs {BIASES[name]} among fast", fast)
    return fast, {name: sd for name, sd in biases.items() if sd > 0.0}


def _parse_gate(delay: str, reader: _Reader) -> dict[str, Any]:
    """Parse `gate` and `wary` of a `FilterConfig`."""
    count = reader.read_number("wary", 0.0, "is a number of samples", lambda v: v in range(1000))
    wary = int(count) if delay in ("clone", "buffer") else 0
    gate = reader.read_value("gate", _GATE_PROBABILITY if wary else None)
    if gate is not None:
        expected = "is a probability between 0 and 1"
        gate = reader.check_number("gate", gate, expected, lambda v: 0.0 < v < 1.0)
    return {"gate": gate, "wary": wary}


def _parse_latency(reader: _Reader, is_findable: bool) -> dict[str, float | str]:
    """Parse the latencies above zero (s, or `FIND` for one of them) by channel."""
    value = reader.read_value("latency", {})
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


def _parse_noise(forces: bool, reader: _Reader) -> tuple[dict[str, float], dict[str, float]]:
    """Parse `FilterConfig.noise` and `FilterConfig.noise_over_speed`."""
    rows = [row for sensor in models.MEASUREMENTS.values() for row in sensor.rows]
    growing = [row.noise for row in rows if row.over_speed and f"{row.noise}_noise" not in reader]
    sds = NOISE | EXTRA_NOISE
    noise = {key.removesuffix("_noise"): reader.read_positive(key, sd) for key, sd in sds.items()}
    if forces:
        keys = zip(("force", "moment", "time"), DISTURBANCE.items(), strict=True)
        noise |= {short: reader.read_positive(key, default) for short, (key, default) in keys}
    return noise, {name: noise[name] * models.COURSE_SPEED for name in growing}


def _parse_hdop_table(row: FilterDefinition, reader: _Reader) -> tuple[tuple[float, float], ...]:
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


def _parse_bank(states: Sequence[str], forces: bool, delay: str, reader: _Reader) -> dict[str, Any]:
    """Parse `members`, `levels` and `sudden` of a `FilterConfig`."""
    value = reader.read_value("levels", (1.0,))
    levels = reader.read_array("levels", value)
    pairs = levels.reshape(-1, 1).repeat(2, 1) if levels.ndim < 2 else levels
    fits = pairs.shape[1:] == (2,) and 1 <= len(pairs) <= _MAX_MEMBERS
    if not (fits and (pairs > 0.0).all() and np.isfinite(pairs).all()):
        expected = f"are 1 to {_MAX_MEMBERS} positive factors or pairs"
        raise reader.make_error("levels", expected, value)
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
    states: Sequence[str], tuning: Mapping[str, float], reader: _Reader
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
    reader: _Reader,
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
