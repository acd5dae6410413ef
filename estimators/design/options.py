"""The models of filters, what their sensors measure, their options and the tuned process noise.

A model's first states follow its physics ("dense"), the disturbances behind them decay by
themselves. Messages, the signature of `make_estimator` and the docs of `FilterOptions` come from
its fields. `tunings.toml` has the process noise of filters as `sideslip tune estimator` found it.
"""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from inspect import Parameter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import FAST, Array
from ...envs.sensors.link import SlowSensor
from ..core.late_samples import RULES
from ..filters import FilterDefinition
from .gains import INVERSES

COURSE_SPEED = 60.0 / 3.6  # m/s at which the receivers' course noise is quoted


class MeasurementRow(NamedTuple):
    """One value of a packet as a measurement: a sum of states."""

    states: tuple[str, ...]
    noise: str  # its standard deviation is the option `<noise>_noise`
    sd: float  # default of that option, in the unit of the value
    angle: bool = False  # the innovation is wrapped
    over_speed: bool = False  # the default, of `COURSE_SPEED`, grows as 1/V; an option is unscaled
    ground: bool = False  # a direction over the ground, where psi is relative to the road


@dataclass(frozen=True)
class Measurement:
    """A slow sensor as a filter sees it."""

    rows: tuple[MeasurementRow, ...]  # sums of a bicycle's states, for the packet's first values
    velocities: tuple[MeasurementRow, ...] = ()  # rows of a second layer, in their place
    heading_fix: bool = False  # its first sample, where it is far off, sets psi


MEASUREMENTS: dict[str, Measurement] = {
    "camera": Measurement(
        (MeasurementRow(("psi",), "psi", 3.5e-3, angle=True), MeasurementRow(("y_l",), "y_l", 0.02))
    ),
    "gps": Measurement(
        (MeasurementRow(("beta", "psi"), "course", math.radians(0.14), True, True, ground=True),),
        (
            MeasurementRow(("v_x",), "gps_speed", 0.05),
            MeasurementRow(("v_y",), "gps_speed", 0.05),
        ),  # double-layer-gps (41)
        heading_fix=True,
    ),
}
"""What each slow sensor measures, by its name."""


class StateInfo(NamedTuple):
    """A state of a model; numbers are in its unit."""

    unit: str
    prior: float  # usual standard deviation at the start
    bound: float  # largest magnitude of an estimate in an observation


TYRES = ("front_tyres", "rear_tyres", "inverse_friction")
STATES = {
    "beta": StateInfo("rad", 0.02, np.pi / 2.0),
    "gamma": StateInfo("rad/s", 0.05, 10.0),
    "psi": StateInfo("rad", 0.05, np.pi),
    "y_l": StateInfo("m", 0.3, 200.0),
    "psi_late": StateInfo("rad", 0.05, np.pi),
    "y_l_late": StateInfo("m", 0.3, 200.0),
    **dict.fromkeys(("v_x", "v_y"), StateInfo("m/s", 0.1, 100.0)),
    "phi": StateInfo("rad", 0.02, np.pi / 2.0),
    "phi_rate": StateInfo("rad/s", 0.05, 10.0),
    **dict.fromkeys(("F_yf", "F_yr"), StateInfo("N", 500.0, 1e5)),
    "d1": StateInfo("rad/s", 0.1, 100.0),
    "d2": StateInfo("rad/s2", 1.0, 1000.0),
    "d3": StateInfo("rad/s", 0.1, 100.0),
    "d": StateInfo("rad/s2", 1.0, 1000.0),
    "F_d": StateInfo("N", 0.0, 1e5),
    "N_d": StateInfo("N m", 100.0, 1e5),
    "bias": StateInfo("rad/s", 0.0, 10.0),
    "accel_bias": StateInfo("m/s2", 0.0, 50.0),
    "accel_scale": StateInfo("-", 0.0, 1.0),
    **dict.fromkeys(("bank", "camera_yaw", "map_heading"), StateInfo("rad", 0.0, 1.0)),
    "steer_offset": StateInfo("rad", 0.0, 1.0),
    **dict.fromkeys(TYRES, StateInfo("-", 0.0, 5.0)),
}
"""All states of all models, by name."""
FOREIGN_STATE = StateInfo("-", 0.0, 1e6)
"""A state that `STATES` lacks, which only a user's estimator has."""


@dataclass(frozen=True)
class FilterModel:
    """States by name, what drives them and what is measured."""

    states: tuple[str, ...]  # those that follow the model
    inputs: tuple[str, ...] = ("steer", "N_z")  # columns of a fast row, or sums of two
    fast: tuple[str, ...] = ("gyro",)  # likewise, measured in every row
    disturbances: tuple[tuple[str, str], ...] = ()  # states behind them, and what each one pushes
    forces: bool = False  # disturbances are an Ornstein-Uhlenbeck force and moment instead
    late: tuple[str, ...] = ()  # states that lag behind the camera's (tie-vision (12))
    biases: tuple[str, ...] = ()  # last states, names of `BIASES`

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        pushes = ("F_d", "N_d") if self.forces else tuple(name for name, _ in self.disturbances)
        return self.states + self.late + pushes + self.biases


_ORDER = ("beta", "gamma", "psi", "y_l")  # of a bicycle's states, the first as sensors need them
INERTIAL = ("gyro", "accel_y", "roll_rate")  # the fast sensors of a bicycle, in their order
WANDER = {
    **{"bias": "gyro", "accel_bias": "accel_y", "bank": "", "camera_yaw": "camera"},
    **{"map_heading": "camera", "steer_offset": ""},
}
SCALE = "accel_scale"
BIASES = WANDER | {SCALE: "accel_y"} | dict.fromkeys(TYRES, "")
"""States that nothing drives but noise, and the sensor that each needs, if any. Option `bias_sds`
says what they are. The tyres' count too: factors of stiffness, and the reciprocal of friction."""
NONLINEAR = (*TYRES, SCALE)

MODELS: dict[str, FilterModel] = {
    "roll": FilterModel(("phi", "phi_rate"), ("accel_y",), ("roll_rate",)),
    "kinematic": FilterModel(("v_x", "v_y"), ("accel_x", "accel_y"), ("wheel",)),
    "velocity-roll": FilterModel(
        ("v_x", "v_y", "phi", "phi_rate"),
        ("accel_x", "accel_y"),
        ("roll_rate",),
        (("d", "phi_rate"),),
    ),
    "yaw-moment": FilterModel(("gamma",), ("N_z",), ("gyro",), (("N_d", "gamma"),)),
    "tyre-forces": FilterModel(
        ("gamma",), ("N_z",), ("gyro", "accel_y"), (("F_yf", "gamma"), ("F_yr", "gamma"))
    ),
}
"""Models other than the bicycle's, by name."""

LATE = {"psi": "psi_late", "y_l": "y_l_late"}


def select_states(sensors: tuple[str, ...]) -> tuple[str, ...]:
    """Select the fewest of a bicycle's states that slow sensors measure: the first of `_ORDER`.

    Args:
        sensors: Names of the slow sensors.
    """
    rows = [row for sensor in sensors for row in MEASUREMENTS[sensor].rows]
    return _ORDER[: max([2, *(1 + _ORDER.index(state) for row in rows for state in row.states)])]


FAST_CHANNELS: dict[str, tuple[int, ...]] = {
    name: (getattr(FAST, name),) for name in ("steer", "gyro", "accel_x", "accel_y", "roll_rate")
} | {"wheels": (FAST.wheel_left, FAST.wheel_right)}
"""The columns of a fast row that are late together."""
FIND = "find"
NOISE = {
    "gyro_noise": 0.005,  # rad/s
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
} | {
    f"{row.noise}_noise": row.sd
    for sensor in MEASUREMENTS.values()
    for row in (*sensor.rows, *sensor.velocities)
}
"""Standard deviations of what is measured, by option."""
FILE = Path(__file__).with_name("tunings.toml")


def read_tunings(path: str | Path = FILE) -> list[dict[str, Any]]:
    """Read a tunings file's `estimator`, `sensors` and `q`, process noise by state, (unit)^2 / s.

    Args:
        path: TOML file; ValueError with its path if it is no tunings file.
    """
    try:
        entries = tomllib.loads(Path(path).read_text(encoding="utf-8")).get("tuning", [])
        for entry in entries:
            entry["q"] = {state: float(value) for state, value in entry["q"].items()}
            str.split(entry["estimator"] + entry["sensors"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is no file of tunings: {error!r}") from None
    return list(entries)


TUNINGS: dict[tuple[str, str], dict[str, float]] = {
    (entry["estimator"], entry["sensors"]): entry["q"] for entry in read_tunings()
}


class NumberRule(NamedTuple):
    """What a number has to be."""

    expected: str  # for messages, with {unit}
    fits: Callable[[float], bool]


NUMBER = NumberRule("", lambda _: True)
POSITIVE = NumberRule("must be positive and finite", lambda v: 0.0 < v < math.inf)
NOT_NEGATIVE = NumberRule("is in {unit} and not negative", lambda v: 0.0 <= v < math.inf)
_PROBABILITY = NumberRule("is a probability between 0 and 1", lambda v: 0.0 < v < 1.0)
_FRACTION = NumberRule("is a share from 0 to 1", lambda v: 0.0 <= v < 1.0)
_SAMPLES = NumberRule("is a number of samples", lambda v: v in range(1000))
_Field = Any  # a field, which stands for its default


def _make(default: object, text: str, unit: str = "", limits: NumberRule | None = None) -> _Field:
    text = f" ({unit}): {text}." if unit else f": {text}."
    return field(default=default, metadata={"text": text, "unit": unit, "limits": limits})


def _group(defaults: Mapping[str, float | None], text: str) -> _Field:
    """Describe options that are alike: their defaults by name."""
    return field(default_factory=dict, metadata={"text": f": {text}.", "family": defaults})


def _add(text: str, unit: str) -> _Field:
    return _make(0.0, text, unit, NOT_NEGATIVE)


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """Options of a filter, as `make_estimator` takes them; each has those that its rules need.

    Defaults are the common ones; a row of `FILTERS` has its own.
    """

    slow: tuple[str, ...] = _make(
        None, "slow sensors; several by covariance; None: one, of joint all"
    )
    gains: str = _make("", "periodic or covariance; of dual-rate constant, from-29 or placed")
    delay: str = _make("clone", f"rule for late samples: {', '.join(RULES)}; see core.late_samples")
    assumed_delay: float = _make(0.033, "delay of all samples, by the rule constant", "s", POSITIVE)
    between: str = _make("hold", "of single-rate-kf: hold or predict between its steps")
    intersample: str = _make(
        "predict", "of double-layer pseudo-residual or predict, of dual-rate pseudo, hold, oh too"
    )
    inverse: str = _make(INVERSES[0], f"of pseudo-residuals: {', '.join(INVERSES)}")
    poles: tuple[float, ...] = _make((), "of placed gains, one a state; see `DualRate`", "rad/s")
    disturbances: str = _make(
        "none", "walk, walk-all (psi too) or forces, an Ornstein-Uhlenbeck force and moment"
    )
    leak: float = _add("by which disturbances decay on top of that", "1/s")
    fast: tuple[str, ...] = _make(
        ("gyro",), "gyro and any of accel_y and roll_rate, with which the body rolls"
    )
    bias_sds: Mapping[str, float] = _group(
        dict.fromkeys([f"{name}_sd" for name in BIASES], 0.0),
        "above 0 a state of this deviation: a bias of the gyro (rad/s) or the accelerometer "
        "(m/s2), the road's bank (rad), the camera's yaw to the left (rad), what the map's heading "
        "errs (rad), the steering sensor measures too much (rad), the accelerometer as a fraction, "
        "factors on both axles' stiffness, the reciprocal of friction (0: tyres without a limit)",
    )
    bias_times: Mapping[str, float] = _group(
        dict.fromkeys([f"{name}_time" for name in WANDER], 0.0),
        "s within which such a state forgets, and wanders about 0 with its deviation; 0: never",
    )
    Q: npt.ArrayLike | None = _make(  # noqa: RUF009
        None, "process noise, (n, n) or (n,); None: the tuned one", "unit^2/s"
    )
    q: Mapping[str, float] = _group(
        dict.fromkeys([f"q_{name}" for name in STATES]), "entries of Q, (unit)^2/s"
    )
    noise: Mapping[str, float] = _group(
        NOISE,
        "deviations of measurements; the course's, if not set, is for 60 km/h and grows as 1/V",
    )
    hdop_table: tuple[tuple[float, float], ...] = _make(
        (), "pairs (HDOP, factor on the GPS's noise), linear in between"
    )
    satellites: float = _make(4.0, "that a fix needs, double-layer-gps 4.3", limits=NUMBER)
    robust: float = _add("innovation beyond which it counts less (Huber)", "standard deviations")
    map_lag_sd: float = _add("by which the road's curvature may be late, as a camera's noise", "s")
    steer_rate: float = _add("a faster change of steering waits for the next row", "rad/s")
    model_error: float = _add("error of the tyres, added to force_sd", "shares of a force")
    noise_time: float = _add("time over which the fast sensors' noise is found; 0: fixed", "s")
    force_share: float = _add("of the weight, added to force_sd as a variance", "1")
    moment_share: float = _add("of that at half the wheelbase, added to moment_sd", "1")
    force_sd: float = _make(50.0, "of disturbances that are forces", "N", POSITIVE)
    moment_sd: float = _make(20.0, "of disturbances that are forces", "N m", POSITIVE)
    disturbance_time: float = _make(0.3, "time constant of both", "s", POSITIVE)
    moment_time: float = _add("time constant of the moment; 0: disturbance_time", "s")
    gate: float | None = _make(
        None, "a sample less likely than 1 - gate is skipped; with wary 1 - 1e-9", "", _PROBABILITY
    )
    wary: int = _make(
        0,
        "gated samples that agree, after which the filter trusts their sensor; by clone or buffer; "
        "repeated packets are skipped while the car moves, a first sample passes the gate; 0: off",
        limits=_SAMPLES,
    )
    adapt: float = _make(0.0, "fraction of an innovation in R; 0: R as set", limits=_FRACTION)
    latency: Mapping[str, float | str] = _make(
        None, f"of late channels, {{'gyro': 0.06}}; {FIND!r}: a filter with tyres finds one", "s"
    )
    prior: Mapping[str, float] = _make(None, "standard deviations at the start, by state")
    allow_unstable: bool = _make(False, "build a filter whose error grows")


OPTIONS = {option.name: option for option in fields(FilterOptions)}
"""Options and families of them, in the order of the docs."""
PARAMETERS = [
    Parameter(name, Parameter.KEYWORD_ONLY, default=default)
    for key, option in OPTIONS.items()
    for name, default in option.metadata.get("family", {key: option.default}).items()
]
"""All options, for the signature of `make_estimator`."""


_LINES = [
    f"    - **{', '.join(option.metadata.get('family', [key]))}**{option.metadata['text']}"
    for key, option in OPTIONS.items()
]
FilterOptions.__doc__ = "\n".join([f"{FilterOptions.__doc__}", *_LINES])


@dataclass(frozen=True, kw_only=True)
class FilterConfig(FilterOptions):
    """Decisions about a filter before its design: its name in `FILTERS` and its parsed options.

    `prior` has all states; `bias_sds`, `bias_times` and `noise` are by names without their ends.
    """

    name: str
    row: FilterDefinition
    sensors: Mapping[str, SlowSensor]  # `slow`, in the order of SLOW_NAMES
    models: tuple[FilterModel, ...]  # of each layer
    Q: Array  # (n, n) per second, of the states of all layers
    noise_over_speed: Mapping[str, float]  # of those that grow as 1/V, times V in m/s

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states of all layers."""
        return tuple(self.prior)

    @property
    def linear_part(self) -> "FilterConfig":
        """Of several sensors the first, since they have no cycle; nominal tyres and scale."""
        config = self
        if len(self.sensors) > 1:
            config = replace(self, sensors=dict(list(self.sensors.items())[:1]))
        linear = [i for i, name in enumerate(self.states) if name not in NONLINEAR]
        if len(linear) == len(self.states):
            return config
        layers = tuple(
            replace(model, biases=tuple(name for name in model.biases if name not in NONLINEAR))
            for model in self.models
        )
        prior = {name: self.prior[name] for name in self.states if name not in NONLINEAR}
        return replace(config, models=layers, Q=self.Q[np.ix_(linear, linear)], prior=prior)
