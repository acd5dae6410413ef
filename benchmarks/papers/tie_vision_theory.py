"""tie-vision's theory: the recursions of its appendix, and its convergence.

The appendix is checked term by term on random systems with random gains, as printed and as
docs/reference/papers.md corrects it; the one-step lines of cases 1 and 2 are no equations between
vectors. Of the gains that (16) and (21) leave open two are tried: of (13), and the shipped one.
"""

from dataclasses import dataclass
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


@dataclass
class _RandomSystem:
    """Steps 0 .. n of a random system: G, w of the step to i+1; K, v of step i (0 unused)."""

    G: list[Array]
    C: Array
    K: list[Array]
    w: list[Array]
    v: list[Array]
    e: Array  # at step 0


def _draw_system(seed: int) -> _RandomSystem:
    """Draw a system with gains that make the error neither vanish nor explode."""
    rng = np.random.default_rng(seed)

    def draw_arrays(*shape: int) -> list[Array]:
        return [rng.normal(size=shape) for _ in range(STEPS + 1)]

    G = [np.eye(STATES) + 0.2 * g for g in draw_arrays(STATES, STATES)]
    K = [0.2 * k for k in draw_arrays(STATES, OUTPUTS)]
    C = rng.normal(size=(OUTPUTS, STATES))
    w, v = draw_arrays(STATES), draw_arrays(OUTPUTS)
    return _RandomSystem(G, C, K, w, v, rng.normal(size=STATES))


def _compute_product(factors: list[Array]) -> Array:
    """Multiply factors, the newest on the left, as the appendix has it."""
    return reduce(lambda total, factor: factor @ total, factors, np.eye(STATES))


def _compute_residual(formula: Array, simulated: Array) -> float:
    """Compute a formula's largest difference from the simulated error over that one's size."""
    return float(np.abs(formula - simulated).max() / np.abs(simulated).max())


def _check_ideal(d: _RandomSystem) -> dict[str, float]:
    """Check case 1: a measurement at every step."""
    n, e = STEPS, d.e
    for i in range(1, n + 1):
        predicted = d.G[i - 1] @ e + d.w[i - 1]
        e = predicted - d.K[i] @ (d.C @ predicted + d.v[i])  # (17)-(18)
    M = [np.eye(STATES) - K @ d.C for K in d.K]
    closed = _compute_product([M[i] @ d.G[i - 1] for i in range(1, n + 1)]) @ d.e
    for p in range(n):
        after = _compute_product([M[i + 1] @ d.G[i] for i in range(p + 1, n)])
        closed = closed + after @ M[p + 1] @ d.w[p]
    for p in range(1, n + 1):
        after = _compute_product([M[i] @ d.G[i - 1] for i in range(p + 1, n + 1)])
        closed = closed - after @ d.K[p] @ d.v[p]
    return {"case 1": _compute_residual(closed, e)}


def _check_predicted(d: _RandomSystem) -> dict[str, float]:
    """Check case 2: no correction between samples."""
    e = d.e
    for i in range(STEPS):
        e = d.G[i] @ e + d.w[i]
    closed = _compute_product(d.G[:STEPS]) @ d.e
    for p in range(STEPS):
        closed = closed + _compute_product(d.G[p + 1 : STEPS]) @ d.w[p]
    return {"case 2": _compute_residual(closed, e)}


def _check_compensated(d: _RandomSystem) -> dict[str, float]:
    """Check case 3: any pseudo-residual; then the exact one, C G e."""
    n, e = STEPS, d.e
    for i in range(1, n + 1):  # v stands for any pseudo-residual: the first form is an identity
        e = d.G[i - 1] @ e + d.w[i - 1] - d.K[i] @ d.v[i]
    sums = {}
    for label, is_printed in (("case 3 (a)", False), ("case 3 (a), printed", True)):
        G = [d.G[1] if is_printed else g for g in d.G]
        closed = _compute_product(d.G[:n]) @ d.e
        for p in range(n):
            closed = closed + _compute_product(G[p + 1 : n]) @ d.w[p]
        for p in range(1, n + 1):
            closed = closed - _compute_product(G[p:n]) @ d.K[p] @ d.v[p]
        sums[label] = _compute_residual(closed, e)
    M = [np.eye(STATES) - K @ d.C for K in d.K]
    e = d.e
    for i in range(1, n + 1):
        e = M[i] @ d.G[i - 1] @ e + d.w[i - 1]  # with the exact residual C G e
    start = _compute_product([M[i] @ d.G[i - 1] for i in range(1, n + 1)]) @ d.e
    for label, is_printed in (("case 3 (b)", False), ("case 3 (b), printed", True)):
        closed = start
        for p in range(n):
            after = _compute_product([M[i + 1] @ d.G[i] for i in range(p + 1, n)])
            closed = closed + after @ (M[p + 1] @ d.w[p] if is_printed else d.w[p])
        sums[label] = _compute_residual(closed, e)
    return sums


def _compute_residuals(seed: int) -> Numbers:
    d = _draw_system(seed)
    by_case = _check_ideal(d) | _check_predicted(d) | _check_compensated(d)
    return {(label, "residual"): value for label, value in by_case.items()}


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
claim = partial(Claim, PAPER)
# fmt: off
CLAIMS = (
    claim("Appendix",
        "pseudo-residuals let the estimate converge, as measurements at every step would",
        ClaimPart("error dynamics, difference from a fast camera", MAPS, "pseudo-residuals",
            "difference", Bound("<=", 1e-9), metric="difference"),
        *(
            ClaimPart(f"share of random tunings that diverge, {gain}", TUNINGS, gain,
                "share", Bound("=", 0.0), metric="share")
            for gain in (LITERAL, SPREAD)
        ),
        note="C has full row rank only: (20) cannot know the error that the sample does not see. "
        "How often the filter diverges depends on the gain between samples, which the paper "
        "leaves open."),
    claim("Appendix", "the error recursions of the three cases",
        *(
            ClaimPart(f"{case}, residual", APPENDIX, case, "residual", None if corrected else _zero,
                _zero if corrected or not case.endswith("printed") else None, "residual")
            for case, corrected in (("case 1", False), ("case 2", False), ("case 3 (a)", True),
                ("case 3 (a), printed", False), ("case 3 (b)", True),
                ("case 3 (b), printed", False))
        ),
        note="Case 3 (a): the products run over G of k+i, not of k+1. Case 3 (b): with the "
        "residual C G e nothing multiplies w; printed is (I - K C) w."),
)
