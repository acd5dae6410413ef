"""Ranks of observability matrices by exact arithmetic: no tolerance decides."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from ....envs.scenarios.draws import KMH
from ....envs.vehicle import linear
from ....envs.vehicle.vehicle import COMS
from ..ledger.claim import SimulationResult

Matrix = list[list[Fraction]]


def rank(matrix: Sequence[Sequence[Fraction | int]]) -> int:
    """The rank of a matrix of fractions, by elimination.

    >>> rank([[1, 2], [2, 4]]), rank([[Fraction(1, 3), 0], [0, 1]])
    (1, 2)
    """
    rows = [[Fraction(entry) for entry in row] for row in matrix]
    done = 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(done, len(rows)) if rows[i][column] != 0), None)
        if pivot is None:
            continue
        rows[done], rows[pivot] = rows[pivot], rows[done]
        for i in range(done + 1, len(rows)):
            factor = rows[i][column] / rows[done][column]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[done], strict=True)]
        done += 1
    return done


def compute_observability_rank(A: Matrix, C: Sequence[Sequence[Fraction | int]]) -> int:
    """The rank of [C; C A; ...; C A^(n-1)]: dakf-stability IV.D.

    For the continuous A; exact sampling cannot raise it, since e^(A T) keeps every A-invariant
    subspace, nor lower it but for special sampling times.
    """
    block: Matrix = [[Fraction(entry) for entry in row] for row in C]
    stacked = list(block)
    for _ in range(len(A) - 1):
        block = [
            [sum((a * A[k][j] for k, a in enumerate(row)), Fraction(0)) for j in range(len(A))]
            for row in block
        ]
        stacked += block
    return rank(stacked)


def add_disturbances(A: Matrix, rows: int) -> Matrix:
    """A with a constant disturbance behind each of its first rows: dakf-stability (15)-(17)."""
    n = len(A)
    ends = [[Fraction(int(i == j)) for j in range(rows)] for i in range(n)]
    return [a + e for a, e in zip(A, ends, strict=True)] + [
        [Fraction(0)] * (n + rows) for _ in range(rows)
    ]


def compute_coms_ranks(_: tuple[int, ...]) -> SimulationResult:
    """Rank of each paper's observability matrix for the COMS at 25 km/h, taken as it is rounded."""
    vision = [
        [Fraction(entry) for entry in row] for row in linear.make_vision_model(COMS, 25.0 * KMH).A
    ]
    course = [row[:3] for row in vision[:3]]
    models: dict[str, tuple[Matrix, list[list[int]]]] = {
        "dakf": (add_disturbances(course, 2), [[0, 1, 0], [1, 0, 1]]),  # gyro and course
        "dual-rate": (add_disturbances(course, 3), [[1, 0, 1]]),
        "vision": (vision, [[0, 0, 1, 0], [0, 0, 0, 1]]),
    }
    ranks = {
        name: compute_observability_rank(A, [row + [0] * (len(A) - len(row)) for row in C])
        for name, (A, C) in models.items()
    }
    return SimulationResult(
        {(name, "rank"): np.array([float(value)]) for name, value in ranks.items()}
    )
