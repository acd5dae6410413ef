"""Linear models (A, B, C) of the vehicle, for the design of filters and controllers.

The compiled functions write the matrices, here and in the filters.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from ..numerics.jit import as_python, jit
from ..numerics.primitives import Matrix, Scalar, Vector
from .parameters import Vehicle

if TYPE_CHECKING:
    from control import StateSpace

Array = npt.NDArray[np.float64]


class Bicycle(NamedTuple):
    """Parameters of the linear bicycle, as `compute_bicycle_coefficients` takes them."""

    m: Scalar  # kg
    I: Scalar  # noqa: E741  kg m2, yaw inertia; the papers' letter
    l_f: Scalar  # m, from the centre of gravity to the front axle
    l_r: Scalar  # m, to the rear axle
    C_f: Scalar  # N/rad, cornering stiffness of a front tyre
    C_r: Scalar  # N/rad, of a rear tyre


class BicyclePlant(NamedTuple):
    """A and B of tie-vision (8): beta and gamma, from the steering angle and the yaw moment."""

    a11: Scalar  # effect of beta on beta' (1/s)
    a12: Scalar  # effect of gamma on beta'
    a21: Scalar  # effect of beta on gamma' (1/s^2)
    a22: Scalar  # effect of gamma on gamma' (1/s)
    b11: Scalar  # effect of the steering angle on beta' (1/s)
    b21: Scalar  # effect of the steering angle on gamma' (1/s^2)
    b22: Scalar  # effect of the yaw moment on gamma' (1/(kg m^2))


@jit
def compute_bicycle_coefficients(car: Vector, V: Scalar) -> BicyclePlant:
    """Compute the coefficients of the linear bicycle."""
    m, I, l_f, l_r, C_f, C_r = car[0], car[1], car[2], car[3], car[4], car[5]  # noqa: E741
    a11 = -2.0 * (C_f + C_r) / (m * V)
    a12 = -1.0 - 2.0 * (C_f * l_f - C_r * l_r) / (m * V * V)
    a21 = -2.0 * (C_f * l_f - C_r * l_r) / I
    a22 = -2.0 * (C_f * l_f * l_f + C_r * l_r * l_r) / (I * V)
    return BicyclePlant(a11, a12, a21, a22, 2.0 * C_f / (m * V), 2.0 * C_f * l_f / I, 1.0 / I)


@jit
def write_lateral(
    A: Matrix, B: Matrix, car: Vector, V: Scalar, states: int, inputs: int, preview: Scalar
) -> None:
    """Write the linear lateral model into A and B; entries that are zero are left alone.

    Args:
        A: State matrix, at least (states, states).
        B: Input matrix, at least (states, inputs).
        car: `Bicycle`, or its six numbers.
        V: Speed (m/s).
        states: Number of states, 2 to 4, of beta, gamma, psi and y_l.
        inputs: Number of inputs, 2 or 3, of delta_f, N_z and the road's curvature.
        preview: Preview distance l_pre of the camera (m).
    """
    a11, a12, a21, a22, b11, b21, b22 = compute_bicycle_coefficients(car, V)
    A[0, 0], A[0, 1], A[1, 0], A[1, 1] = a11, a12, a21, a22
    B[0, 0], B[1, 0], B[1, 1] = b11, b21, b22
    if states > 2:
        A[2, 1] = 1.0  # tie-vision (7)
    if states > 3:
        A[3, 0], A[3, 1], A[3, 2] = V, preview, V  # tie-vision (6)
    if inputs > 2 and states > 2:
        B[2, 2] = -V  # psi' = gamma - V kappa
        if states > 3:
            B[3, 2] = -V * preview


@jit
def write_roll(A: Matrix, B: Matrix, i: int, column: int, K: Scalar, C: Scalar, S: Scalar) -> None:
    """Write phi and phi_dot, driven by a_y, into A and B: double-layer-gps (3).

    Args:
        A: State matrix.
        B: Input matrix.
        i: Row of phi; phi_dot follows.
        column: Column of a_y in B.
        K: Roll stiffness over roll inertia (1/s2).
        C: Roll damping over roll inertia (1/s).
        S: M_s h_s over roll inertia (1/m).
    """
    A[i, i + 1] = 1.0
    A[i + 1, i], A[i + 1, i + 1] = -K, -C
    B[i + 1, column] = S


_write_lateral, _write_roll = as_python(write_lateral), as_python(write_roll)


@dataclass(frozen=True)
class LinearModel:
    """A linear model dx/dt = A x + B u, y = C x, with names."""

    A: Array  # (n, n), of the states
    B: Array  # (n, m), of the inputs
    C: Array  # (p, n), of the outputs
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def discretise(self, dt: float) -> tuple[Array, Array]:
        """Discretise by exact zero-order hold, tie-vision (9): (G, H), shapes (n, n) and (n, m).

        Args:
            dt: Length of a step (s).
        """
        from scipy.linalg import expm  # environments read this module too

        n, m = self.B.shape
        exact = expm(np.vstack([np.hstack([self.A, self.B]) * dt, np.zeros((m, n + m))]))
        return exact[:n, :n], exact[:n, n:]

    def to_control(self) -> "StateSpace":
        """Convert to a `control.StateSpace` with names (needs the extra `design`)."""
        import control

        D = np.zeros((len(self.outputs), len(self.inputs)))
        names = {name: list(getattr(self, name)) for name in ("states", "inputs", "outputs")}
        return control.StateSpace(self.A, self.B, self.C, D, **names)


def _make_lateral(vehicle: Vehicle, speed: float, n: int, m: int = 2) -> tuple[Array, Array]:
    """Make A (n, n) and B (n, m) of `write_lateral`."""
    if not speed > 0.0:
        raise ValueError(f"a linear model needs a positive speed, got {speed!r} m/s")
    A, B = np.zeros((n, n)), np.zeros((n, m))
    _write_lateral(A, B, vehicle.lateral, float(speed), n, m, vehicle.preview)
    return A, B


def make_bicycle_model(vehicle: Vehicle, speed: float) -> LinearModel:
    """Make the linear bicycle of beta, gamma from delta_f and N_z to gamma: tie-vision (1)-(2).

    Args:
        vehicle: Vehicle of the model.
        speed: Longitudinal speed (m/s), positive.
    """
    A, B = _make_lateral(vehicle, speed, 2)
    C = np.array([[0.0, 1.0]])
    return LinearModel(A, B, C, ("beta", "gamma"), ("delta_f", "N_z"), ("gamma",))


def make_vision_model(vehicle: Vehicle, speed: float) -> LinearModel:
    """Make the model of beta, gamma, psi (relative to the road) and y_l, tie-vision (8).

    Inputs are delta_f, N_z and kappa, the road's curvature: psi' = gamma - V kappa, and
    y_l = y_cg + l_pre psi - kappa l_pre^2 / 2 moves as y_l' = V beta + l_pre psi' + V psi.

    Args:
        vehicle: Vehicle of the model.
        speed: Longitudinal speed (m/s), positive.
    """
    A, B = _make_lateral(vehicle, speed, 4, 3)
    C = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    states = ("beta", "gamma", "psi", "y_l")
    return LinearModel(A, B, C, states, ("delta_f", "N_z", "kappa"), ("gamma", "psi", "y_l"))


def make_course_model(vehicle: Vehicle, speed: float) -> LinearModel:
    """Make the model of beta, gamma and psi with a course output, dakf-stability (1)-(3).

    Inputs are delta_f and N_z, outputs gamma and the course psi + beta.

    Args:
        vehicle: Vehicle of the model.
        speed: Longitudinal speed (m/s), positive.
    """
    A, B = _make_lateral(vehicle, speed, 3)
    C = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    return LinearModel(A, B, C, ("beta", "gamma", "psi"), ("delta_f", "N_z"), ("gamma", "course"))


def make_roll_model(vehicle: Vehicle) -> LinearModel:
    """Make the model of phi and phi_dot from the measured specific force a_y, double-layer-gps (3).

    The body's weight, M_s g h_s phi, is within a_y. The output is phi_dot.
    """
    A, B, I_x = np.zeros((2, 2)), np.zeros((2, 1)), vehicle.roll_inertia
    ratios = vehicle.roll_stiffness / I_x, vehicle.roll_damping / I_x, vehicle.roll_moment_arm / I_x
    _write_roll(A, B, 0, 0, *ratios)
    return LinearModel(A, B, np.array([[0.0, 1.0]]), ("phi", "phi_dot"), ("a_y",), ("phi_dot",))
