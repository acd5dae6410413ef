"""double-layer-gps: slip, roll and velocities from a single-antenna GPS in two layers."""

from ...estimators.filters import FILTERS
from ..harness.stats import Bound
from .ledger import Claim, ClaimPart, compare
from .manoeuvres import EstimationSimulation, PaperFilter

PAPER = "double-layer-gps"
FIG9, FASTER, PERIODS = "double-layer-fig9", "double-layer-fig9-fast", "double-layer-fig9-periods"
CALM, ROAD = "double-layer-fig9-calm", "double-layer-fig9-road"
PROPOSED, WALKS, THREE, LOB = "double-layer", "double-layer, prediction alone", "course-kf", "lob-2"
# WALKS is the claims' "disturbance KF": the double layer that only predicts between courses. LOB is
# a linear observer. A twin simulates a road test with all that the plant has.
ROLL, KINEMATIC = "roll-kf", "kinematic-velocity-kf"
DESIGNED = "kinematic-velocity-kf, Q of its sensors"
FIXED = ", R of HDOP 1"
_ENV = "sideslip/YawGps-v0"
_HDOP = {"hdop_table": FILTERS["double-layer"].hdop_table}
# a tuning of its own, found as those of estimators/design/tunings.toml, seeds 1000 to 1011 of FIG9
_Q = {"q_beta": 1.1e-4, "q_gamma": 2.4e-6, "q_psi": 2.3e-5, "q_d1": 0.089, "q_d2": 0.46}
_PREDICTED = {"intersample": "predict", **_Q}
_FILTERS = (
    PaperFilter(PROPOSED, PROPOSED, _HDOP),
    PaperFilter(WALKS, PROPOSED, {**_PREDICTED, **_HDOP}),
    *(PaperFilter(name, name) for name in (THREE, LOB, ROLL, KINEMATIC)),
    PaperFilter(DESIGNED, KINEMATIC, {"q_v_x": 1e-5, "q_v_y": 1e-5}),  # 0.1 m/s2, white at 1 kHz
)
_SLALOMS = ((FIG9, "0.2 Hz"), (FASTER, "0.4 Hz"), (PERIODS, "two single periods"))

_OPEN, _POOR = (1.4, 0.5), (3.0, 0.3)  # median of HDOP, spread of its logarithm
_SKIES = (
    ("poor sky, noise law: table", _POOR, "table", 0.97),
    ("poor sky, noise law: half", _POOR, "half", None),
    ("poor sky, noise law: constant", _POOR, "constant", None),
    ("open sky, noise law: table", _OPEN, "table", None),
)

# fmt: off
SIMULATIONS = (
    *(EstimationSimulation(name, _ENV, name, _FILTERS) for name in (FIG9, FASTER, PERIODS, ROAD)),
    EstimationSimulation(CALM, _ENV, CALM, (_FILTERS[0], PaperFilter(ROLL, ROLL))),
    *(EstimationSimulation(name, _ENV,
            {"base": FIG9, "name": name, "hdop": hdop, "hdop_spread": spread, "hdop_law": law},
            (*_FILTERS[:2],
                PaperFilter(WALKS + FIXED, PROPOSED, {**_PREDICTED, "hdop_table": None}),
                PaperFilter(PROPOSED + FIXED, PROPOSED, {"hdop_table": None})))
        for name, (hdop, spread), law, _ in _SKIES),
)

CLAIMS = (
    Claim("Fig. 9 (a)", "proposed < three-state filter < two-state observer, sideslip angle",
        [*(compare(f"{label} / three-state, {text}", scenario, name, THREE, max_ratio)
            for scenario, text in _SLALOMS
            for label, name, max_ratio in (("disturbance KF", WALKS, 0.75),
                ("double layer", PROPOSED, 0.95))),
         *(compare(f"three-state / two-state, {x}", name, THREE, LOB) for name, x in _SLALOMS)],
        note="The gain is that of the disturbance states. The disturbance KF is the double layer "
        "without its correction between courses, which adds no information and costs accuracy."),
    Claim("Fig. 9 (b)", "the smallest error between courses",
        [*(compare(f"double layer / disturbance KF, {text}", name, PROPOSED, WALKS)
            for name, text in _SLALOMS),
         *(compare(f"jump at a course, double layer / three-state, {text}", name,
                PROPOSED, THREE, quantity="jump")
            for name, text in _SLALOMS)],
        note="The error over all milliseconds is that between courses: there are 200 to a course."),
    Claim("Fig. 9 (c)", "the yaw angle at 1 kHz from courses at 5 Hz",
        [compare("double layer / three-state", FIG9, PROPOSED, THREE, quantity="psi")]),
    Claim("Fig. 9 (d)", "roll angle better than a two-state roll filter's",
        [compare("double layer / roll KF, wind", FIG9, PROPOSED, ROLL, 0.55, "phi"),
         compare("double layer / roll KF, no wind", CALM, PROPOSED, ROLL, quantity="phi")],
        note="30 % on inertia, damping and stiffness cancel except in the input gain."),
    Claim("Fig. 9 (e)-(f)", "velocities better than a kinematic filter's",
        [compare("v_y, double layer / kinematic KF", FIG9, PROPOSED, DESIGNED, 0.30, "v_y"),
         compare("v_x, double layer / kinematic KF", FIG9, PROPOSED, DESIGNED, quantity="v_x"),
         *(compare(f"{state}, the same, tuned", FIG9, PROPOSED, KINEMATIC, quantity=state)
            for state in ("v_y", "v_x"))],
        note="The kinematic KF with the process noise of its accelerometers, and with one tuned "
        "to the drive, which takes roll for noise. v_x: it has the wheels at 1 kHz, the double "
        "layer the GPS's speed at 5 Hz."),
    Claim("Sec. 4.3", "R from a table of HDOP beats a fixed R, sideslip angle",
        [compare(f"{label}, {x}", x, filter_, filter_ + FIXED, max_ratio if limited else None)
            for label, filter_, limited in (("disturbance KF", WALKS, True),
                ("double layer", PROPOSED, False))
            for x, _, _, max_ratio in _SKIES],
        note="Table / R of HDOP 1. The table helps the disturbance KF where HDOP is high and the "
        "noise follows it; where the noise does not, it is a wrong R. The double layer, which "
        "corrects between courses, gains nothing. On three real receivers the spread hardly "
        "follows HDOP (docs/howto/receivers.md)."),
    Claim("Fig. 9 (twin)", "the proposed estimator is the best on the road",
        [ClaimPart("slip, double layer / best rival", ROAD, PROPOSED, stated=Bound("<", 1.0),
            rivals=(THREE, LOB)),
         compare("slip, three-state / two-state", ROAD, THREE, LOB),
         compare("roll, double layer / roll KF", ROAD, PROPOSED, ROLL, quantity="phi"),
         compare("v_y, double layer / kinematic KF", ROAD, PROPOSED, KINEMATIC, quantity="v_y"),
         compare("v_x, double layer / kinematic KF", ROAD, PROPOSED, KINEMATIC, quantity="v_x")]),
)
