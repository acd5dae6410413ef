"""The model of the car in nonlinear predictive control, and the start of a prediction."""

import math
from typing import Any, NamedTuple

import numpy as np

from ...envs.backend.decorators import jit
from ...envs.engine.packing import make_car
from ...envs.engine.tick import StepVariant
from ...envs.record import Array
from ...envs.task.cost import BETA_SCALE, EFFORT_WEIGHT, GAMMA_SCALE, STEER_SCALE
from ...envs.task.reference import ZERO_SLIP
from ...envs.ticks import TICK
from ...envs.vehicle.actuators import Lag, make_lag
from ...envs.vehicle.dynamics import CarParams, RoadParams
from ...envs.vehicle.vehicle import Vehicle


class PredictionModel(NamedTuple):
    """The numbers that all predictions share."""

    car: CarParams  # the nominal one
    road: RoadParams  # straight and flat
    kind: StepVariant
    motor: Lag  # of a step
    steering: Lag
    motor_work: tuple[float, float]  # mean and spread over a step of what is left of a deviation
    steering_work: tuple[float, float]
    step: float  # s
    full_scale: float  # N m
    authority: float  # rad
    slew: float  # rad a step
    stop: float  # rad
    yaw_first: float
    decay: float  # what a step leaves of the disturbances
    ref_rest: float  # and of a lagged reference's deviation
    per_beta: float  # square roots of the cost's weights
    per_gamma: float
    per_share: float
    per_steer: float


class PredictionStart(NamedTuple):
    """The state and the held quantities at the start of a prediction.

    Attributes:
        car: `CarParams` of the car.
        motion: Motion of the car.
        T_l: Torque of the left motor (N m).
        T_r: Torque of the right motor (N m).
        delta_f: Applied steering angle (rad).
        slewing: Added steering that was last commanded (rad).
        driver: Driver's steering angle, held (rad).
        a_x: Acceleration, held (m/s^2).
        refs: beta_ref (rad) and gamma_ref (rad/s) now.
        steady: Values that a lagged reference approaches.
        push: Disturbance forces.
        max_moment: Largest yaw moment as a fraction of full scale.
    """

    car: Any
    motion: Any
    T_l: Any
    T_r: Any
    delta_f: Any
    slewing: Any  # rad, the added steering that was asked for last
    driver: Any  # rad, held
    a_x: Any  # m/s2, held
    refs: Any  # (beta, gamma) now
    steady: Any  # and where a lagged reference goes
    push: Any
    max_moment: Any  # share of full scale that the yaw moment may take


def compute_lag_moments(time_constant: float, ticks: int) -> tuple[float, float]:
    """Compute mean and standard deviation, over a step's ticks, of a deviation's rest.

    Args:
        time_constant: Time constant of the lag (s).
        ticks: Ticks of the step.

    Returns:
        Mean and standard deviation, as fractions of the deviation.
    """
    tick = make_lag(time_constant, TICK)
    left = tick.mean * tick.end ** np.arange(ticks)
    return float(left.mean()), float(left.std())


def make_prediction_model(
    vehicle: Vehicle,
    kind: StepVariant,
    ticks: int,
    lags: bool,
    disturbance_time: float,
    ref_rest: float,
    steer_weight: float,
    full_scale: float,
    authority: float,
    yaw_first: bool,
) -> PredictionModel:
    """Make the model of a car in steps of some ticks, with the cost of `sampled_model`.

    Args:
        vehicle: Vehicle of the predictions.
        kind: Variant of the plant.
        ticks: Ticks of a step.
        lags: Whether the actuators lag.
        disturbance_time: Time in which disturbances decay (s).
        ref_rest: Fraction of a lagged reference's deviation that a tick leaves.
        steer_weight: Factor on the cost of added steering.
        full_scale: Yaw moment at an action of 1 (N m).
        authority: Added steering at an action of 1 (rad).
        yaw_first: Whether the yaw moment comes before the drive torque.

    Returns:
        Numbers that all predictions share.
    """
    step = ticks * TICK
    motor, steering = (vehicle.motor_lag, vehicle.steering_lag) if lags else (0.0, 0.0)
    return PredictionModel(
        make_car(vehicle),
        RoadParams(0.0, 0.0, 1.0),
        kind,
        make_lag(motor, step),
        make_lag(steering, step),
        compute_lag_moments(motor, ticks),
        compute_lag_moments(steering, ticks),
        step,
        full_scale,
        authority,
        vehicle.steering_rate * step,
        vehicle.steering_stop,
        float(yaw_first),
        math.exp(-step / disturbance_time),
        ref_rest**ticks,
        1.0 / BETA_SCALE,
        0.0 if kind.reference == ZERO_SLIP else 1.0 / GAMMA_SCALE,
        math.sqrt(EFFORT_WEIGHT),
        math.sqrt(steer_weight * EFFORT_WEIGHT) / STEER_SCALE,
    )


def make_blocks(steps: int, count: int) -> Array:
    """Make lengths of at most `count` blocks that grow towards the end of a horizon.

    Args:
        steps: Steps of the horizon.
        count: Maximum of blocks.

    Returns:
        Steps of each block, shape (blocks,).
    """
    ends = np.unique(np.rint(np.geomspace(1.0, steps, count)).astype(np.int64))
    return np.diff(ends, prepend=0)


@jit
def replace_tyres(car: Any, C_f: Any, C_r: Any, mu: Any) -> Any:
    """Replace stiffnesses and friction of a car.

    Args:
        car: `CarParams` of the car.
        C_f: Front cornering stiffness of a tyre (N/rad).
        C_r: Rear cornering stiffness of a tyre (N/rad).
        mu: Friction of the road, at both axles.

    Returns:
        `CarParams` with the new numbers.
    """
    tyres, road, other = (C_f, C_r), (mu,), (mu,)
    return CarParams(*(car[:4] + tyres + car[6:10] + road + car[11:19] + other + car[20:]))
