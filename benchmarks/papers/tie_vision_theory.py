"""tie-vision's theory: the recursions of its appendix, and its convergence.

The appendix is checked term by term on random systems with random gains, as printed and as
docs/reference/papers.md corrects it; the one-step lines of cases 1 and 2 are no equations between
vectors. Of the gains that (16) and (21) leave open two are tried: of (13), and the shipped one.
"""

from collections.abc import Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from ...envs.record import Array
from ...envs.scenarios.world import KMH
from ...envs.sensors.slow import CAMERA_33_30
from ...envs.vehicle.linear import make_vision_model
from ...envs.vehicle.parameters import COMS
from ...estimators.design.gains import kalman_gain
from ...estimators.make import make_estimator
from ..harness.stats import Bound
from .dual_rate import compare_maps
from .ledger import Analysis, Claim, ClaimPart, Numbers

STEPS = 6
STATES, OUTPUTS = 4, 3


def _multiply(factors: Sequence[Array]) -> Array:
    """Multiply factors, the newest on the left, as the appendix has it."""
    return reduce(lambda total, factor: factor @ total, factors, np.eye(STATES))


def _add_terms(total: Array, maps: Sequence[Array], *sums: tuple[Sequence[Array], ...]) -> Array:
    """Add sums over the steps: a factor times an input, times the maps of all later steps."""
    for factors, inputs in sums:
        for p, (factor, x) in enumerate(zip(factors, inputs, strict=True), 1):
            total = total + _multiply(maps[p:]) @ factor @ x
    return total


def _compute_residual(formula: Array, simulated: Array) -> float:
    """Compute a formula's largest difference from the simulated error over that one's size."""
    return float(np.abs(formula - simulated).max() / np.abs(simulated).max())


def _compute_residuals(seed: int) -> Numbers:
    """Compare each case's sum to its recursion, on a random system of random gains.

    Its error neither vanishes nor explodes. Step i has G and w into it, and K and v at its end.
    """
    rng = np.random.default_rng(seed)

    def draw_arrays(*shape: int) -> list[Array]:
        return [rng.normal(size=shape) for _ in range(STEPS + 1)]

    G = [np.eye(STATES) + 0.2 * g for g in draw_arrays(STATES, STATES)][:STEPS]
    K = [0.2 * k for k in draw_arrays(STATES, OUTPUTS)][1:]
    C = rng.normal(size=(OUTPUTS, STATES))
    w, v = draw_arrays(STATES)[:STEPS], draw_arrays(OUTPUTS)[1:]
    start = rng.normal(size=STATES)
    M, identities = [np.eye(STATES) - k @ C for k in K], [np.eye(STATES)] * STEPS
    corrected = [m @ g for m, g in zip(M, G, strict=True)]
    ideal = predicted = compensated = exact = start
    for g, w_i, k, v_i, m in zip(G, w, K, v, M, strict=True):
        moved = g @ ideal + w_i
        ideal = moved - k @ (C @ moved + v_i)  # (17)-(18), a measurement at every step
        predicted = g @ predicted + w_i  # no correction between samples
        compensated = g @ compensated + w_i - k @ v_i  # v stands for any pseudo-residual
        exact = m @ g @ exact + w_i  # with the exact residual C G e
    # what is left of the first error without corrections, and with; printed: G_1 for each G_i
    free, damped = _multiply(G) @ start, _multiply(corrected) @ start
    minus_v, printed = [-x for x in v], [G[1]] * STEPS
    Mw = [m @ x for m, x in zip(M, w, strict=True)]
    cases = {
        "case 1": (_add_terms(damped, corrected, (M, w), (K, minus_v)), ideal),
        "case 2": (_add_terms(free, G, (identities, w)), predicted),
        "case 3 (a)": (_add_terms(free, G, (identities, w), (K, minus_v)), compensated),
        "case 3 (a), printed": (
            _add_terms(free, printed, (identities, w), (K, minus_v)),
            compensated,
        ),
        "case 3 (b)": (_add_terms(damped, corrected, (identities, w)), exact),
        "case 3 (b), printed": (_add_terms(damped, corrected, (identities, Mw)), exact),
    }
    return {(name, "residual"): _compute_residual(*pair) for name, pair in cases.items()}


PAPER = "tie-vision"
MAPS, TUNINGS, APPENDIX = "tie-vision-maps", "tie-vision-tunings", "tie-vision-appendix"
SPEED = 25.0 * KMH
PERIOD, DELAY = 33, 30  # ms, of the camera
R = np.diag([0.005, 3.5e-3, 0.02]) ** 2
LITERAL, SPREAD = "the gain of (13)", "the shipped gain"

C = np.zeros((3, 6))  # of (13): gamma and the delayed psi and y_l
C[0, 1] = C[1, 4] = C[2, 5] = 1.0


def _make_transitions() -> tuple[Array, Array]:
    """Make G of (13) at 1 ms: with delayed states held, and in the step after a trigger (12)."""
    held = np.eye(6)
    held[:4, :4], _ = make_vision_model(COMS, SPEED).discretise(1e-3)
    latched = held.copy()
    latched[4:] = 0.0
    latched[4, 2] = latched[5, 3] = 1.0
    return held, latched


def _compute_spectral_radius(K: Array) -> float:
    """Compute the growth of (error, estimated error e) over a frame: (19)-(22), gyro at 1 ms."""
    held, latched = _make_transitions()
    I, zero = np.eye(6), np.zeros((6, 6))  # noqa: E741
    inverse = C.T @ np.linalg.inv(C @ C.T)
    sample = np.block([[I - K @ C, zero], [(inverse - K) @ C, zero]])  # (19)-(20)
    fast = np.outer(K[:, 0], C[0])
    between = np.block([[I - fast, fast - K @ C], [zero, I - K @ C]])  # (21)-(22)
    total = np.eye(12)
    for k in range(1, PERIOD + 1):  # captured at tick 0, there at DELAY
        move = np.kron(np.eye(2), latched if k == 1 else held)
        total = (sample if k == DELAY else between) @ move @ total
    return float(np.abs(np.linalg.eigvals(total)).max())


def _measure_tunings(seed: int) -> Numbers:
    """Measure the fraction of 20 random tunings with which the error grows."""
    # process noise of each state, up to 1 (unit)^2/s
    tunings = 10.0 ** np.random.default_rng(seed).uniform(-8.0, 0.0, (20, 4))
    sensors = {"camera": CAMERA_33_30}
    make: Any = partial(make_estimator, "multirate-residual-kf", vehicle=COMS, sensors=sensors)
    shipped = [make(speed=SPEED, Q=Q, allow_unstable=True).spectral_radius for Q in tunings]
    _, latched = _make_transitions()
    noises = (np.diag([*Q, 0.0, 0.0]) * 1e-3 for Q in tunings)
    covariances = (solve_discrete_are(latched.T, C.T, noise, R) for noise in noises)
    gains = (kalman_gain(P, C, R) for P in covariances)  # a measurement at every step
    radii = {LITERAL: list(map(_compute_spectral_radius, gains)), SPREAD: shipped}
    shares = {name: float(np.mean(np.array(x) > 1.0 + 1e-9)) for name, x in radii.items()}
    return {(name, "share"): value for name, value in shares.items()}


def _measure_maps(seed: int) -> Numbers:
    """Compare the error dynamics with pseudo-residuals to those of a fast camera; all rows slow."""
    model = make_vision_model(COMS, SPEED)
    G, _ = model.discretise(1e-3)
    Q = 1e-3 * np.diag(10.0 ** np.random.default_rng(seed).uniform(-8.0, 0.0, 4))
    K = kalman_gain(solve_discrete_are(G.T, model.C.T, Q, R), model.C, R)
    return {("pseudo-residuals", "difference"): compare_maps(G, model.C, K, PERIOD)}


_FUNCTIONS = {TUNINGS: _measure_tunings, MAPS: _measure_maps, APPENDIX: _compute_residuals}
SIMULATIONS = tuple(Analysis(name, function) for name, function in _FUNCTIONS.items())

_zero = Bound("<=", 1e-12)
# fmt: off
CLAIMS = (
    Claim("Appendix",
        "pseudo-residuals let the estimate converge, as measurements at every step would",
        [ClaimPart("error dynamics, difference from a fast camera", MAPS, "pseudo-residuals",
            "difference", Bound("<=", 1e-9), metric="difference"),
         *(ClaimPart(f"share of random tunings that diverge, {gain}", TUNINGS, gain,
                "share", Bound("=", 0.0), metric="share")
            for gain in (LITERAL, SPREAD))],
        note="C has full row rank only: (20) cannot know the error that the sample does not see. "
        "How often the filter diverges depends on the gain between samples, which the paper "
        "leaves open."),
    Claim("Appendix", "the error recursions of the three cases",
        [ClaimPart(f"{case}, residual", APPENDIX, case, "residual", None if corrected else _zero,
                _zero if corrected or not case.endswith("printed") else None, "residual")
            for case, corrected in (("case 1", False), ("case 2", False), ("case 3 (a)", True),
                ("case 3 (a), printed", False), ("case 3 (b)", True),
                ("case 3 (b), printed", False))],
        note="Case 3 (a): the products run over G of k+i, not of k+1. Case 3 (b): with the "
        "residual C G e nothing multiplies w; printed is (I - K C) w."),
)
