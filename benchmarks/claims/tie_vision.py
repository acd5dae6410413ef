"""tie-vision: body slip angle from a camera and a gyro, and a controller that keeps it at zero."""

from functools import partial

import gymnasium as gym
import numpy as np

from ...agents import make_agent
from ...agents.rollout import rollout
from ...envs.scenario import KMH
from .claim import Bound, Claim, Measured, Part, number, over_others, ratio
from .draw import PaperFigure, curves
from .simulations import Analysis, Control, Estimation, Filter
from .tie_vision_appendix import residuals
from .tie_vision_convergence import LITERAL, SPREAD, intersample_maps, random_tunings

PAPER = "tie-vision"
FIG7, FIG8, STIFF = "tie-vision-fig7", "tie-vision-fig8", "tie-vision-fig8-stiff"
BICYCLE, SINGLE, MULTI = "bicycle-kf", "single-rate-kf", "multirate-kf"
PROPOSED, EXACT = "multirate-residual-kf", "exact-kf, true model"
NO_DELAY = "multirate-kf, delay ignored"


def static_slip(_: tuple[int, ...]) -> Measured:
    """The slip left after 10 s of steering by 0.001 rad with the feedforward (24), by speed."""
    left = []
    for kmh in range(10, 46, 5):
        scenario = {
            "base": FIG8,
            "name": "static",
            "steering": "step",
            "onset": 0.0,
            "amplitude": 0.001,
            "hold": 60.0,
            "duration": 10.0,
            "speed": kmh * KMH,
            "noise": {"wheel": 0.0, "gyro": 0.0},
        }
        env = gym.make("sideslip/YawVision-v0", scenario=scenario)
        left.append(abs(rollout(env, make_agent("feedforward", env))["beta"][-1]))
    return Measured({("feedforward", "static_slip"): np.array(left)})


SIMULATIONS = (
    Estimation(
        FIG7,
        "sideslip/YawVision-v0",
        FIG7,
        (
            *(Filter(name, name) for name in (BICYCLE, SINGLE, MULTI, PROPOSED)),
            Filter(NO_DELAY, MULTI, {"delay": "ignore"}),
            Filter(EXACT, "exact-kf", told="truth"),
        ),
        bound=True,
        times=5,
    ),
    Control(FIG8, FIG8, ("none", "feedforward", "single-rate", "multirate", "multirate-residual")),
    Control(
        STIFF, STIFF, ("none", "feedforward", "single-rate", "multirate", "multirate-residual")
    ),
    Analysis("tie-vision-static", static_slip, random=False),
    Analysis("tie-vision-tunings", random_tunings),
    Analysis("tie-vision-maps", intersample_maps),
    Analysis("tie-vision-appendix", residuals),
)

_fig7 = partial(ratio, FIG7)
_zero = Bound("<=", 1e-12)
CLAIMS = (
    Claim(
        PAPER,
        "(24)",
        "the feedforward brings the static slip to zero",
        (
            Part(
                "slip left, 10 to 45 km/h",
                "tie-vision-static",
                number("tie-vision-static", "feedforward", "static_slip"),
                Bound("<", 1e-9),
                Bound("<", 1e-9),
                "static_slip",
            ),
        ),
    ),
    Claim(
        PAPER,
        "Fig. 7",
        "the bicycle model's filter is the poorest",
        (
            Part(
                "bicycle / poorest vision filter",
                FIG7,
                over_others(FIG7, BICYCLE, (SINGLE, MULTI, PROPOSED), np.max),
                Bound(">", 1.0),
                Bound(">=", 1.05),
            ),
        ),
    ),
    Claim(
        PAPER,
        "Fig. 7",
        "the multirate filter with pseudo-residuals is the best",
        (
            Part("proposed / bicycle", FIG7, _fig7(PROPOSED, BICYCLE), Bound("<", 1.0)),
            Part("proposed / single-rate", FIG7, _fig7(PROPOSED, SINGLE), Bound("<", 1.0)),
            Part(
                "proposed / multirate",
                FIG7,
                _fig7(PROPOSED, MULTI),
                Bound("<", 1.0),
                Bound("<=", 1.10),
            ),
        ),
        "For an optimal gain the expected error given the residual is zero: the correction adds no "
        "information, it is a change of gain.",
    ),
    Claim(
        PAPER,
        "Fig. 7",
        "how far from the best possible, and what the delay costs",
        (
            Part(
                "exact filter of the true model / bound, pooled",
                FIG7,
                lambda results: _pooled(results[FIG7], EXACT, "bound"),
                threshold=Bound("<=", 1.03),
            ),
            Part("multirate / bound: the stiffness error", FIG7, _fig7(MULTI, "bound")),
            Part("delay ignored / multirate", FIG7, _fig7(NO_DELAY, MULTI)),
        ),
    ),
    Claim(
        PAPER,
        "Appendix",
        "pseudo-residuals let the estimate converge, as measurements at every step would",
        (
            Part(
                "error dynamics, difference from a fast camera",
                "tie-vision-maps",
                number("tie-vision-maps", "pseudo-residuals", "difference"),
                Bound("<=", 1e-9),
                metric="difference",
            ),
            *(
                Part(
                    f"share of random tunings that diverge, {gain}",
                    "tie-vision-tunings",
                    number("tie-vision-tunings", gain, "share"),
                    Bound("=", 0.0),
                    metric="share",
                )
                for gain in (LITERAL, SPREAD)
            ),
        ),
        "C has full row rank only: (20) cannot know the error that the sample does not see. How "
        "often the filter diverges depends on the gain between samples, which the paper leaves "
        "open.",
    ),
    Claim(
        PAPER,
        "Appendix",
        "the error recursions of the three cases",
        tuple(
            Part(
                f"{case}, residual",
                "tie-vision-appendix",
                number("tie-vision-appendix", case, "residual"),
                None if corrected else _zero,
                _zero if corrected or not case.endswith("printed") else None,
                "residual",
            )
            for case, corrected in (
                ("case 1", False),
                ("case 2", False),
                ("case 3 (a)", True),
                ("case 3 (a), printed", False),
                ("case 3 (b)", True),
                ("case 3 (b), printed", False),
            )
        ),
        "Case 3 (a): the products run over G of k+i, not of k+1. Case 3 (b): with the residual "
        "C G e nothing multiplies w; printed is (I - K C) w.",
    ),
    Claim(
        PAPER,
        "Fig. 8",
        "the controller reduces the slip",
        tuple(
            Part(
                f"{who} / none, {'tyres x 1.2' if scenario == STIFF else 'nominal'}",
                scenario,
                ratio(scenario, who, "none", "rms_slip"),
                Bound("<", 1.0),
                Bound("<=", 0.55 if scenario == STIFF else 0.40),
            )
            for scenario in (FIG8, STIFF)
            for who in ("single-rate", "multirate")
        ),
    ),
    Claim(
        PAPER,
        "Fig. 8 (a)",
        "the multirate controller keeps the slip smaller than the single-rate one",
        tuple(
            Part(
                f"{who} / single-rate, {'tyres x 1.2' if scenario == STIFF else 'nominal'}",
                scenario,
                ratio(scenario, who, "single-rate", "rms_slip"),
                Bound("<", 1.0),
                None if scenario == STIFF else Bound("<=", 0.92),
            )
            for scenario in (FIG8, STIFF)
            for who in ("multirate", "multirate-residual")
        ),
    ),
    Claim(
        PAPER,
        "Fig. 8 (b)",
        "the multirate controller's input is smoother",
        (
            Part(
                "largest 1 ms step, pseudo-residuals / single-rate",
                FIG8,
                ratio(FIG8, "multirate-residual", "single-rate", "largest_step"),
                Bound("<", 1.0),
                Bound("<=", 0.4),
            ),
            Part(
                "total variation, pseudo-residuals / single-rate",
                FIG8,
                ratio(FIG8, "multirate-residual", "single-rate", "total_variation"),
                Bound("<", 1.0),
            ),
        ),
    ),
)


def _pooled(measured: Measured, one: str, other: str) -> np.ndarray:
    """The ratio of RMS values over all seeds together, (1,)."""
    squares = [np.mean(measured.numbers[who, "beta"] ** 2) for who in (one, other)]
    return np.array([np.sqrt(squares[0] / squares[1])])


_BETA = "body slip angle / rad"
_FIG8 = ("none", "single-rate", "multirate", "multirate-residual")
FIGURES = (
    PaperFigure(
        PAPER,
        "Fig. 7: body slip angle, estimators",
        FIG7,
        curves("beta", _BETA, ("truth", BICYCLE, SINGLE, MULTI, PROPOSED)),
        "Sine steering at 25 km/h, tyres 1.2 times stiffer than the filters believe.",
    ),
    PaperFigure(
        PAPER,
        "Fig. 8 (a): body slip angle, controllers",
        FIG8,
        curves("beta", _BETA, _FIG8),
        "One lane change at 25 km/h, tyres as the controllers believe.",
    ),
    PaperFigure(
        PAPER,
        "Fig. 8 (b): yaw moment",
        FIG8,
        curves("yaw_moment", "yaw moment / (N m)", _FIG8[1:]),
        "The control input; single-rate decides every 33 ms.",
    ),
    PaperFigure(
        PAPER,
        "Fig. 8 (a) with tyres 1.2 times stiffer",
        STIFF,
        curves("beta", _BETA, _FIG8),
        "The same lane change, when the controllers believe in too soft tyres.",
    ),
    PaperFigure(
        PAPER,
        "Fig. 8 (b) with tyres 1.2 times stiffer",
        STIFF,
        curves("yaw_moment", "yaw moment / (N m)", _FIG8[1:]),
        "The control input on stiffer tyres.",
    ),
)
