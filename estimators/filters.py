"""Every filter of the papers and its rivals: a model, rules between and for late samples, a tuning.

Where the papers differ: models are discretised exactly (double-layer-gps (38), (42) take A T + I);
disturbances and process noise are per second (double-layer-gps (34), dual-rate (5): per step);
misprints (docs/reference/papers.md) are corrected; with pseudo-residuals every tick takes an even
fraction of the gain that the filter without them applies at a sample.
"""

from dataclasses import dataclass
from typing import Any

from ..envs.sensors.slow import SLOW_NAMES


@dataclass(frozen=True, kw_only=True)
class FilterDefinition:
    """One row of the table: what a filter is, and the defaults of its options."""

    slow: tuple[str, ...] = ()  # slow sensors it can use, the preferred first
    uses_all: bool = False  # whether it uses all of them that are there, not the first alone
    model: str = "bicycle"  # or a name of `design.options.MODELS`
    fast: tuple[str, ...] = ("gyro",)  # measured in every row
    family: str = "predict"  # or "pseudo-residual", "dual-rate", "single-rate": between samples
    gains: str = "periodic"  # or "covariance", "placed"
    disturbances: str = "none"  # or "walk", "walk-all", "forces"
    delay: str = "clone"  # a name of `late_samples.RULES`
    poles: tuple[float, ...] = ()  # rad/s, where gains are placed
    second: str = ""  # model of a second layer
    options: tuple[tuple[str, Any], ...] = ()  # (option, its default) unlike the common defaults
    hdop_table: tuple[tuple[float, float], ...] = ()  # (HDOP, factor on the GPS's noise)
    source: str  # paper with the equations


_GPS = ("gps",)
_CAMERA = ("camera",)
_JOINT = (
    *(("fast", ("gyro", "accel_y")), ("prior", {"beta": 0.063, "gamma": 0.3})),
    *(("wary", 10), ("steer_rate", 3.0), ("noise_time", 5.5), ("robust", 0.32)),
    *(("force_share", 0.032), ("force_sd", 6.0), ("disturbance_time", 0.11)),
    *(("moment_share", 0.039), ("moment_sd", 450.0), ("moment_time", 0.057)),
    *(("front_tyres_sd", 0.22), ("rear_tyres_sd", 0.22), ("inverse_friction_sd", 1.6)),
    *(("q_front_tyres", 0.0045), ("q_rear_tyres", 0.0045), ("q_inverse_friction", 0.0085)),
    *(("model_error", 0.046), ("gyro_noise", 0.0012), ("bias_sd", 0.0048), ("q_bias", 5.6e-09)),
    *(("accel_y_noise", 0.52), ("accel_bias_sd", 0.48), ("accel_bias_time", 61.0)),
    *(("accel_scale_sd", 0.019), ("steer_offset_sd", 0.0068), ("bank_sd", 0.03)),
    *(("bank_time", 14.0), ("course_noise", 0.014), ("psi_noise", 0.02), ("y_l_noise", 0.052)),
    *(("camera_yaw_sd", 0.005), ("map_heading_sd", 0.0027), ("map_heading_time", 1.2)),
    ("map_lag_sd", 0.19),
)
"""For an unknown car; `benchmarks.tuning.levels` finds them on simulated drives. Meaning and
unit of each stand in `design.options`."""

FILTERS: dict[str, FilterDefinition] = {
    "bicycle-kf": FilterDefinition(source="tie-vision VI.A, the model (1)-(2)"),
    "single-rate-kf": FilterDefinition(
        slow=SLOW_NAMES, family="single-rate", source="tie-vision (12)-(15)"
    ),
    "multirate-kf": FilterDefinition(slow=SLOW_NAMES, source="tie-vision (12)-(13), (16)"),
    "multirate-residual-kf": FilterDefinition(
        slow=SLOW_NAMES, family="pseudo-residual", source="tie-vision (12)-(13), (17)-(22)"
    ),
    "uneven-delay-kf": FilterDefinition(
        slow=_CAMERA, family="pseudo-residual", delay="stored", source="uneven-delay (11)-(22)"
    ),
    "constant-delay-kf": FilterDefinition(
        slow=_CAMERA, family="pseudo-residual", delay="constant",
        source="uneven-delay 5, the rival in Fig. 5",
    ),
    "vision-only-kf": FilterDefinition(
        slow=_CAMERA, fast=(), source="uneven-delay (3)-(7), the camera's rows of C alone"
    ),
    "course-kf": FilterDefinition(
        slow=_GPS, gains="covariance", source="dakf-stability VI.A, [10]: (5)-(20) without d_1, d_2"
    ),
    "dakf": FilterDefinition(
        slow=_GPS, gains="covariance", disturbances="walk", source="dakf-stability (5)-(20)"
    ),
    "double-layer": FilterDefinition(
        slow=_GPS, family="pseudo-residual", gains="covariance", disturbances="walk",
        second="velocity-roll", hdop_table=((1.0, 1.0), (20.0, 20.0)),
        source="double-layer-gps (28)-(29), (34)-(42)",
    ),
    # linear observers: the poles of `lob-2` and `lob` have the least error of beta of a grid from 1
    # to 200 rad/s, on the training seeds of double-layer-fig9 and dakf-fig6
    "lob-2": FilterDefinition(
        gains="placed", poles=(-60.0, -120.0), source="double-layer-gps 6.1, Aoki 2005"
    ),
    "roll-kf": FilterDefinition(
        model="roll", fast=("roll_rate",), source="double-layer-gps 6.2 and (3), Tseng 2003"
    ),
    "kinematic-velocity-kf": FilterDefinition(
        model="kinematic", fast=("wheel",), gains="covariance",
        source="double-layer-gps 6.3 and (4)-(5), Chen 2008",
    ),
    "dual-rate": FilterDefinition(
        slow=_GPS, fast=(), family="dual-rate", disturbances="walk-all", delay="ignore",
        source="dual-rate (4)-(35), (37)-(38)",
    ),
    "lob": FilterDefinition(
        fast=("gyro", "accel_y"), gains="placed", poles=(-2.0, -2.0),
        source="dakf-stability VI.A, [5]: gamma and a_y of (1)",
    ),
    "yaw-moment-observer": FilterDefinition(
        model="yaw-moment", gains="placed", poles=(-20.0, -25.0), source="dakf-stability (2), [11]"
    ),
    "lateral-force-observer": FilterDefinition(
        model="tyre-forces", fast=("gyro", "accel_y"), gains="placed", poles=(-20.0, -25.0, -30.0),
        source="dakf-stability (1)-(2), [11]",
    ),
    "exact-kf": FilterDefinition(
        slow=SLOW_NAMES, gains="covariance", disturbances="forces",
        source="docs/reference/papers.md",
    ),
    "joint": FilterDefinition(
        slow=SLOW_NAMES, uses_all=True, gains="covariance", disturbances="forces", options=_JOINT,
        source="docs/explanation/estimation.md, beyond the papers",
    ),
}  # fmt: skip
