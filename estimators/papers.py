"""Every filter of the papers and its rivals: a row of a table.

A filter is a model x a rule between slow samples x a rule for late ones x a tuning. A bicycle has
the states that the slow sensor measures; the tunings stand in `tunings.py`.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Filter:
    """One row.

    slow: slow sensors it can use, the preferred first (none: fast ones alone). model: "bicycle" or
    a name of `models.MODELS`. fast: what it measures in every row. intersample: of
    `intersample.RULES`. gains: "periodic", "covariance" or "placed" (what it does when not told).
    disturbances: "none", "walk", "walk-all" or "forces". delay: of `delay.RULES`. poles: rad/s,
    where gains are placed. second: the model of a second layer. source: where it comes from.
    """

    slow: tuple[str, ...] = ()
    model: str = "bicycle"
    fast: tuple[str, ...] = ("gyro",)
    intersample: str = "predict"
    gains: str = "periodic"
    disturbances: str = "none"
    delay: str = "clone"
    poles: tuple[float, ...] = ()
    second: str = ""
    source: str


ANY = ("camera", "gps")
GPS = ("gps",)
CAMERA = ("camera",)

FILTERS: dict[str, Filter] = {
    "bicycle-kf": Filter(source="tie-vision VI.A"),
    "single-rate-kf": Filter(slow=ANY, intersample="single-rate", source="tie-vision (15)"),
    "multirate-kf": Filter(slow=ANY, source="tie-vision (16)"),
    "multirate-residual-kf": Filter(
        slow=ANY, intersample="pseudo-residual", source="tie-vision (19)-(22)"
    ),
    "uneven-delay-kf": Filter(
        slow=CAMERA,
        intersample="pseudo-residual",
        delay="stored",
        source="uneven-delay (15)-(16), (19)-(22)",
    ),
    "constant-delay-kf": Filter(
        slow=CAMERA,
        intersample="pseudo-residual",
        delay="constant",
        source="uneven-delay V, the rival",
    ),
    "vision-only-kf": Filter(slow=CAMERA, fast=(), source="uneven-delay II.3"),
    "course-kf": Filter(slow=GPS, gains="covariance", source="dakf-stability [10]"),
    "dakf": Filter(
        slow=GPS, gains="covariance", disturbances="walk", source="dakf-stability (5)-(20)"
    ),
    "double-layer": Filter(
        slow=GPS,
        intersample="pseudo-residual",
        gains="covariance",
        disturbances="walk",
        second="velocity-roll",
        source="double-layer-gps (28)-(29), (34)-(42)",
    ),
    "lob-2": Filter(gains="placed", poles=(-6.0, -8.0), source="double-layer-gps VI.1"),
    "roll-kf": Filter(model="roll", fast=("roll_rate",), source="double-layer-gps VI.2"),
    "kinematic-velocity-kf": Filter(
        model="kinematic", fast=("wheel",), gains="covariance", source="double-layer-gps VI.3"
    ),
    "dual-rate": Filter(
        slow=GPS,
        fast=(),
        intersample="spread",
        disturbances="walk-all",
        delay="ignore",
        source="dual-rate (4)-(12), (14)-(35)",
    ),
    "lob": Filter(
        fast=("gyro", "accel_y"),
        gains="placed",
        poles=(-10.0, -10.0),
        source="dakf-stability VI.A, [5]",
    ),
    "yaw-moment-observer": Filter(
        model="yaw-moment", gains="placed", poles=(-20.0, -25.0), source="dakf-stability [11]"
    ),
    "lateral-force-observer": Filter(
        model="tyre-forces",
        fast=("gyro", "accel_y"),
        gains="placed",
        poles=(-20.0, -25.0, -30.0),
        source="dakf-stability [11]",
    ),
    "exact-kf": Filter(
        slow=ANY, gains="covariance", disturbances="forces", source="docs/PAPERS.md section 3"
    ),
}
