"""Ranks of observability matrices by exact arithmetic: no tolerance decides."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from ....envs.vehicle.vehicle import COMS, Vehicle
from ..ledger.claim import Measured

Matrix = list[list[Fraction]]
SPEED = Fraction(125, 18)  # m/s, 25 km/h
COURSE = [[1, 0, 1]]  # psi + beta
GYRO_AND_COURSE = [[0, 1, 0], *COURSE]


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


def observable(A: Matrix, C: Sequence[Sequence[Fraction | int]]) -> int:
    """The rank of [C; C A; ...; C A^(n-1)]: dakf-stability IV.D.

    For the continuous A; exact sampling cannot raise it, since e^(A T) keeps every A-invariant
    subspace, nor lower it but for special sampling times.
    """
    block: Matrix = [[Fraction(entry) for entry in row] for row in C]
    every = list(block)
    for _ in range(len(A) - 1):
        block = [
            [sum((a * A[k][j] for k, a in enumerate(row)), Fraction(0)) for j in range(len(A))]
            for row in block
        ]
        every += block
    return rank(every)


def bicycle(car: Vehicle, V: Fraction, states: int) -> Matrix:
    """A of tie-vision (8) with its first states: beta, gamma, psi and y_l."""
    m, I, l_f, l_r, C_f, C_r, l_pre = (  # noqa: E741
        Fraction(str(value))
        for value in (
            car.mass,
            car.yaw_inertia,
            car.front_arm,
            car.rear_arm,
            car.front_stiffness,
            car.rear_stiffness,
            car.preview,
        )
    )
    zero = Fraction(0)
    moment = C_f * l_f - C_r * l_r
    A = [
        [-2 * (C_f + C_r) / (m * V), -1 - 2 * moment / (m * V * V), zero, zero],
        [-2 * moment / I, -2 * (C_f * l_f**2 + C_r * l_r**2) / (I * V), zero, zero],
        [zero, Fraction(1), zero, zero],
        [V, l_pre, V, zero],
    ]
    return [row[:states] for row in A[:states]]


def with_disturbances(A: Matrix, rows: int) -> Matrix:
    """A with a constant disturbance behind each of its first rows: dakf-stability (15)-(17)."""
    n = len(A)
    ends = [[Fraction(int(i == j)) for j in range(rows)] for i in range(n)]
    return [a + e for a, e in zip(A, ends, strict=True)] + [
        [Fraction(0)] * (n + rows) for _ in range(rows)
    ]


def widened(C: Sequence[Sequence[int]], n: int) -> list[list[int]]:
    """C that does not see the disturbances behind its states."""
    return [[*row, *[0] * (n - len(row))] for row in C]


def coms_ranks(_: tuple[int, ...]) -> Measured:
    """Rank of each paper's observability matrix for the COMS at 25 km/h."""
    course, vision = bicycle(COMS, SPEED, 3), bicycle(COMS, SPEED, 4)
    models = {
        "dakf": (with_disturbances(course, 2), GYRO_AND_COURSE),
        "dual-rate": (with_disturbances(course, 3), COURSE),
        "vision": (vision, [[0, 0, 1, 0], [0, 0, 0, 1]]),
    }
    return Measured(
        {
            (name, "rank"): np.array([float(observable(A, widened(C, len(A))))])
            for name, (A, C) in models.items()
        }
    )
