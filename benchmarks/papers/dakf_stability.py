"""dakf-stability: slip from a GPS course and a gyro by disturbance accommodation, and control."""

from ..harness.stats import Bound
from .dual_rate import compute_coms_ranks
from .ledger import Analysis, Claim, ClaimPart, compare
from .manoeuvres import PAPER_TUNINGS, ControlSimulation, Driver, EstimationSimulation, PaperFilter

PAPER = "dakf-stability"
FIG6, FASTER, FIG8 = "dakf-fig6", "dakf-fig6-faster", "dakf-fig8"
FIG7, LARGER, FIG9 = "dakf-fig7", "dakf-fig7-larger", "dakf-fig9"
BIAS, RANKS = "dakf-bias", "dakf-rank"
DAKF, KF, LOB = "dakf", "course-kf", "lob"
WITHOUT, WITH, FEEDBACK = "without control", "with control", "with control, no rejection"
_TEXTS, _ERRORS = ("sideslip", "yaw rate"), ("rms_slip_error", "rms_yaw_error")
_GYRO_BIAS = 8.7266e-4  # rad/s, 0.05 deg/s

_ENV = "sideslip/YawGps-v0"
_FILTERS = tuple(PaperFilter(name, name) for name in (DAKF, KF, LOB))
_FOLLOWING = "model-following"
_DRIVERS = {WITHOUT: Driver("none", DAKF), WITH: Driver(_FOLLOWING, DAKF)}
_PARTLY = {FEEDBACK: Driver(_FOLLOWING, DAKF, {"rejection": False})}
_BY_WIRE = "sideslip/AfsYawFusion-v0"
_ESTIMATE = {
    "outputs": ("beta", "gamma", "d1", "d2"), "options": {"slow": "gps"} | PAPER_TUNINGS[DAKF]
}  # fmt: skip

# fmt: off
SIMULATIONS = (
    ControlSimulation(FIG7, _BY_WIRE, FIG7, _DRIVERS | _PARTLY, _ESTIMATE),
    ControlSimulation(LARGER, _BY_WIRE, {"base": FIG7, "name": LARGER, "amplitude": 0.1}, _DRIVERS,
        _ESTIMATE, share=0.25),
    ControlSimulation(FIG9, _BY_WIRE, FIG9, _DRIVERS, _ESTIMATE, share=0.5),
    EstimationSimulation(FIG6, _ENV, FIG6, _FILTERS),
    EstimationSimulation(FASTER, _ENV, {"base": FIG6, "name": FASTER, "frequency": 0.4}, _FILTERS),
    EstimationSimulation(FIG8, _ENV, FIG8, _FILTERS),
    EstimationSimulation(BIAS, _ENV,
        {"base": FIG6, "name": BIAS, "steering": "straight", "duration": 120.0, "wind_force": 0.0,
            "gps_outage": None, "disturbance_force": 0.0, "disturbance_moment": 0.0,
            "noise": {"gyro_bias": _GYRO_BIAS}}, _FILTERS[:2], control_period=100),
    Analysis(RANKS, compute_coms_ranks, share=0.0),
)
# fmt: on


def _make_tracking_parts(scenario: str, *thresholds: float | None) -> list[ClaimPart]:
    return [
        compare(f"{text} error, with / without", scenario, WITH, WITHOUT, max_ratio, metric)
        for text, metric, max_ratio in zip(_TEXTS, _ERRORS, thresholds, strict=True)
    ]


# fmt: off
CLAIMS = (
    Claim("Fig. 6", "the DAKF beats the three-state Kalman filter, and this the linear observer",
        [compare("DAKF / KF", FIG6, DAKF, KF, 0.75),
         compare("KF / LOB", FIG6, KF, LOB, 0.80),
         compare("DAKF / KF at 0.4 Hz", FASTER, DAKF, KF),
         compare("KF / LOB at 0.4 Hz", FASTER, KF, LOB)]),
    Claim("Fig. 6", "the DAKF is better during the outage too",
        [compare(f"DAKF / {rival}, 4 to 6 s{text}", name, DAKF, filter_, quantity="outage")
            for name, text in ((FIG6, ""), (FASTER, " at 0.4 Hz"))
            for rival, filter_ in (("KF", KF), ("LOB", LOB))]),
    Claim("Sec. IV.D", "slip and disturbances are observable",
        [ClaimPart("rank, of 5 states", RANKS, "dakf", "rank", Bound("=", 5.0),
            Bound("=", 4.0), "rank"),
         ClaimPart("slip error after 120 s with 0.05 deg/s of gyro bias, DAKF", BIAS, DAKF,
            "last", None, Bound(">=", 0.05), "drift"),
         ClaimPart("the same, three-state KF", BIAS, KF, "last", None, Bound("<=", 0.01), "drift")],
        note="A constant slip is the same to the sensors as a heading the other way with constant "
        "d1 and d2."),
    Claim("Fig. 7", "with control sideslip angle and yaw rate track their references",
        [*_make_tracking_parts(FIG7, 0.80, 0.50),
         compare("peak of the slip, with / without", FIG7, WITH, WITHOUT, quantity="peak_slip"),
         ClaimPart("share of time at the yaw moment's limit", FIG7, WITH, "full_command",
            metric="share"),
         ClaimPart("the same, a step of 0.1 rad", LARGER, WITH, "full_command", metric="share")]),
    Claim("Sec. V.B", "disturbance rejection makes the car the nominal one",
        [compare(f"{text} error, with / without rejection", FIG7, WITH, FEEDBACK,
                quantity=metric)
            for text, metric in zip(_TEXTS, _ERRORS, strict=True)],
        note="The feedback's integrals already take away what is constant."),
    Claim("Fig. 8 (twin)", "the same order of the filters on the road, during the outage too",
        [compare("DAKF / KF", FIG8, DAKF, KF),
         compare("KF / LOB", FIG8, KF, LOB),
         compare("DAKF / KF, 10.5 to 13 s", FIG8, DAKF, KF, quantity="outage"),
         compare("DAKF / LOB, 10.5 to 13 s", FIG8, DAKF, LOB, quantity="outage")],
        note="At 20 km/h, close to 20.7 km/h where the slip of the stationary turn changes its "
        "sign, there is little slip to see, and no course while it is there."),
    Claim("Fig. 9 (twin)", "with control the car tracks on the road too",
        _make_tracking_parts(FIG9, None, None)),
)
