"""The same vehicle as linear systems (A, B, C): what filters and controllers are designed from."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from ..backend.decorators import jit
from .vehicle import GRAVITY, Vehicle

if TYPE_CHECKING:
    from control import StateSpace

Array = npt.NDArray[np.float64]


@jit
def bicycle_coefficients(
    m: Any,
    I: Any,  # noqa: E741  the papers' letter
    l_f: Any,
    l_r: Any,
    C_f: Any,
    C_r: Any,
    V: Any,
) -> Any:
    """(a11, a12, a21, a22, b11, b21, b22) of tie-vision (8) at the speed V in m/s."""
    a11 = -2.0 * (C_f + C_r) / (m * V)
    a12 = -1.0 - 2.0 * (C_f * l_f - C_r * l_r) / (m * V * V)
    a21 = -2.0 * (C_f * l_f - C_r * l_r) / I
    a22 = -2.0 * (C_f * l_f * l_f + C_r * l_r * l_r) / (I * V)
    return a11, a12, a21, a22, 2.0 * C_f / (m * V), 2.0 * C_f * l_f / I, 1.0 / I


@dataclass(frozen=True)
class LinearModel:
    """dx/dt = A x + B u, y = C x, with names.

    Shapes: A (n, n), B (n, m), C (p, n).
    """

    A: Array
    B: Array
    C: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def discrete(self, dt: float) -> tuple[Array, Array]:
        """(G, H) of tie-vision (9) by exact zero-order hold over dt seconds."""
        n, m = self.B.shape
        block = np.zeros((n + m, n + m))
        block[:n, :n], block[:n, n:] = self.A * dt, self.B * dt
        exact = expm(block)
        return exact[:n, :n], exact[:n, n:]

    def to_control(self) -> "StateSpace":
        """A `control.StateSpace` with names (needs the extra `design`)."""
        import control

        return control.StateSpace(
            self.A,
            self.B,
            self.C,
            np.zeros((len(self.outputs), len(self.inputs))),
            states=list(self.states),
            inputs=list(self.inputs),
            outputs=list(self.outputs),
        )


def _lateral(vehicle: Vehicle, speed: float) -> tuple[Array, Array]:
    """A and B (columns delta_f, N_z) of beta and gamma."""
    if not speed > 0.0:
        raise ValueError(f"a linear model needs a positive speed, got {speed!r} m/s")
    a11, a12, a21, a22, b11, b21, b22 = bicycle_coefficients(
        vehicle.mass,
        vehicle.yaw_inertia,
        vehicle.front_arm,
        vehicle.rear_arm,
        vehicle.front_stiffness,
        vehicle.rear_stiffness,
        float(speed),
    )
    return np.array([[a11, a12], [a21, a22]]), np.array([[b11, 0.0], [b21, b22]])


def bicycle(vehicle: Vehicle, speed: float) -> LinearModel:
    """beta and gamma, from steering and yaw moment: tie-vision (1)-(2). Output: gamma."""
    A, B = _lateral(vehicle, speed)
    return LinearModel(
        A, B, np.array([[0.0, 1.0]]), ("beta", "gamma"), ("delta_f", "N_z"), ("gamma",)
    )


def vision(vehicle: Vehicle, speed: float) -> LinearModel:
    """tie-vision (8): beta, gamma, psi (relative to the road) and y_l, from delta_f, N_z, kappa.

    The road's curvature kappa is the third input: psi' = gamma - V kappa, and
    y_l = y_cg + l_pre psi - kappa l_pre^2 / 2 moves as y_l' = V beta + l_pre psi' + V psi.
    """
    lateral, steer = _lateral(vehicle, speed)
    V, l_pre = float(speed), vehicle.preview
    A = np.zeros((4, 4))
    A[:2, :2] = lateral
    A[2, 1] = 1.0  # tie-vision (7)
    A[3, :3] = V, l_pre, V  # tie-vision (6)
    B = np.zeros((4, 3))
    B[:2, :2] = steer
    B[2, 2], B[3, 2] = -V, -V * l_pre
    C = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    states = ("beta", "gamma", "psi", "y_l")
    return LinearModel(A, B, C, states, ("delta_f", "N_z", "kappa"), ("gamma", "psi", "y_l"))


def course(vehicle: Vehicle, speed: float) -> LinearModel:
    """beta, gamma, psi with the course angle psi + beta as output: dakf-stability (1)-(3)."""
    lateral, steer = _lateral(vehicle, speed)
    A = np.zeros((3, 3))
    A[:2, :2] = lateral
    A[2, 1] = 1.0
    B = np.vstack([steer, np.zeros(2)])
    C = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    return LinearModel(A, B, C, ("beta", "gamma", "psi"), ("delta_f", "N_z"), ("gamma", "course"))


def roll(vehicle: Vehicle) -> LinearModel:
    """phi and phi_dot from the measured specific force a_y: double-layer-gps (3). Output: phi_dot.

    The body's weight, M_s g h_s phi, is within a_y.
    """
    I_x = vehicle.roll_inertia
    A = np.array([[0.0, 1.0], [-vehicle.roll_stiffness / I_x, -vehicle.roll_damping / I_x]])
    B = np.array([[0.0], [vehicle.roll_moment_arm / I_x]])
    return LinearModel(A, B, np.array([[0.0, 1.0]]), ("phi", "phi_dot"), ("a_y",), ("phi_dot",))


def kinematic(gamma: float) -> LinearModel:
    """v_x and v_y from both specific forces at a yaw rate in rad/s: double-layer-gps (4)-(5).

    Without roll or bank. Output: v_x, as the wheels tell it; at zero yaw rate v_y is unobservable.
    """
    A = np.array([[0.0, gamma], [-gamma, 0.0]])
    return LinearModel(
        A, np.eye(2), np.array([[1.0, 0.0]]), ("v_x", "v_y"), ("a_x", "a_y"), ("v_x",)
    )


def velocity_and_roll(vehicle: Vehicle, gamma: float) -> LinearModel:
    """v_x, v_y, phi and phi_dot from both specific forces: double-layer-gps (42), continuous.

    Outputs: v_x and v_y, which the GPS and the first layer tell, and phi_dot.
    """
    body, plane = roll(vehicle), kinematic(gamma)
    A, B, C = np.zeros((4, 4)), np.zeros((4, 2)), np.zeros((3, 4))
    A[:2, :2], A[2:, 2:] = plane.A, body.A
    A[1, 2] = -GRAVITY  # double-layer-gps (5)
    B[:2], B[2:, 1:] = plane.B, body.B
    C[0, 0] = C[1, 1] = C[2, 3] = 1.0
    return LinearModel(
        A,
        B,
        C,
        (*plane.states, *body.states),
        plane.inputs,
        ("v_x", "v_y", "phi_dot"),
    )
