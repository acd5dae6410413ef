"""The nominal car in compiled laws: its numbers by name, and its bicycle model at a speed."""

from typing import Any, NamedTuple

import numpy as np

from ...envs.backend.arrays import make_offsets
from ...envs.backend.decorators import as_python, jit
from ...envs.record import Array
from ...envs.vehicle.linear import Bicycle, compute_bicycle_coefficients
from ...envs.vehicle.vehicle import Vehicle

CAR, _ = make_offsets(Bicycle)
"""A vehicle as laws read it, an array at these indices: SI units, stiffness per tyre."""


class BicyclePlant(NamedTuple):
    """A and B of tie-vision (8): beta and gamma, from the steering angle and the yaw moment."""

    a11: Any
    a12: Any
    a21: Any
    a22: Any
    b11: Any
    b21: Any
    b22: Any


def make_nominal_car(vehicle: Vehicle) -> Array:
    """The numbers at `CAR`, (6,)."""
    return np.array(vehicle.lateral)


@jit
def compute_plant(car: Any, V: Any) -> Any:
    """The plant at a speed in m/s."""
    a11, a12, a21, a22, b11, b21, b22 = compute_bicycle_coefficients(
        car[CAR.m], car[CAR.I], car[CAR.l_f], car[CAR.l_r], car[CAR.C_f], car[CAR.C_r], V
    )
    return BicyclePlant(a11, a12, a21, a22, b11, b21, b22)


compute_plant_python = as_python(compute_plant)
"""`compute_plant` for designs, in Python."""


@jit
def compute_drift(plant: Any, beta: Any, gamma: Any) -> Any:
    """A [beta, gamma]."""
    return plant.a11 * beta + plant.a12 * gamma, plant.a21 * beta + plant.a22 * gamma


@jit
def compute_steady_yaw_rate(plant: Any, beta: Any, delta: Any) -> Any:
    """The yaw rate at which a sideslip angle stays as it is under a steering angle."""
    return -(plant.a11 * beta + plant.b11 * delta) / plant.a12


@jit
def solve_inputs(plant: Any, first: Any, second: Any) -> Any:
    """B^-1 [first, second]: steering angle and yaw moment of this effect, dakf-stability (26)."""
    delta_f = first / plant.b11
    return delta_f, (second - plant.b21 * delta_f) / plant.b22
