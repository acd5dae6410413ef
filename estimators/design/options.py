"""The options of a filter, the default noise levels and the tuned process noise.

The process noise of each filter with its slow sensors is in `tunings.toml`, as `sideslip tune
estimator` found it: per second, in (unit of the state)^2 / s, with the command that found it.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...envs.record import FAST, Array
from ...envs.sensors.link import SlowSensor
from ..filters import FilterDefinition
from .models import MEASUREMENTS, FilterModel

FAST_CHANNELS = {
    "steer": ("steer",),
    "gyro": ("gyro",),
    "accel_x": ("accel_x",),
    "accel_y": ("accel_y",),
    "roll_rate": ("roll_rate",),
    "wheels": ("wheel_left", "wheel_right"),
}
"""The columns of `envs.record.Fast` that are late together."""
FIND = "find"


def find_columns(channel: str) -> tuple[int, ...]:
    """Find the columns of a fast row that a channel has.

    Args:
        channel: Name of `FAST_CHANNELS`.

    Returns:
        Their indices.
    """
    return tuple(int(getattr(FAST, name)) for name in FAST_CHANNELS[channel])


NOISE = {"gyro_noise": 0.005} | {  # rad/s
    f"{row.noise}_noise": row.sd for sensor in MEASUREMENTS.values() for row in sensor.rows
}
EXTRA_NOISE = {
    "accel_y_noise": 0.1,  # m/s2
    "roll_rate_noise": 0.005,  # rad/s
    "wheel_noise": 0.015,  # m/s, of the mean of both front wheels
} | {f"{row.noise}_noise": row.sd for sensor in MEASUREMENTS.values() for row in sensor.velocities}
DISTURBANCE = {"force_sd": 50.0, "moment_sd": 20.0, "disturbance_time": 0.3}  # N, N m, s


FILE = Path(__file__).with_name("tunings.toml")


def read_tunings(path: str | Path = FILE) -> list[dict[str, Any]]:
    """Read the entries of a tunings file.

    Args:
        path: TOML file.

    Returns:
        Entries with `estimator`, `sensors` and `q`, process noise by state, (unit)^2 / s.

    Raises:
        ValueError: It is no file of tunings; the message has the path.
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


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """Decisions about a filter before its design: its name in `FILTERS` and its options.

    Options, as `make_estimator` takes them
    ---------------------------------------
    slow: the slow sensor to use (default: the row's first that is there); several by "covariance".
    gains: "periodic" (precomputed), "covariance"; of dual-rate "constant", "from-29" or "placed".
    delay: the rule for late samples, see `sideslip.estimators.core.innovation`: "clone" or "buffer"
        (exact), "larsen", "stored", "constant" (with assumed_delay, s), "literal", "lag", "ignore".
    between: of single-rate-kf, "hold" (default) or "predict" between its steps.
    intersample: of double-layer "pseudo-residual" or "predict"; of dual-rate "pseudo", "predict",
        "hold" or "oh".
    inverse: of the pseudo-residual rule, "moore-penrose", "p-weighted", "tikhonov" or "bayes".
    poles: of placed gains, negative numbers in rad/s, one a state; of dual-rate see `DualRate`.
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
    q_beta, q_gamma, ...: process noise per second, (unit)^2/s; or Q, (n, n) or (n,); tuned ones.
    gyro_noise (rad/s), psi_noise (rad), y_l_noise (m), course_noise (rad at every speed; default
        0.14 deg at 60 km/h growing as 1/V), accel_y_noise (m/s2), roll_rate_noise (rad/s),
        wheel_noise, gps_speed_noise (m/s): standard deviations.
    hdop_table: pairs (HDOP, factor on the GPS's noise), linear in between; None for one noise
        (default of all but double-layer, where the factor is the HDOP).
    satellites: the least that a GPS fix needs (default 4).
    robust: standard deviations of an innovation from which it counts less (Huber); 0: none does.
    steer_rate: rad/s; a steering angle that changes faster waits for the next row; 0: none does.
    force_share, moment_share: fractions of the car's weight, and of that at half the wheelbase,
        that are added to force_sd and moment_sd, as variances (default 0).
    model_error: of joint, the fraction of the axles' forces by which its tyres err, added likewise.
    accel_time: s over which the accelerometer's noise is found, from `accel_y_noise` up; 0: fixed.
    members: of joint, filters side by side (default: one for each of `levels`), of which the least
        likely forgets the tyres twice a second.
    levels: of joint, factors on force_sd and moment_sd, or pairs, which members take in turn.
    sudden: of joint, True runs four filters that interact, without members or levels: nothing
        happens, a gust blows, the tyres have just changed, they settle.
    gate: a probability; a sample whose innovation is less likely than 1 - gate is skipped.
    wary: 0 is off (default; joint and joint-robust have 10). Above, with delay "clone" or "buffer":
        a packet that repeats the last one while the car moves is skipped; the gate is 1 - 1e-9
        where none is configured, a sensor's first sample passes it, and after so many gated samples
        in a row that agree with each other the filter begins anew with the sensor.
    adapt: fraction of a new innovation in an R that follows them (0: R as configured).
    force_sd (N), moment_sd (N m), disturbance_time (s): of disturbances that are forces.
    latency: s by which fast channels (steer, gyro, accel_x, accel_y, roll_rate, wheels) come late,
        {"gyro": 0.06}; "find" for one that joint finds while driving.
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
    shares: tuple[float, float]  # `force_share`, `moment_share`
    times: Mapping[str, float]  # s, of biases
    adapt: float
    prior: Mapping[str, float]  # of all states
    latency: Mapping[str, float | str]  # s, or "find", by channel; none that is punctual
    allow_unstable: bool

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states of all layers."""
        return tuple(self.prior)
