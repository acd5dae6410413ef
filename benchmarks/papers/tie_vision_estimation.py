"""tie-vision: the sideslip angle from a camera and a gyro."""

from dataclasses import replace
from functools import partial

import numpy as np

from .ledger import Bound, Claim, ClaimPart, PaperFilter, compare
from .manoeuvres import Curves, EstimationSimulation, PaperFigure

PAPER = "tie-vision"
FIG7, FIG9 = "tie-vision-fig7", "tie-vision-fig9"
BICYCLE, SINGLE, MULTI = "bicycle-kf", "single-rate-kf", "multirate-kf"
PROPOSED, EXACT = "multirate-residual-kf", "exact-kf, true model"
NO_DELAY = "multirate-kf, delay ignored"
RETUNED = "multirate-kf, delay ignored, tuned for it"

_PAPERS_OWN = tuple(PaperFilter(name, name) for name in (BICYCLE, SINGLE, MULTI, PROPOSED))
# as tunings.toml, but with psi and y_l's noise free too: seeds 1000 to 1011 of this drive
_Q = {"q_beta": 8.8e-3, "q_gamma": 0.15, "q_psi": 2.9e-8, "q_y_l": 1.3e-7}
_FOR_NO_DELAY = {**_Q, "psi_noise": 1.5e-3, "y_l_noise": 2.2}

# fmt: off
SIMULATIONS = (
    EstimationSimulation(FIG7, "sideslip/YawVision-v0", FIG7,
        (*_PAPERS_OWN, PaperFilter(NO_DELAY, MULTI, {"delay": "ignore"}),
            PaperFilter(RETUNED, MULTI, {"delay": "ignore", **_FOR_NO_DELAY}),
            PaperFilter(EXACT, "exact-kf", vehicle="true")), bound=True, share=5.0),
    EstimationSimulation(FIG9, "sideslip/YawVision-v0", FIG9, _PAPERS_OWN),
)
# fmt: on


def _make_poorest_part(scenario: str, threshold: Bound | None) -> ClaimPart:
    label, rivals = "bicycle / poorest vision filter", (SINGLE, MULTI, PROPOSED)
    one = ClaimPart(label, scenario, BICYCLE, stated=Bound(">", 1.0), threshold=threshold)
    return replace(one, rivals=rivals, pick=np.max)


def _make_best_parts(scenario: str, max_ratio: float | None) -> tuple[ClaimPart, ...]:
    return (
        compare("proposed / bicycle", scenario, PROPOSED, BICYCLE),
        compare("proposed / single-rate", scenario, PROPOSED, SINGLE),
        compare("proposed / multirate", scenario, PROPOSED, MULTI, max_ratio),
    )


claim = partial(Claim, PAPER)
# fmt: off
CLAIMS = (
    claim("Fig. 7", "the bicycle model's filter is the poorest",
          _make_poorest_part(FIG7, Bound(">=", 1.05))),
    claim("Fig. 7", "the multirate filter with pseudo-residuals is the best",
        *_make_best_parts(FIG7, 1.10),
        note="For an optimal gain the expected error given the residual is zero: the correction "
        "adds no information, it is a change of gain."),
    claim("Fig. 7", "how far from the best possible, and what the delay costs",
        ClaimPart("exact filter of the true model / bound, pooled", FIG7, EXACT,
            threshold=Bound("<=", 1.03), rivals=("bound",), is_pooled=True),
        ClaimPart("multirate / bound: the stiffness error", FIG7, MULTI, rivals=("bound",)),
        ClaimPart("delay ignored / multirate", FIG7, NO_DELAY, rivals=(MULTI,)),
        ClaimPart("delay ignored, tuned for it / multirate", FIG7, RETUNED, rivals=(MULTI,)),
        note="What ignoring the delay costs is a matter of tuning: more than twice the error with "
        "the gains of the filter that knows the delay; far less than that filter's error with "
        "gains tuned for ignoring it, since on a single sine the lag that is left cancels the lag "
        "of too soft tyres."),
    claim("Fig. 9 (twin)", "on the road the bicycle model's filter is the poorest",
        _make_poorest_part(FIG9, None)),
    claim("Fig. 9 (twin)", "on the road the filter with pseudo-residuals is the best",
        *_make_best_parts(FIG9, None)),
)

_BETA = "body slip angle / rad"
_SHOWN = ("truth", BICYCLE, SINGLE, MULTI, PROPOSED)
figure = partial(PaperFigure, PAPER)
FIGURES = (
    figure("Fig. 7: body slip angle, estimators", FIG7, Curves("beta", _BETA, _SHOWN),
        "Sine steering at 25 km/h, tyres 1.2 times stiffer than the filters believe."),
    figure("Fig. 9 (twin): body slip angle, estimators", FIG9,
        Curves("beta", _BETA, _SHOWN, (8.0, 20.0)),
        "The driver's sine while the car goes from 0 to 30 km/h; 12 of 30 s."),
)
