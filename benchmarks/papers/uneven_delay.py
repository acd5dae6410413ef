"""uneven-delay: the lateral offset from a camera whose delay varies and is time-stamped."""

from functools import partial

from .ledger.claim import Bound, Part, claims_of, measured, ratio, smaller
from .ledger.filters import Estimation, Filter
from .ledger.plots import PaperFigure, curves, delays, measured_offset
from .ledger.simulations import Analysis
from .theory.observability import coms_ranks

PAPER = "uneven-delay"
FIG5, NOISY, FIG7 = "uneven-delay-fig5", "uneven-delay-fig5-noisy", "uneven-delay-fig7"
RANKS = "uneven-delay-rank"
PROPOSED, EXACT, VISION = "uneven-delay-kf", "multirate-kf", "vision-only-kf"
FRAME, MEAN = "constant-delay-kf, 33 ms", "constant-delay-kf, 17 ms"
ROLLBACK_17 = "multirate-kf, constant 17 ms"


def _filters(**noise: float) -> tuple[Filter, ...]:
    """The filters, with the camera's noise; the process noise is one for all of them."""
    return (
        Filter(PROPOSED, PROPOSED, noise),
        Filter(EXACT, EXACT, noise),
        Filter(FRAME, "constant-delay-kf", {"assumed_delay": 0.033, **noise}),
        Filter(MEAN, "constant-delay-kf", {"assumed_delay": 0.017, **noise}),
        Filter(ROLLBACK_17, EXACT, {"delay": "constant", "assumed_delay": 0.017, **noise}),
        Filter(VISION, VISION, noise),
    )


_ENV = "sideslip/YawVision-v0"
SIMULATIONS = (
    Estimation(FIG5, _ENV, FIG5, _filters(psi_noise=0.001, y_l_noise=0.01)),
    Estimation(NOISY, _ENV, NOISY, _filters(psi_noise=0.003, y_l_noise=0.03)),
    Estimation(FIG7, _ENV, FIG7, _filters()),
    Analysis(RANKS, coms_ranks, random=False),
)

_NOISES = ((FIG5, ""), (NOISY, ", three times the noise"))
claim = claims_of(PAPER)
# A claim a paragraph, a part a line: by hand.
# fmt: off
CLAIMS = (
    claim("Sec. 1.3", "slip is observable from vision alone",
        measured("rank, of 4 states", RANKS, "vision", "rank", Bound("=", 4.0), Bound("=", 4.0),
            "rank"),
        smaller("vision alone / the slip itself", FIG5, VISION, "truth")),
    claim("Fig. 5", "time stamps beat a constant delay, lateral offset",
        *(
            smaller(f"proposed / constant {delay}{text}", scenario, PROPOSED, rival, most, "y_l")
            for scenario, text in _NOISES
            for delay, rival, most in (("33 ms", FRAME, 0.80), ("17 ms, near the mean", MEAN, None))
        ),
        note="Against one frame the time stamps win; against the true mean delay there is no "
        "gain. One process noise for all; with one tuned to the offset for each of them the order "
        "is the same."),
    claim("Fig. 5", "what exact handling of the delay is worth, lateral offset",
        *(
            Part(f"exact rollback / constant 17 ms{text}", scenario,
                ratio(scenario, EXACT, ROLLBACK_17, "y_l"),
                threshold=Bound("<=", 0.95) if scenario == FIG5 else None)
            for scenario, text in _NOISES
        )),
    claim("Fig. 5", "what the delay does to the slip",
        *(
            Part(f"slip, proposed / constant 33 ms{text}", scenario,
                ratio(scenario, PROPOSED, FRAME))
            for scenario, text in _NOISES
        ),
        note="The paper shows the lateral offset alone. A delay of one frame too many turns the "
        "phase of the slip as too soft tyres do, the other way: with noise the two errors cancel."),
    claim("Fig. 7 (twin)", "time stamps beat a constant delay on the road, lateral offset",
        smaller("proposed / constant 33 ms", FIG7, PROPOSED, FRAME, metric="y_l"),
        smaller("proposed / constant 17 ms", FIG7, PROPOSED, MEAN, metric="y_l")),
)

_OFFSET, _SHOWN = "lateral offset / m", ("truth", FRAME, PROPOSED)
figure = partial(PaperFigure, PAPER)
FIGURES = (
    figure("Fig. 4: delay of each frame", FIG5, delays, "20, 15, 10, 25 ms, repeated."),
    figure("Fig. 5: lateral offset at the preview point", FIG5,
        measured_offset(_OFFSET, _SHOWN, (4.0, 4.5)),
        "Truth, the camera's held late samples, a constant delay and the proposed filter."),
    figure("Fig. 5: body slip angle", FIG5,
        curves("beta", "body slip angle / rad", ("truth", FRAME, PROPOSED, VISION)),
        "The same drive; the paper shows the offset alone."),
    figure("Fig. 6 (twin): delay of each frame", FIG7, delays,
        "Processing takes 9 to 18 ms, as on the road."),
    figure("Fig. 7 (twin): lateral offset at the preview point", FIG7,
        measured_offset(_OFFSET, _SHOWN, (20.0, 20.5)),
        "The driver's sine at about 28 km/h, half a second."),
)
