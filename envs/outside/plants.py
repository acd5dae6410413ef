"""Outside plants: CommonRoad's vehicle models as another truth than ours.

M. Althoff and G. Wuersching, "CommonRoad: Vehicle Models", 2020: a single-track model, one that
drifts and a multi-body model, all of a BMW 320i (extra `outside`, loaded when a plant is made).

What the models lack is added here: the yaw moment as motor torques on the rear wheels of the
multi-body model, and as N_z / I_z on the yaw acceleration of the others. Steering angles are
prescribed, not sent through the models' rate limit. The multi-body model's labels are mirrored
(the wheel called left rear is on the right) and its roll has the other sign than ours.
"""

import dataclasses
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from ..engine.config import make_car
from ..numerics import require_extra
from ..record import Array
from ..vehicle.actuators import compute_yaw_moment
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import GRAVITY, Vehicle

_BMW_320I = 2  # CommonRoad's number of the car
_MOTOR_TORQUE = 300.0  # N m of one in-wheel motor, which CommonRoad's car does not have: ours
_MIN_SPEED = 0.1  # m/s: below it the models switch to kinematics
_STABILITY_LIMIT = 1.5  # of the fastest eigenvalue times the step; Runge-Kutta's limit is 2.78


class OutsideInputs(NamedTuple):
    """Inputs of the plant, constant during a step."""

    steer: float  # rad, front wheels
    T_l: float = 0.0  # N m, left rear motor
    T_r: float = 0.0  # N m, right rear motor
    F_y: float = 0.0  # N, lateral force at the centre of gravity
    N_z: float = 0.0  # N m, yaw moment besides the motors'
    N_x: float = 0.0  # N m, roll moment on the body


@functools.cache
def _import_model(name: str) -> Any:
    with require_extra("outside", "an outside plant needs commonroad-vehicle-models"):
        return import_module(f"vehiclemodels.{name}")


@functools.cache
def _load_parameters() -> Any:
    """Load the BMW's parameters, with all drive and brake torque on the rear wheels."""
    p = _import_model("vehicle_parameters").setup_vehicle_parameters(_BMW_320I)
    return dataclasses.replace(p, T_sb=0.0, T_se=0.0)


@functools.cache
def make_outside_vehicle() -> Vehicle:
    """Make the BMW 320i as our `Vehicle`: the nominal vehicle of estimators and controllers.

    Cornering stiffness is the Magic Formula's slope p_Ky1 F_z at the tyre's standing load. Roll
    stiffness is that of springs and anti-roll bars on top of the tyres' vertical springs.
    """
    p = _load_parameters()
    per_arm = 0.5 * p.m * GRAVITY / (p.a + p.b)  # standing load of a tyre over the other axle's arm
    arm = p.h_s - 0.5 * (p.h_raf + p.h_rar)
    body = 0.5 * (p.T_f**2 * p.K_sf + p.T_r**2 * p.K_sr) - p.K_tsf - p.K_tsr  # N m/rad
    tyres = 0.5 * (p.T_f**2 + p.T_r**2) * p.K_zt
    return Vehicle(
        name="bmw-320i", mass=p.m, yaw_inertia=p.I_z, front_arm=p.a, rear_arm=p.b,
        front_stiffness=-p.tire.p_ky1 * per_arm * p.b, rear_stiffness=-p.tire.p_ky1 * per_arm * p.a,
        front_track=p.T_f, rear_track=p.T_r, wheel_radius=p.R_w, gravity_height=p.h_cg,
        motor_torque=_MOTOR_TORQUE, preview=12.0, width=p.w, friction=p.tire.p_dy1,
        sprung_mass=p.m_s, roll_arm=arm, roll_inertia=p.I_Phi_s + p.m_s * arm**2,
        roll_stiffness=1.0 / (1.0 / body + 1.0 / tyres),
        roll_damping=0.5 * (p.T_f**2 * p.K_sdf + p.T_r**2 * p.K_sdr),
    )  # fmt: skip


class OutsidePlant(ABC):
    """One of the models with its state.

    `x` is the state and `specific_force` (a_x, a_y) in m/s2 at the newest step's end, as
    accelerometers at the centre of gravity feel it. A state that is no longer finite stays so
    (`is_finite`).

    Args:
        friction: Peak lateral friction of the tyre; None for CommonRoad's 1.05. The longitudinal
            one keeps its ratio to it. The single track's linear tyres ignore it.
        stiffness: Factor on the cornering stiffness of all tyres.
    """

    law = ""  # the name of the model's module and function
    wheels = slice(0)  # wheel speeds in x, which may not be negative
    wheel_load = 0.0  # the most of the car's weight that rests on one wheel speed
    velocity_columns: tuple[int, ...] = (3, 5)  # in x, with the yaw rate

    def __init__(self, friction: float | None = None, stiffness: float = 1.0) -> None:
        base = _load_parameters()
        tyre, scale = base.tire, 1.0 if friction is None else friction / base.tire.p_dy1
        tyre = dataclasses.replace(
            tyre, p_dy1=scale * tyre.p_dy1, p_dx1=scale * tyre.p_dx1, p_ky1=stiffness * tyre.p_ky1
        )
        self.p = dataclasses.replace(base, tire=tyre)
        self.car = make_car(make_outside_vehicle())
        self._law: Callable[..., list[float]] = getattr(_import_model(self.law), self.law)
        slope = self.wheel_load * self.p.m * GRAVITY * tyre.p_kx1  # N, of force over slip
        self._slip_rate = self.p.R_w**2 * slope / self.p.I_y_w  # 1/s of the slip at 1 m/s
        self.specific_force = (0.0, 0.0)
        self.x = np.zeros(0)

    def start(self, motion: Motion) -> None:
        """Set the car to a Motion's velocities, heading and place, wheels rolling.

        Args:
            motion: Motion of the car.
        """
        speed, slip = math.hypot(motion.v_x, motion.v_y), math.atan2(motion.v_y, motion.v_x)
        core = [motion.X, motion.Y, 0.0, speed, motion.psi, motion.gamma, slip]
        self.x = self._make_state(core, motion)

    @abstractmethod
    def _make_state(self, core: list[float], motion: Motion) -> Array:
        """Make x of a Motion from X, Y, steering, speed, heading, yaw rate and slip angle."""

    @abstractmethod
    def _compute_derivative(self, x: Array, inputs: OutsideInputs) -> Array:
        """Compute dx/dt of a state, which is left unchanged (the models themselves change it)."""

    @property
    @abstractmethod
    def motion(self) -> Motion:
        """Velocities and place of the car, on a straight road along the ground's x axis."""

    @abstractmethod
    def _compute_specific_force(self, inputs: OutsideInputs) -> tuple[float, float]:
        """Compute (a_x, a_y) (m/s2) of the state x; the models' own errors pass."""

    @property
    def is_finite(self) -> bool:
        """Whether the state and the squares of its velocities, which sensors take, are finite."""
        squares = sum(v * v for v in (float(self.x[i]) for i in self.velocity_columns))
        return bool(np.isfinite(self.x).all()) and math.isfinite(squares)

    def step(self, inputs: OutsideInputs, h: float) -> None:
        """Step by the classical Runge-Kutta method, in as many parts as the wheels need.

        Args:
            inputs: Inputs, constant during the step.
            h: Length of the step (s).
        """
        eigenvalue = self._slip_rate / max(abs(float(self.x[3])), _MIN_SPEED)
        parts = max(1, math.ceil(h * eigenvalue / _STABILITY_LIMIT)) if self.is_finite else 1
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(parts):
                    self.x = self._rk4(self.x, inputs, h / parts)
                    self.x[self.wheels] = np.maximum(self.x[self.wheels], 0.0)
                self.specific_force = self._compute_specific_force(inputs)
        except (ArithmeticError, ValueError):  # a wheel at rest in a spin, the sine of infinity
            self.specific_force = (math.nan, math.nan)
        if not all(map(math.isfinite, self.specific_force)):
            self.x = np.full_like(self.x, np.nan)

    def _rk4(self, x: Array, inputs: OutsideInputs, h: float) -> Array:
        a = self._compute_derivative(x, inputs)
        b = self._compute_derivative(x + 0.5 * h * a, inputs)
        c = self._compute_derivative(x + 0.5 * h * b, inputs)
        d = self._compute_derivative(x + h * c, inputs)
        return x + h / 6.0 * (a + 2.0 * (b + c) + d)


class SingleTrack(OutsidePlant):
    """Linear tyres; states X, Y, steering angle, speed, heading, yaw rate, slip angle."""

    law = "vehicle_dynamics_st"

    def _make_state(self, core: list[float], motion: Motion) -> Array:
        return np.array(core)

    def _compute_derivative(self, x: Array, inputs: OutsideInputs) -> Array:
        """Compute dx/dt; the motors push along the path and turn the car by N_z / I_z."""
        state = x.tolist()
        state[2] = inputs.steer
        drive = (inputs.T_l + inputs.T_r) / (self.p.m * self.p.R_w)
        rate = np.array(self._law(state, [0.0, drive], self.p))
        lateral_acceleration, slip = inputs.F_y / self.p.m, state[6]
        rate[3] += lateral_acceleration * math.sin(slip)
        rate[5] += (compute_yaw_moment(inputs.T_l, inputs.T_r, self.car) + inputs.N_z) / self.p.I_z
        rate[6] += lateral_acceleration * math.cos(slip) / max(state[3], _MIN_SPEED)
        return rate

    @property
    def motion(self) -> Motion:  # noqa: D102
        X, Y, _, v, psi, gamma, slip = self.x[:7].tolist()
        return Motion(v * math.cos(slip), v * math.sin(slip), gamma, psi, X, Y, X, Y, 0.0)

    def _compute_specific_force(self, inputs: OutsideInputs) -> tuple[float, float]:
        """Compute the specific force of the state x from the path's tangent and normal."""
        rate, slip = self._compute_derivative(self.x, inputs), self.x[6]
        tangential, normal = float(rate[3]), float(self.x[3] * (rate[6] + self.x[5]))
        sine, cosine = math.sin(slip), math.cos(slip)
        return tangential * cosine - normal * sine, tangential * sine + normal * cosine


class Drift(SingleTrack):
    """The single track with the Magic Formula and the speeds of the front and rear wheels."""

    law = "vehicle_dynamics_std"
    wheels = slice(7, 9)
    wheel_load = 1.0

    def _make_state(self, core: list[float], motion: Motion) -> Array:
        return np.append(core, np.full(2, motion.v_x / self.p.R_w))


class MultiBody(OutsidePlant):
    """29 states: the body, both axles, four wheels; v_y is that of the sprung mass."""

    law = "vehicle_dynamics_mb"
    wheels = slice(23, 27)
    wheel_load = 0.5
    velocity_columns = (3, 5, 10)

    def _make_state(self, core: list[float], motion: Motion) -> Array:
        x: Array = np.array(_import_model("init_mb").init_mb(core, self.p), float)
        x[6], x[7] = -motion.phi, -motion.phi_dot
        return x

    def _compute_derivative(self, x: Array, inputs: OutsideInputs) -> Array:
        """Compute dx/dt; motor torques act on the rear wheels."""
        state = x.tolist()
        state[2] = inputs.steer
        rate = np.array(self._law(state, [0.0, 0.0], self.p))
        rate[5] += inputs.N_z / self.p.I_z
        rate[7] -= inputs.N_x / self.p.I_Phi_s
        rate[10] += inputs.F_y / self.p.m_s
        rate[25] += inputs.T_r / self.p.I_y_w  # called left rear
        rate[26] += inputs.T_l / self.p.I_y_w
        return rate

    @property
    def motion(self) -> Motion:  # noqa: D102
        x = self.x.tolist()
        return Motion(x[3], x[10], x[5], x[4], x[0], x[1], x[0], x[1], 0.0, -x[6], -x[7])

    def _compute_specific_force(self, inputs: OutsideInputs) -> tuple[float, float]:
        """Compute the specific force that the rolled body of the state x feels."""
        rate, x = self._compute_derivative(self.x, inputs), self.x
        a_y = rate[10] + x[5] * x[3] - GRAVITY * math.sin(x[6])
        return float(rate[3] - x[5] * x[10]), float(a_y)


OUTSIDE_PLANTS: dict[str, type[OutsidePlant]] = {
    "single-track": SingleTrack, "drift": Drift, "multi-body": MultiBody
}  # fmt: skip
