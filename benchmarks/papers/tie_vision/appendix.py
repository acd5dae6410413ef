"""tie-vision's appendix, checked term by term: its recursions against simulated errors.

Random time-varying systems with noise are filtered with random gains; e is the true error. Each
formula is written out as printed and as docs/PAPERS.md corrects it, and its residual is the largest
difference from the simulated error over that error's size. The one-step lines of cases 1 and 2 are
no equations between vectors as printed (K times w, H u times w) and cannot be checked.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np

from ....envs.record import Array
from ..ledger.claim import SimulationResult
from ..ledger.simulations import Numbers, collect_numbers

STEPS = 6
STATES, OUTPUTS = 4, 3


@dataclass
class RandomSystem:
    """Steps 0 .. n of a random system: G, w of the step to i+1; K, v of step i (0 unused)."""

    G: list[Array]
    C: Array
    K: list[Array]
    w: list[Array]
    v: list[Array]
    e: Array  # at step 0


def draw_system(seed: int) -> RandomSystem:
    """One system, with gains that make the error neither vanish nor explode."""
    rng = np.random.default_rng(seed)

    def draw_arrays(*shape: int) -> list[Array]:
        return [rng.normal(size=shape) for _ in range(STEPS + 1)]

    G = [np.eye(STATES) + 0.2 * g for g in draw_arrays(STATES, STATES)]
    K = [0.2 * k for k in draw_arrays(STATES, OUTPUTS)]
    C = rng.normal(size=(OUTPUTS, STATES))
    return RandomSystem(G, C, K, draw_arrays(STATES), draw_arrays(OUTPUTS), rng.normal(size=STATES))


def compute_product(factors: list[Array]) -> Array:
    """The product with the newest factor on the left, as the appendix has it."""
    return reduce(lambda total, factor: factor @ total, factors, np.eye(STATES))


def compute_residual(formula: Array, simulated: Array) -> float:
    """The largest difference over the largest entry."""
    return float(np.abs(formula - simulated).max() / np.abs(simulated).max())


def check_ideal(d: RandomSystem) -> dict[str, float]:
    """Case 1: a measurement at every step."""
    n, e = STEPS, d.e
    for i in range(1, n + 1):
        predicted = d.G[i - 1] @ e + d.w[i - 1]
        e = predicted - d.K[i] @ (d.C @ predicted + d.v[i])  # (17)-(18)
    M = [np.eye(STATES) - K @ d.C for K in d.K]
    closed = compute_product([M[i] @ d.G[i - 1] for i in range(1, n + 1)]) @ d.e
    for p in range(n):
        after = compute_product([M[i + 1] @ d.G[i] for i in range(p + 1, n)])
        closed = closed + after @ M[p + 1] @ d.w[p]
    for p in range(1, n + 1):
        after = compute_product([M[i] @ d.G[i - 1] for i in range(p + 1, n + 1)])
        closed = closed - after @ d.K[p] @ d.v[p]
    return {"case 1": compute_residual(closed, e)}


def check_predicted(d: RandomSystem) -> dict[str, float]:
    """Case 2: no correction between samples."""
    e = d.e
    for i in range(STEPS):
        e = d.G[i] @ e + d.w[i]
    closed = compute_product(d.G[:STEPS]) @ d.e
    for p in range(STEPS):
        closed = closed + compute_product(d.G[p + 1 : STEPS]) @ d.w[p]
    return {"case 2": compute_residual(closed, e)}


def check_compensated(d: RandomSystem) -> dict[str, float]:
    """Case 3: any pseudo-residual; then the exact one, C G e."""
    n, e = STEPS, d.e
    for i in range(1, n + 1):  # v stands for any pseudo-residual: the first form is an identity
        e = d.G[i - 1] @ e + d.w[i - 1] - d.K[i] @ d.v[i]
    sums = {}
    for label, held in (("case 3 (a)", False), ("case 3 (a), printed", True)):
        G = [d.G[1] if held else g for g in d.G]
        closed = compute_product(d.G[:n]) @ d.e
        for p in range(n):
            closed = closed + compute_product(G[p + 1 : n]) @ d.w[p]
        for p in range(1, n + 1):
            closed = closed - compute_product(G[p:n]) @ d.K[p] @ d.v[p]
        sums[label] = compute_residual(closed, e)
    M = [np.eye(STATES) - K @ d.C for K in d.K]
    e = d.e
    for i in range(1, n + 1):
        e = M[i] @ d.G[i - 1] @ e + d.w[i - 1]  # with the exact residual C G e
    start = compute_product([M[i] @ d.G[i - 1] for i in range(1, n + 1)]) @ d.e
    for label, factor in (("case 3 (b)", False), ("case 3 (b), printed", True)):
        closed = start
        for p in range(n):
            after = compute_product([M[i + 1] @ d.G[i] for i in range(p + 1, n)])
            closed = closed + after @ (M[p + 1] @ d.w[p] if factor else d.w[p])
        sums[label] = compute_residual(closed, e)
    return sums


def compute_residuals(seeds: tuple[int, ...]) -> SimulationResult:
    """Every formula's residual on each seed's system."""
    lines: list[Numbers] = []
    for drive in map(draw_system, seeds):
        by_case = check_ideal(drive) | check_predicted(drive) | check_compensated(drive)
        lines.append({(label, "residual"): value for label, value in by_case.items()})
    return SimulationResult(collect_numbers(lines))
