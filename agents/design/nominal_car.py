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
    """A and B of tie-vision (8): beta and gamma, from the steering angle and the yaw moment.

    Attributes:
        a11: Effect of beta on beta' (1/s).
        a12: Effect of gamma on beta'.
        a21: Effect of beta on gamma' (1/s^2).
        a22: Effect of gamma on gamma' (1/s).
        b11: Effect of the steering angle on beta' (1/s).
        b21: Effect of the steering angle on gamma' (1/s^2).
        b22: Effect of the yaw moment on gamma' (1/(kg m^2)).
    """

    a11: Any
    a12: Any
    a21: Any
    a22: Any
    b11: Any
    b21: Any
    b22: Any


def make_nominal_car(vehicle: Vehicle) -> Array:
    """Make the array of the numbers at `CAR`, shape (6,).

    Args:
        vehicle: Nominal vehicle.

    Returns:
        Numbers in SI units.
    """
    return np.array(vehicle.lateral)


@jit
def compute_plant(car: Any, V: Any) -> Any:
    """Compute the bicycle plant at a speed.

    Args:
        car: Numbers at `CAR`, shape (6,).
        V: Speed (m/s).

    Returns:
        `BicyclePlant` of the car.
    """
    a11, a12, a21, a22, b11, b21, b22 = compute_bicycle_coefficients(
        car[CAR.m], car[CAR.I], car[CAR.l_f], car[CAR.l_r], car[CAR.C_f], car[CAR.C_r], V
    )
    return BicyclePlant(a11, a12, a21, a22, b11, b21, b22)


compute_plant_python = as_python(compute_plant)
"""`compute_plant` for designs, in Python."""


@jit
def compute_drift(plant: Any, beta: Any, gamma: Any) -> Any:
    """Compute A [beta, gamma], the rates without inputs (rad/s, rad/s^2).

    Args:
        plant: `BicyclePlant` at the speed.
        beta: Sideslip angle (rad).
        gamma: Yaw rate (rad/s).

    Returns:
        Rates beta' (rad/s) and gamma' (rad/s^2).
    """
    return plant.a11 * beta + plant.a12 * gamma, plant.a21 * beta + plant.a22 * gamma


@jit
def compute_steady_yaw_rate(plant: Any, beta: Any, delta: Any) -> Any:
    """Compute the yaw rate (rad/s) that keeps a sideslip angle constant.

    Args:
        plant: `BicyclePlant` at the speed.
        beta: Sideslip angle (rad).
        delta: Steering angle (rad).

    Returns:
        Yaw rate (rad/s).
    """
    return -(plant.a11 * beta + plant.b11 * delta) / plant.a12


@jit
def solve_inputs(plant: Any, first: Any, second: Any) -> Any:
    """Solve B u = [first, second] for steering angle (rad) and yaw moment (N m).

    Source: dakf-stability (26).

    Args:
        plant: `BicyclePlant` at the speed.
        first: Effect on beta' (rad/s).
        second: Effect on gamma' (rad/s^2).

    Returns:
        Steering angle (rad) and yaw moment (N m).
    """
    delta_f = first / plant.b11
    return delta_f, (second - plant.b21 * delta_f) / plant.b22
