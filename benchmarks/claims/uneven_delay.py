"""uneven-delay: the lateral offset from a camera whose delay varies and is time-stamped."""

from .claim import Bound, Claim, Part, number
from .draw import PaperFigure, delays, measured_offset
from .observability import coms_ranks
from .simulations import Analysis, Estimation, Filter

PAPER = "uneven-delay"
FIG5, RANKS = "uneven-delay-fig5", "uneven-delay-rank"
EXACT = "multirate-kf"
IGNORED = "multirate-kf, delay ignored"


SIMULATIONS = (
    Estimation(
        FIG5,
        "sideslip/YawVision-v0",
        FIG5,
        (Filter(EXACT, EXACT), Filter(IGNORED, EXACT, {"delay": "ignore"})),
    ),
    Analysis(RANKS, coms_ranks, random=False),
)

CLAIMS = (
    Claim(
        PAPER,
        "Sec. 1.3",
        "slip is observable from vision alone",
        (
            Part(
                "rank, of 4 states",
                RANKS,
                number(RANKS, "vision", "rank"),
                Bound("=", 4.0),
                Bound("=", 4.0),
                "rank",
            ),
        ),
    ),
)

FIGURES = (
    PaperFigure(
        PAPER,
        "Fig. 4: delay of each frame",
        FIG5,
        delays,
        "20, 15, 10, 25 ms, repeated.",
    ),
    PaperFigure(
        PAPER,
        "Fig. 5: lateral offset at the preview point",
        FIG5,
        measured_offset("lateral offset / m", ("truth", EXACT, IGNORED), (4.0, 6.0)),
        "Truth, the camera's held late samples, and filters.",
    ),
)
