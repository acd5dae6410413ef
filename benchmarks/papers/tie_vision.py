"""tie-vision: the sideslip angle from camera and gyro, and its control.

Of its controller: feedforward, the loops of Table II, the lane changes of Fig. 8 and 10. Table II
gives two gain margins for closed-loop poles "at -2 Hz", and nothing else. `_search` tries what is
open, for loops of a PI on the sideslip angle, opened at the plant's input.
"""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are
from scipy.optimize import brentq

from ...agents import make_agent
from ...agents.controllers.two_dof import CAMERA_PERIOD, PLACEMENTS, POLE, design_pi
from ...agents.rollout import rollout
from ...envs.numerics.functions import TICK
from ...envs.record import Array
from ...envs.scenarios.world import KMH
from ...envs.vehicle.linear import make_bicycle_model, make_vision_model
from ...envs.vehicle.parameters import COMS
from ...estimators.design.gains import kalman_gain
from ..harness.stats import Bound
from .ledger import Analysis, Claim, ClaimPart, Numbers, compare
from .manoeuvres import BOUND, ControlSimulation, Driver, EstimationSimulation, PaperFilter

if TYPE_CHECKING:
    from control import StateSpace

Parts = tuple[Array, Array, Array, Array]
_Complex = npt.NDArray[np.complex128]

PRINTED = (5.92, 22.8)  # dB, single-rate and multirate: Table II of tie-vision
_PERIODS = (CAMERA_PERIOD, TICK)  # s, of the two
SENSORS = ("gyro", "vision", "vision-delayed")
INTEGRALS = {"forward-euler": 0.0, "tustin": 0.5, "backward-euler": 1.0}  # share of this sample


@dataclass(frozen=True)
class LoopDesign:
    """The choices that Table II leaves open."""

    speed: float = 25.0 * KMH  # m/s
    placement: str = "real"  # of `design_pi`
    integral: str = "forward-euler"  # of `INTEGRALS`
    sensors: str = "gyro"  # at every step: gyro; with psi and y_l; these a step late, (12)-(13)
    q_ratio: float = 25.75  # process variance of beta over gamma's, which psi and y_l have too
    noise: float = 1e-9  # variance of every measurement over gamma's process variance


def _make_plain_loop(design: LoopDesign, dt: float) -> "StateSpace":
    """Make the loop of PI and plant with beta measured without delay; moment held over dt (s)."""
    import control

    pi = design_pi(COMS, design.speed, POLE, design.placement)
    G, H = make_bicycle_model(COMS, design.speed).discretise(dt)
    plant = control.StateSpace(G, H[:, 1:], [[1.0, 0.0]], 0.0, dt)
    direct = pi.k_p + INTEGRALS[design.integral] * pi.k_i * dt
    return plant * control.StateSpace(1.0, pi.k_i * dt, 1.0, direct, dt)


@lru_cache(maxsize=1024)
def _make_filter(speed: float, sensors: str, q_ratio: float, noise: float, dt: float) -> Parts:
    """Make (G, H, C, K): from the yaw moment to what the filter measures, and its steady gain."""
    model = (make_bicycle_model if sensors == "gyro" else make_vision_model)(COMS, speed)
    G, H = model.discretise(dt)
    H, C = H[:, 1:2], model.C
    if sensors == "vision-delayed":
        G = np.block([[G, np.zeros((4, 2))], [np.eye(6)[2:4]]])  # tie-vision (12)
        H = np.vstack([H, np.zeros((2, 1))])
        C = np.eye(6)[[1, 4, 5]]  # tie-vision (13)
    Q = np.zeros_like(G)
    driven = min(len(G), 4)  # what (12) only remembers is not driven
    Q[range(driven), range(driven)] = [q_ratio, 1.0, 1.0, 1.0][:driven]
    R = noise * np.eye(len(C))
    return G, H, C, kalman_gain(solve_discrete_are(G.T, C.T, Q, R), C, R)


def _make_estimator_loop(design: LoopDesign, dt: float) -> "StateSpace":
    """Make the loop of plant, Kalman filter and PI, opened where the moment enters the plant."""
    # The filter's input is the moment that the PI commands: opened behind both, a filter with the
    # right model would not show in the loop at all.
    import control

    pi = design_pi(COMS, design.speed, POLE, design.placement)
    G, H, C, K = _make_filter(design.speed, design.sensors, design.q_ratio, design.noise, dt)
    # the integral's sum grows by k_i dt error in all three forms
    F, direct = np.eye(len(G)) - K @ C, pi.k_p + INTEGRALS[design.integral] * pi.k_i * dt
    beta_x, beta_y = F[:1], K[:1]  # the estimate of beta from the prediction and from y
    one = np.ones((1, 1))
    A = np.block([[G @ F - direct * H @ beta_x, H], [-pi.k_i * dt * beta_x, one]])
    B = np.vstack([G @ K - direct * H @ beta_y, -pi.k_i * dt * beta_y])
    asks = control.StateSpace(A, B, np.hstack([direct * beta_x, -one]), direct * beta_y, dt)
    return asks * control.StateSpace(G, H, C, np.zeros((len(C), 1)), dt)


_GRID: dict[str, tuple[float | str, ...]] = {
    "speed": tuple(kmh * KMH for kmh in (10.0, 14.0, 20.0, 25.0, 30.0)),
    "placement": PLACEMENTS,
    "integral": tuple(INTEGRALS),
    "sensors": SENSORS,
    "q_ratio": tuple(float(10.0**power) for power in np.arange(-1.0, 4.01, 0.1)),
}


def _search() -> dict[LoopDesign, float]:
    """Search the grid's designs with both margins near Table II's, as stable, best first.

    Each has the larger difference (dB) of its margins to the printed ones.
    """
    import control

    hits = dict[LoopDesign, float]()
    for values in itertools.product(*_GRID.values()):
        options: dict[str, Any] = dict(zip(_GRID, values, strict=True))
        design, differences = LoopDesign(**options), []
        for dt, printed in zip(_PERIODS, PRINTED, strict=True):
            loop = _make_estimator_loop(design, dt)
            end = _compute_response(loop, np.array([-1.0 + 0.0j]))[0].real  # before all crossings
            if end >= 0.0 or abs(-20.0 * math.log10(-end) - printed) > 0.5:
                break
            decibels, omega = _compute_gain_margin(loop)
            is_stable = np.abs(control.feedback(loop, 1).poles()).max() < 1.0
            if abs(omega * dt - math.pi) > 1e-9 or not is_stable:  # as in the paper
                break
            differences.append(abs(decibels - printed))
        else:
            hits[design] = max(differences)
    return dict(sorted(hits.items(), key=lambda item: item[1]))


# Gain margins: how much the loops of the paper's Table II may grow until they reach -1.
_DECADES, _POINTS = 6, 4000  # of the frequency grid, below half the sampling rate


def _find_crossings(loop: "StateSpace") -> Array:
    """Find the factors on the loop that bring it to -1, and rad/s, by frequency: (n, 2)."""
    # L is real at z = -1: where it is negative there, half the sampling rate is a phase crossover.
    # python-control's `stability_margins` finds crossings by a change of sign, and there is none at
    # the end of the axis. The others are bracketed on a grid and refined.
    dt = float(loop.dt)
    top = math.pi / dt

    def evaluate_loop(omega: float) -> complex:
        return complex(_compute_response(loop, np.exp(1j * np.array([omega * dt])))[0])

    grid = top * np.logspace(-_DECADES, 0.0, _POINTS)[:-1]
    signs = np.sign(_compute_response(loop, np.exp(1j * grid * dt)).imag)
    changes = np.flatnonzero(signs[:-1] * signs[1:] < 0.0)
    frequencies = [
        float(brentq(lambda w: evaluate_loop(w).imag, low, high, xtol=1e-14 * low, rtol=1e-14))
        for low, high in zip(grid[changes], grid[1:][changes], strict=True)
    ]
    values = [(evaluate_loop(omega), omega) for omega in frequencies]
    factors = [(1.0 / abs(value), omega) for value, omega in values if value.real < 0.0]
    end = evaluate_loop(top).real
    return np.reshape([*factors, *([(-1.0 / end, top)] if end < 0.0 else [])], (-1, 2))


def _compute_gain_margin(loop: "StateSpace") -> tuple[float, float]:
    """Compute the smallest gain (dB) above 1 with which a loop reaches -1, and its rad/s."""
    rising = [(factor, omega) for factor, omega in _find_crossings(loop).tolist() if factor > 1.0]
    factor, omega = min(rising, default=(math.inf, math.nan))
    return 20.0 * math.log10(factor), omega


def _compute_response(loop: "StateSpace", z: _Complex) -> _Complex:
    """Compute a loop's response at points z, (n,), by one solve."""
    shifted = z[:, None, None] * np.eye(len(loop.A)) - loop.A
    return np.asarray((loop.C @ np.linalg.solve(shifted, loop.B[None]) + loop.D)[:, 0, 0])


PAPER = "tie-vision"
FIG7, FIG9 = "tie-vision-fig7", "tie-vision-fig9"
FIG8, STIFF, FIG10 = "tie-vision-fig8", "tie-vision-fig8-stiff", "tie-vision-fig10"
STATIC, TABLE2 = "tie-vision-static", "tie-vision-table2"
SINGLE, MULTI, PROPOSED = "single-rate", "multirate", "multirate-residual"
EQUAL = "multirate, gain margin of single-rate"
HERTZ = (15.15, 477.46)  # Table II's crossovers
BICYCLE, SINGLE_KF, MULTI_KF = "bicycle-kf", "single-rate-kf", "multirate-kf"
RESIDUAL_KF, EXACT = "multirate-residual-kf", "exact-kf, true model"
NO_DELAY = "multirate-kf, delay ignored"
RETUNED = "multirate-kf, delay ignored, tuned for it"

_ENV = "sideslip/YawVision-v0"
_FILTERS = tuple(PaperFilter(name, name) for name in (BICYCLE, SINGLE_KF, MULTI_KF, RESIDUAL_KF))
# as tunings.toml, but with psi and y_l's noise free too: seeds 1000 to 1011 of this drive
_Q = {"q_beta": 8.8e-3, "q_gamma": 0.15, "q_psi": 2.9e-8, "q_y_l": 1.3e-7}
_FOR_NO_DELAY = {**_Q, "psi_noise": 1.5e-3, "y_l_noise": 2.2}


def _measure_static_slip(_: int) -> Numbers:
    """Measure the slip left after 10 s of steering by 0.001 rad with the feedforward (24)."""
    left = []
    for kmh in range(10, 46, 5):
        scenario = {
            "base": FIG8, "name": "static", "steering": "step", "onset": 0.0, "amplitude": 0.001,
            "hold": 60.0, "duration": 10.0, "speed": kmh * KMH, "noise": {"wheel": 0.0},
        }  # fmt: skip
        env = gym.make(_ENV, scenario=scenario)
        left.append(abs(rollout(env, make_agent("feedforward", env))["beta"][-1]))
    return {("feedforward", "static_slip"): np.array(left)}


def _measure_table_two(_: int) -> Numbers:
    """Measure the loops of the search that fit Table II, and the best of 25 km/h."""
    matches, margins = _search(), []  # margins in dB, the same PI on the true slip
    at_25 = next((x for x in matches if math.isclose(x.speed, 25.0 * KMH)), LoopDesign())
    for design in (LoopDesign(placement=name) for name in ("real", "radius")):
        loops = (_make_plain_loop(design, dt) for dt in _PERIODS)
        margins.append([_compute_gain_margin(loop)[0] for loop in loops])
    numbers: Numbers = {
        ("loops", "count"): float(len(matches)),
        ("loops", "off"): min(matches.values(), default=math.inf),
        ("25 km/h", "off"): matches.get(at_25, math.inf),
        ("same PI", "raised"): np.diff(margins)[:, 0],
    }
    for label, dt in zip((SINGLE, MULTI), _PERIODS, strict=True):
        omega = _compute_gain_margin(_make_estimator_loop(at_25, dt))[1]
        numbers[label, "crossover"] = round(omega / (2.0 * math.pi), 2)
    return numbers


_DRIVERS = {
    "none": Driver("none"),
    "feedforward": Driver("feedforward"),
    SINGLE: Driver("two-dof", SINGLE_KF, {"rate": "camera"}),
    MULTI: Driver("two-dof", MULTI_KF, {"rate": "control"}),
    PROPOSED: Driver("two-dof", RESIDUAL_KF, {"rate": "control"}),
}
_STRONGER = Driver("two-dof", MULTI_KF, {"rate": "control", "gain": 10.0 ** (28.8 / 20.0)})
# fmt: off
SIMULATIONS = (
    EstimationSimulation(FIG7, _ENV, FIG7,
        (*_FILTERS, PaperFilter(NO_DELAY, MULTI_KF, {"delay": "ignore"}),
            PaperFilter(RETUNED, MULTI_KF, {"delay": "ignore", **_FOR_NO_DELAY}),
            PaperFilter(EXACT, "exact-kf", vehicle="true")), bound=True, share=5.0),
    EstimationSimulation(FIG9, _ENV, FIG9, _FILTERS),
    Analysis(TABLE2, _measure_table_two, share=0.0),
    ControlSimulation(FIG8, _ENV, FIG8, _DRIVERS | {EQUAL: _STRONGER}),
    ControlSimulation(STIFF, _ENV, STIFF, _DRIVERS),
    ControlSimulation(FIG10, _ENV, FIG10, {x: _DRIVERS[x] for x in _DRIVERS if x != "feedforward"}),
    Analysis(STATIC, _measure_static_slip, share=0.0),
)
# fmt: on


def _make_poorest_part(scenario: str, threshold: Bound | None) -> ClaimPart:
    label, rivals = "bicycle / poorest vision filter", (SINGLE_KF, MULTI_KF, RESIDUAL_KF)
    bounds = Bound(">", 1.0), threshold
    return ClaimPart(label, scenario, BICYCLE, "beta", *bounds, rivals=rivals, pick=np.max)


def _make_best_parts(scenario: str, max_ratio: float | None) -> tuple[ClaimPart, ...]:
    return (
        compare("proposed / bicycle", scenario, RESIDUAL_KF, BICYCLE),
        compare("proposed / single-rate", scenario, RESIDUAL_KF, SINGLE_KF),
        compare("proposed / multirate", scenario, RESIDUAL_KF, MULTI_KF, max_ratio),
    )


_TYRES = {FIG8: "nominal", STIFF: "tyres x 1.2", FIG10: "twin"}
# fmt: off
CLAIMS = (
    Claim("Fig. 7", "the bicycle model's filter is the poorest",
        [_make_poorest_part(FIG7, Bound(">=", 1.05))]),
    Claim("Fig. 7", "the multirate filter with pseudo-residuals is the best",
        _make_best_parts(FIG7, 1.10),
        note="For an optimal gain the expected error given the residual is zero: the correction "
        "adds no information, it is a change of gain."),
    Claim("Fig. 7", "how far from the best possible, and what the delay costs",
        [ClaimPart("exact filter of the true model / bound, pooled", FIG7, EXACT,
            threshold=Bound("<=", 1.03), rivals=(BOUND,), is_pooled=True),
         ClaimPart("multirate / bound: the stiffness error", FIG7, MULTI_KF, rivals=(BOUND,)),
         ClaimPart("delay ignored / multirate", FIG7, NO_DELAY, rivals=(MULTI_KF,)),
         ClaimPart("delay ignored, tuned for it / multirate", FIG7, RETUNED, rivals=(MULTI_KF,))],
        note="What ignoring the delay costs is a matter of tuning: more than twice the error with "
        "the gains of the filter that knows the delay; far less than that filter's error with "
        "gains tuned for ignoring it, since on a single sine the lag that is left cancels the lag "
        "of too soft tyres."),
    Claim("Fig. 9 (twin)", "on the road the bicycle model's filter is the poorest",
        [_make_poorest_part(FIG9, None)]),
    Claim("Fig. 9 (twin)", "on the road the filter with pseudo-residuals is the best",
        _make_best_parts(FIG9, None)),
    Claim("(24)", "the feedforward brings the static slip to zero",
        [ClaimPart("slip left, 10 to 45 km/h", STATIC, "feedforward", "static_slip",
            Bound("<", 1e-9), Bound("<", 1e-9), "static_slip")]),
    Claim("Table II", "gain margins of 5.92 dB at 15.15 Hz and 22.8 dB at 477.46 Hz",
        [ClaimPart("farther of both margins from the printed ones, best loop / dB", TABLE2,
            "loops", "off", Bound("<=", 0.05), Bound("<=", 0.5), "decibels"),
         ClaimPart("the same, best loop at 25 km/h / dB", TABLE2, "25 km/h", "off",
            Bound("<=", 0.05), Bound("<=", 0.5), "decibels"),
         *(ClaimPart(f"crossover of the {label} loop / Hz", TABLE2, label, "crossover",
                Bound("=", hertz), metric="hertz")
            for label, hertz in zip((SINGLE, MULTI), HERTZ, strict=True)),
         ClaimPart("loops of the search within 0.5 dB of both", TABLE2, "loops", "count",
            metric="count")],
        note="The table gives no speed, no Q and R, no discretisation: a search of "
        "4590 loops finds those that fit. Several do, at several speeds: the table does not tell "
        "which was meant. Every loop crosses at half its sampling rate; 477.46 Hz is 3000 rad/s, "
        "probably where a frequency grid ended."),
    Claim("Table II", "multirate feedback raises the gain margin",
        [ClaimPart("multirate - single-rate, the same PI / dB", TABLE2, "same PI", "raised",
            Bound(">", 0.0), Bound(">=", 20.0), "decibels")]),
    Claim("Fig. 8", "the controller reduces the slip",
        [compare(f"{agent} / none, {_TYRES[name]}", name, agent, "none", max_ratio, "rms_slip")
            for name, max_ratio in ((FIG8, 0.40), (STIFF, 0.55))
            for agent in (SINGLE, MULTI)]),
    Claim("Fig. 8 (a)", "the multirate controller keeps the slip smaller than the single-rate one",
        [compare(f"{agent} / single-rate, {_TYRES[name]}", name, agent, SINGLE,
                max_ratio, "rms_slip")
            for name, max_ratio in ((FIG8, 0.92), (STIFF, None))
            for agent in (MULTI, PROPOSED)]),
    Claim("Fig. 8 (b)", "the multirate controller's input is smoother",
        [compare("largest 1 ms step, pseudo-residuals / single-rate", FIG8, PROPOSED,
            SINGLE, 0.4, "largest_step"),
         compare("total variation, pseudo-residuals / single-rate", FIG8, PROPOSED, SINGLE,
            quantity="total_variation")]),
    Claim("Fig. 8", "the gain margins of both control systems were set to be the same",
        [ClaimPart("share of time at the yaw moment's limit, multirate with single-rate's margin",
            FIG8, EQUAL, "saturation", metric="share"),
         ClaimPart("its slip / multirate with the same PI", FIG8, EQUAL, "rms_slip",
            rivals=(MULTI,))],
        note="Taken literally the multirate PI is 28.8 dB stronger and its yaw moment jumps from "
        "limit to limit with the noise."),
    Claim("Fig. 10 (twin)", "on the road control reduces the slip, multirate more than single-rate",
        [compare("single-rate / none", FIG10, SINGLE, "none", quantity="rms_slip"),
         compare("pseudo-residuals / none", FIG10, PROPOSED, "none", quantity="rms_slip"),
         compare("pseudo-residuals / single-rate", FIG10, PROPOSED, SINGLE, quantity="rms_slip")]),
)
