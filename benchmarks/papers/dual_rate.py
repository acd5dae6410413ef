"""dual-rate: the sideslip angle from the GPS's course alone, and its error dynamics.

Other papers share the ranks of observability, which are exact, and the error maps between samples.
Maps lead to X~_{k+i|k+i} after i steps of 1 / r of the sampling period (dual-rate's letters), from
the prediction error X~_{k|k-1} at the sample, without noise.
"""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from ...envs.record import Array
from ...envs.scenarios.world import KMH
from ...envs.vehicle.linear import make_course_model, make_vision_model
from ...envs.vehicle.parameters import COMS
from ...estimators.design import gains
from ..harness.stats import Bound
from .ledger import Analysis, Claim, ClaimPart, Numbers, compare
from .manoeuvres import EstimationSimulation, PaperFilter


def _make_pseudo_maps(A: Array, C: Array, L: Array, r: int) -> list[Array]:
    """Make the maps with pseudo measurements (14), G from (31)."""
    error, maps = np.eye(len(A)), []
    for i, share in enumerate(gains.compute_pseudo_shares(A, C, L, np.linalg.pinv(C) - L, r)):
        error = (A @ error if i > 0 else error) - share @ C  # of the sample's innovation
        maps.append(error)
    return maps


def compare_maps(A: Array, C: Array, L: Array, r: int) -> float:
    """Compare the maps with pseudo measurements to those with a measurement at every step.

    Args:
        A: Transition of a step, shape (n, n).
        C: Measurement, shape (q, n).
        L: Gain, shape (n, q).
        r: Steps between samples.

    Returns:
        Largest difference over the largest map, by Frobenius norms.
    """
    maps, left = _make_pseudo_maps(A, C, L, r), np.eye(len(A)) - L @ C
    fast = [left]  # with a measurement at every step
    for _ in range(1, r):
        fast.append(left @ A @ fast[-1])  # Omega of (22)
    size = max(float(np.linalg.norm(matrix)) for matrix in fast)
    return max(float(np.linalg.norm(a - b)) / size for a, b in zip(maps, fast, strict=True))


Matrix = npt.NDArray[np.object_]  # of fractions


def _rank(matrix: Matrix) -> int:
    """Compute the rank of a matrix of fractions by elimination."""
    rank = 0
    for column in range(matrix.shape[1]):
        pivot = next((i for i in range(rank, len(matrix)) if matrix[i, column] != 0), None)
        if pivot is not None:
            matrix[[rank, pivot]] = matrix[[pivot, rank]]
            factors = matrix[rank + 1 :, column] / matrix[rank, column]
            matrix[rank + 1 :] -= np.outer(factors, matrix[rank])
            rank += 1
    return rank


def _compute_observability_rank(A: Matrix, C: Sequence[Sequence[int]]) -> int:
    """Compute the rank of [C; C A; ...; C A^(n-1)]: dakf-stability IV.D, for the continuous A."""
    # exact sampling cannot raise it, since e^(A T) keeps every A-invariant subspace, nor lower it
    # but for special sampling times
    blocks = [np.array(C) + Fraction(0)]
    for _ in range(len(A) - 1):
        blocks.append(blocks[-1] @ A)
    return _rank(np.concatenate(blocks))


def _add_disturbances(A: Matrix, rows: int) -> Matrix:
    """Add a constant disturbance behind each of the first rows: dakf-stability (15)-(17)."""
    n = len(A)
    extended = np.full((n + rows, n + rows), Fraction(0))
    extended[:n, :n] = A
    extended[range(rows), range(n, n + rows)] = Fraction(1)
    return extended


def compute_coms_ranks(seed: int) -> Numbers:
    """Compute the rank of each paper's observability matrix for the COMS at 25 km/h, exactly.

    Args:
        seed: Without effect: nothing is random.
    """
    A = make_vision_model(COMS, 25.0 * KMH).A
    vision: Matrix = np.array([[Fraction(entry) for entry in row] for row in A])
    course = vision[:3, :3]
    models: dict[str, tuple[Matrix, list[list[int]]]] = {
        "dakf": (_add_disturbances(course, 2), [[0, 1, 0, 0, 0], [1, 0, 1, 0, 0]]),  # gyro, course
        "dual-rate": (_add_disturbances(course, 3), [[1, 0, 1, 0, 0, 0]]),
        "vision": (vision, [[0, 0, 1, 0], [0, 0, 0, 1]]),
    }
    return {(x, "rank"): float(_compute_observability_rank(*y)) for x, y in models.items()}


PAPER = "dual-rate"
MAPS, GAINS, RANKS = "dual-rate-maps", "dual-rate-gains", "dual-rate-rank"
RATIO = 100  # ticks of 1 ms between courses at 10 Hz
SPEED = 25.0 * KMH
COURSE_SD = math.radians(0.14) * (60.0 * KMH) / SPEED
SQUARE, APPLICATION = "square C", "course only"
STRONG, ANY = "strong disturbances", "any tuning"
_GROWS = 1.001  # the unobservable directions stay at 1, to the rounding of a double eigenvalue


def make_extended_model() -> tuple[Array, Array]:
    """Make A and C of (11), the course model at 25 km/h and 1 ms with a random walk per state."""
    model = make_course_model(COMS.replace(front_stiffness=9100.0, rear_stiffness=9100.0), SPEED)
    A = np.zeros((6, 6))
    A[:3, :3], A[:3, 3:] = model.A, np.eye(3)
    return expm(A * 1e-3), np.array([[1.0, 0.0, 1.0, 0.0, 0.0, 0.0]])


def _measure_maps(seed: int) -> Numbers:
    """Compare maps of a random system of three states, all measured, and of the extended model."""
    A, C = make_extended_model()
    R = np.array([[COURSE_SD**2]])
    rng = np.random.default_rng(seed)
    a = 0.97 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    c = rng.normal(size=(3, 3))
    square = compare_maps(a, c, gains.kalman_gain(np.eye(3), c, np.eye(3)), RATIO)
    Q = np.diag(10.0 ** rng.uniform([-4, -4, -8, -2, -2, -7], [-2, -2, -6, 0, 0, -5])) * 1e-3
    P = np.eye(6) * 1e-2
    for _ in range(5000):  # 5 s of fast measurements
        L = gains.kalman_gain(P, C, R)
        P = A @ gains.joseph_form(P, L, C, R) @ A.T + Q
    application = compare_maps(A, C, L, RATIO)
    return {(SQUARE, "difference"): square, (APPLICATION, "difference"): application}


def _measure_gains(seed: int) -> Numbers:
    """Measure the growth of the error from sample to sample with gains from the noise (29)."""
    A, C = make_extended_model()
    R = np.array([[COURSE_SD**2]])
    radii: Numbers = {}
    rng = np.random.default_rng(seed)
    strong = 10.0 ** rng.uniform(math.log10(5.0), math.log10(50.0))
    tunings = {  # process noise (1/s) of the three states, and of the three extended ones
        STRONG: np.array([1e-4] * 3 + [strong] * 3),
        ANY: 10.0 ** rng.uniform([-6.0] * 3 + [-3.0] * 3, [0.0] * 3 + [2.0] * 3),
    }
    for name, q in tunings.items():
        shares = gains.SampledSystem(A, np.diag(q) * 1e-3, C, R, RATIO).compute_shares_29()
        growth = np.linalg.eigvals(gains.frame_map(A, C, shares))
        radii[name, "spectral_radius"] = float(np.abs(growth).max())
    return radii


FIG4, FIG5 = "dual-rate-fig4", "dual-rate-fig5"
CONVENTIONAL, HOLDING, PSEUDO = "conventional", "innovation holding", "pseudo measurement"
PLAIN = "conventional, no disturbance states"
_ENV = "sideslip/YawGps-v0"

# every rule has a tuning of its own, found by Nelder-Mead on the logarithms on seeds 1000 to 1011
# of FIG4; they hold there, at other speeds and rates of the GPS they may diverge
_Q = ("q_beta", "q_gamma", "q_psi", "q_d1", "q_d2", "q_d3")
_RULES: tuple[tuple[str, dict[str, str], tuple[float, ...]], ...] = (
    (CONVENTIONAL, {"intersample": "predict"}, (1.1e-7, 1.4e-2, 5.4e-8, 3.7e-8, 3.4, 9.8e-3)),
    (HOLDING, {"intersample": "hold"}, (9.6e-6, 1.2e-2, 2.7e-8, 2e-8, 7.6, 2e-2)),
    (PSEUDO, {"intersample": "pseudo"}, (1.9e-5, 1.5e-7, 5.5e-4, 1.1e-7, 35.0, 6e-2)),
    (PLAIN, {"intersample": "predict", "disturbances": "none"}, (2.2e-4, 1e-8, 1e-8)),
)
_FILTERS = tuple(
    PaperFilter(x, "dual-rate", rule | dict(zip(_Q, q, strict=False))) for x, rule, q in _RULES
)

SIMULATIONS = (
    *(EstimationSimulation(name, _ENV, name, _FILTERS) for name in (FIG4, FIG5)),
    Analysis(MAPS, _measure_maps),
    Analysis(GAINS, _measure_gains),
    Analysis(RANKS, compute_coms_ranks, share=0.0),
)


def _make_order_parts(scenario: str, max_ratio: float | None) -> tuple[ClaimPart, ...]:
    return (
        compare("pseudo / conventional", scenario, PSEUDO, CONVENTIONAL, max_ratio),
        compare("pseudo / holding", scenario, PSEUDO, HOLDING),
        compare("holding / conventional", scenario, HOLDING, CONVENTIONAL),
    )


# fmt: off
CLAIMS = (
    Claim("Fig. 4",
        "the pseudo measurement is the most accurate, then holding, then prediction alone",
        _make_order_parts(FIG4, 1.12),
        note="With a tuning of its own each rule reaches the same. Oh's rule (35) is the pseudo "
        "measurement (31) to rounding."),
    Claim("Sec. 4.1",
        "slip can be estimated from the GPS's course alone, robustly by disturbance accommodation",
        [compare("pseudo / the slip itself", FIG4, PSEUDO, "truth"),
         compare("with / without disturbance states", FIG4, CONVENTIONAL, PLAIN)],
        note="At 25 km/h the course alone hardly tells slip from heading: an estimate of zero is "
        "about as good."),
    Claim("Fig. 4 (c)", "the pseudo measurement is smoother",
        [compare("jump at a course, pseudo / conventional", FIG4, PSEUDO, CONVENTIONAL,
            0.15, "jump")]),
    Claim("Fig. 5 (twin)", "the pseudo measurement is the most accurate on the road",
        _make_order_parts(FIG5, None)),
    Claim("(33)", "the error dynamics are those of fast measurements",
        [ClaimPart("difference of the maps, square C", MAPS, SQUARE, "difference",
            Bound("<=", 1e-9), Bound("<=", 1e-9), "difference"),
         ClaimPart("difference of the maps, course only", MAPS, APPLICATION, "difference",
            Bound("<=", 1e-9), Bound(">=", 0.2), "difference")],
        note="(30) has no exact solution unless C is invertible, and with disturbance "
        "accommodation it never is: C = [c 0]."),
    Claim("Sec. 3.3", "gains from the pseudo measurement's noise (29) make a filter",
        [ClaimPart(f"spectral radius, {tuning}", GAINS, tuning, "spectral_radius",
                Bound("<=", _GROWS), threshold, "spectral_radius")
            for tuning, threshold in ((STRONG, Bound(">=", 1.1)), (ANY, None))],
        note="The pseudo measurements of a frame all repeat one innovation; taken for independent "
        "ones they are used a hundred times. The error grows where all three extended states are "
        "driven hard (we looked for such a tuning; the paper gives none), and mostly stays "
        "bounded else. As corrected in docs/reference/papers.md; as printed (29) does the same (in "
        "the tests)."),
    Claim("Sec. 4.3", "the extended model's rank (the paper only checks that C C^T is invertible)",
        [ClaimPart("rank, of 6 states", RANKS, PAPER, "rank", None, Bound("=", 4.0), "rank")]),
)
