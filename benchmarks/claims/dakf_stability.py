"""dakf-stability: slip from a GPS course and a gyro by disturbance accommodation."""

from .claim import Bound, Claim, Part, number, ratio
from .draw import PaperFigure, course, curves
from .observability import coms_ranks
from .simulations import Analysis, Estimation, Filter

PAPER = "dakf-stability"
FIG6, FASTER = "dakf-fig6", "dakf-fig6-faster"
BIAS, RANKS = "dakf-bias", "dakf-rank"
DAKF, KF = "dakf", "course-kf"
GYRO_BIAS = 8.7266e-4  # rad/s, 0.05 deg/s

SIMULATIONS = (
    Estimation(FIG6, "sideslip/YawGps-v0", FIG6, (Filter(DAKF, DAKF), Filter(KF, KF))),
    Estimation(
        FASTER,
        "sideslip/YawGps-v0",
        {"base": FIG6, "name": FASTER, "frequency": 0.4},
        (Filter(DAKF, DAKF), Filter(KF, KF)),
    ),
    Estimation(
        BIAS,
        "sideslip/YawGps-v0",
        {
            "base": FIG6,
            "name": BIAS,
            "steering": "straight",
            "duration": 120.0,
            "wind_force": 0.0,
            "gps_outage": None,
            "disturbance_force": 0.0,
            "disturbance_moment": 0.0,
            "noise": {"gyro_bias": GYRO_BIAS},
        },
        (Filter(DAKF, DAKF), Filter(KF, KF)),
        control_period=100,
    ),
    Analysis(RANKS, coms_ranks, random=False),
)

CLAIMS = (
    Claim(
        PAPER,
        "Fig. 6",
        "the DAKF beats the three-state Kalman filter",
        (
            Part("DAKF / KF", FIG6, ratio(FIG6, DAKF, KF), Bound("<", 1.0), Bound("<=", 0.75)),
            Part("DAKF / KF at 0.4 Hz", FASTER, ratio(FASTER, DAKF, KF), Bound("<", 1.0)),
        ),
    ),
    Claim(
        PAPER,
        "Fig. 6",
        "the DAKF is better during the outage too",
        tuple(
            Part(
                f"DAKF / KF, 4 to 6 s{text}",
                scenario,
                ratio(scenario, DAKF, KF, "outage"),
                Bound("<", 1.0),
            )
            for scenario, text in ((FIG6, ""), (FASTER, " at 0.4 Hz"))
        ),
    ),
    Claim(
        PAPER,
        "Sec. IV.D",
        "slip and disturbances are observable",
        (
            Part(
                "rank, of 5 states",
                RANKS,
                number(RANKS, "dakf", "rank"),
                Bound("=", 5.0),
                Bound("=", 4.0),
                "rank",
            ),
            Part(
                "slip error after 120 s with 0.05 deg/s of gyro bias, DAKF",
                BIAS,
                number(BIAS, DAKF, "last"),
                None,
                Bound(">=", 0.05),
                "drift",
            ),
            Part(
                "the same, three-state KF",
                BIAS,
                number(BIAS, KF, "last"),
                None,
                Bound("<=", 0.01),
                "drift",
            ),
        ),
        "A constant slip is the same to the sensors as a heading the other way with constant d1 "
        "and d2.",
    ),
)

FIGURES = (
    PaperFigure(
        PAPER,
        "Fig. 6 (a): sideslip angle",
        FIG6,
        curves("beta", "sideslip angle / rad"),
        "Lane change at 25 km/h; wind from 4 to 8 s, no GPS from 4 to 6 s.",
    ),
    PaperFigure(
        PAPER,
        "Fig. 6 (b): course angle",
        FIG6,
        course("course angle / rad", ("truth", DAKF, KF)),
        "The receiver is silent from 4 to 6 s.",
    ),
    PaperFigure(
        PAPER,
        "Sec. IV.D: slip with a gyro bias of 0.05 deg/s",
        BIAS,
        curves("beta", "sideslip angle / rad"),
        "Straight on at 25 km/h: the direction that the DAKF cannot see fills up.",
    ),
)
