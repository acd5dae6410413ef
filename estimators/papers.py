"""Every filter of the papers and its rivals: a row of a table.

A filter is a model x a rule between slow samples x a rule for late ones x a tuning. The model has
the states that the gyro and the slow sensor measure, the tuning stands in `tunings.py`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Filter:
    """One row.

    slow: slow sensors it can use, the preferred first (none: the gyro alone). intersample: of
    `intersample.RULES`. gains: "periodic" or "covariance" (what it does when not told).
    disturbances: of `models.DISTURBANCES`. delay: of `delay.RULES`. source: where it comes from.
    """

    slow: tuple[str, ...]
    intersample: str
    gains: str
    disturbances: str
    delay: str
    source: str


ANY = ("camera", "gps")

FILTERS: dict[str, Filter] = {
    "bicycle-kf": Filter((), "predict", "periodic", "none", "clone", "tie-vision VI.A"),
    "single-rate-kf": Filter(ANY, "single-rate", "periodic", "none", "clone", "tie-vision (15)"),
    "multirate-kf": Filter(ANY, "predict", "periodic", "none", "clone", "tie-vision (16)"),
    "multirate-residual-kf": Filter(
        ANY, "pseudo-residual", "periodic", "none", "clone", "tie-vision (19)-(22)"
    ),
    "course-kf": Filter(("gps",), "predict", "covariance", "none", "clone", "dakf-stability [10]"),
    "dakf": Filter(("gps",), "predict", "covariance", "walk", "clone", "dakf-stability (5)-(20)"),
    "exact-kf": Filter(ANY, "predict", "covariance", "forces", "clone", "docs/PAPERS.md section 3"),
}
