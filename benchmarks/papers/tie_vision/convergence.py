"""Does tie-vision's filter with pseudo-residuals converge, and with how many tunings?

The paper leaves open which gain its (16), (21) use between samples. Two are tried with the same
random process noise: the Kalman gain of (13) at 1 ms, every row corrected at every step, as the
four steps (19)-(22) read; and the shipped filter's, which spreads the multirate filter's gain over
the frame.
"""

from functools import partial

import numpy as np
from scipy.linalg import solve_discrete_are

from ....envs.record import Array
from ....envs.scenarios.draws import KMH
from ....envs.sensors.slow import CAMERA_33_30
from ....envs.vehicle.linear import make_vision_model
from ....envs.vehicle.vehicle import COMS
from ....estimators.design import kalman
from ....estimators.make import make_estimator
from ..ledger.claim import Bound, Example, SimulationResult, make_claim_factory, make_number_part
from ..ledger.plots import PaperFigure, make_curves
from ..ledger.simulations import FIRST, Analysis
from ..theory import error_maps
from .appendix import compute_residuals

PAPER = "tie-vision"
MAPS, TUNINGS, APPENDIX = "tie-vision-maps", "tie-vision-tunings", "tie-vision-appendix"
SPEED = 25.0 * KMH
PERIOD, DELAY = 33, 30  # ms, of the camera
R = np.diag([0.005, 3.5e-3, 0.02]) ** 2
LITERAL, SPREAD = "the gain of (13)", "the shipped gain"

C = np.zeros((3, 6))  # of (13): gamma and the delayed psi and y_l
C[0, 1] = C[1, 4] = C[2, 5] = 1.0


def make_transitions() -> tuple[Array, Array]:
    """G of (13) at 1 ms: with the delayed states held, and in the step after a trigger (12)."""
    held = np.eye(6)
    held[:4, :4], _ = make_vision_model(COMS, SPEED).discretise(1e-3)
    latched = held.copy()
    latched[4:] = 0.0
    latched[4, 2] = latched[5, 3] = 1.0
    return held, latched


def compute_literal_gain(Q: Array) -> Array:
    """The Kalman gain of (13) at 1 ms with a measurement at every step, (6, 3)."""
    _, latched = make_transitions()
    noise = np.diag([*Q, 0.0, 0.0]) * 1e-3
    return kalman.kalman_gain(solve_discrete_are(latched.T, C.T, noise, R), C, R)


def compute_spectral_radius(K: Array) -> float:
    """Growth of (error, estimated error e) over a frame: (19)-(22) with the gyro at 1 ms."""
    held, latched = make_transitions()
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


def measure_tunings(seeds: tuple[int, ...], batch: int = 20) -> SimulationResult:
    """The share of random tunings with which the error grows; a batch a seed.

    Process noise of each state log-uniform over eight decades up to 1 (unit)^2/s.
    """
    shares: dict[str, list[float]] = {LITERAL: [], SPREAD: []}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        tunings = 10.0 ** rng.uniform(-8.0, 0.0, (batch, 4))
        radii = {
            LITERAL: [compute_spectral_radius(compute_literal_gain(Q)) for Q in tunings],
            SPREAD: [_compute_shipped_radius(Q) for Q in tunings],
        }
        for name, tuning_radii in radii.items():
            shares[name].append(float(np.mean(np.array(tuning_radii) > 1.0 + 1e-9)))
    return SimulationResult({(name, "share"): np.array(values) for name, values in shares.items()})


def _compute_shipped_radius(Q: Array) -> float:
    return make_estimator(
        "multirate-residual-kf",
        vehicle=COMS,
        sensors={"camera": CAMERA_33_30},
        speed=SPEED,
        Q=Q,
        allow_unstable=True,
    ).spectral_radius


def measure_maps(seeds: tuple[int, ...]) -> SimulationResult:
    """The difference of the error dynamics with pseudo-residuals from those of a fast camera.

    The vision model at 1 ms, every row slow, a Kalman gain of random process noise a seed. The
    example has the size of the maps of the appendix's three cases, of the first seed.
    """
    model = make_vision_model(COMS, SPEED)
    G, _ = model.discretise(1e-3)
    differences, example = [], None
    for seed in seeds:
        Q = 1e-3 * np.diag(10.0 ** np.random.default_rng(seed).uniform(-8.0, 0.0, 4))
        K = kalman.kalman_gain(solve_discrete_are(G.T, model.C.T, Q, R), model.C, R)
        cases = {
            "ideal": error_maps.make_fast_maps(G, model.C, K, PERIOD),
            "none": error_maps.make_predicted_maps(G, model.C, K, PERIOD),
            "pseudo-residuals": error_maps.make_pseudo_maps(G, model.C, K, PERIOD),
        }
        differences.append(error_maps.compute_difference(cases["pseudo-residuals"], cases["ideal"]))
        if seed == FIRST:
            initial_size = np.linalg.norm(np.eye(len(G)))
            sizes = {
                name: {
                    "error": np.array([np.linalg.norm(matrix) / initial_size for matrix in maps])
                }
                for name, maps in cases.items()
            }
            example = Example(np.arange(float(PERIOD)), sizes)
    return SimulationResult({("pseudo-residuals", "difference"): np.array(differences)}, example)


SIMULATIONS = (
    Analysis(TUNINGS, measure_tunings),
    Analysis(MAPS, measure_maps),
    Analysis(APPENDIX, compute_residuals),
)

_zero = Bound("<=", 1e-12)
claim = make_claim_factory(PAPER)
# A claim a paragraph, a part a line: by hand.
# fmt: off
CLAIMS = (
    claim("Appendix",
        "pseudo-residuals let the estimate converge, as measurements at every step would",
        make_number_part("error dynamics, difference from a fast camera", MAPS, "pseudo-residuals",
            "difference", Bound("<=", 1e-9), metric="difference"),
        *(
            make_number_part(f"share of random tunings that diverge, {gain}", TUNINGS, gain,
                             "share",
                Bound("=", 0.0), metric="share")
            for gain in (LITERAL, SPREAD)
        ),
        note="C has full row rank only: (20) cannot know the error that the sample does not see. "
        "How often the filter diverges depends on the gain between samples, which the paper "
        "leaves open."),
    claim("Appendix", "the error recursions of the three cases",
        *(
            make_number_part(f"{case}, residual", APPENDIX, case, "residual",
                             None if corrected else _zero,
                _zero if corrected or not case.endswith("printed") else None, "residual")
            for case, corrected in (("case 1", False), ("case 2", False), ("case 3 (a)", True),
                ("case 3 (a), printed", False), ("case 3 (b)", True),
                ("case 3 (b), printed", False))
        ),
        note="Case 3 (a): the products run over G of k+i, not of k+1. Case 3 (b): with the "
        "residual C G e nothing multiplies w; printed is (I - K C) w."),
)

figure = partial(PaperFigure, PAPER)
FIGURES = (
    figure("Appendix: what is left of an error between samples", MAPS,
        make_curves("error", "size of the error / its size before the sample", x_label="time / ms"),
        "A sample at 0 ms, the next after 33 ms. Ideal: a fast camera (case 1); none: no "
        "correction in between (case 2); pseudo-residuals: case 3. Without noise."),
)
