"""The car as its controllers predict it, sampled at the control period, and its regulators' gains.

Motion and cost are summed tick by tick: what is minimised is the episode's cost J itself, but for
its cap, of the linear car at a held speed, with driver's command and references held. Gains are
designed on a grid of speeds and cornering stiffnesses, and interpolated in compiled code.

Args:
    vehicle: Vehicle of the design.
    speed: Speed (m/s).
    design_spec: Parameters of the design.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...envs.numerics.functions import TICK
from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector
from ...envs.record import Array
from ...envs.task import BETA_SCALE, EFFORT_WEIGHT, GAMMA_SCALE, RATE_TICKS, STEER_SCALE, ZERO_SLIP
from ...envs.vehicle.actuators import make_lag
from ...envs.vehicle.linear import LinearModel, make_bicycle_model
from ...envs.vehicle.parameters import Vehicle

# States that the inputs move; N_z is the delivered fraction of full scale, angles are in rad.
DYNAMIC = ("beta", "gamma", "N_z", "delta_f")
_HELD = ("driver", "beta_ref", "gamma_ref")  # held constant: driver's steering (rad), references
# Where the moment's rate costs: its fraction a period ago, and the command from then on.
_REMEMBERED = ("N_z before", "N_z commanded before")
# Disturbances by kind: an Ornstein-Uhlenbeck force and moment in N and N m, as `exact-kf` knows
# them, or d_1 and d_2 in rad/s and rad/s2, which stay: dakf-stability (8)-(9), (14).
_DISTURBANCES = {"none": (), "forces": ("F_d", "N_d"), "rates": ("d1", "d2")}


@dataclass(frozen=True)
class DesignSpec:
    """The parameters of a design, but for the car and its speed."""

    period: int  # control period in ticks
    full_scale: float  # yaw moment at a first input of 1 (N m)
    steers: bool  # whether added steering (rad) is a second input
    kind: int  # index in `REFERENCES`
    disturbances: str = "none"  # key of `_DISTURBANCES`
    disturbance_time: float = 0.3  # time in which forces decay (s)
    steer_weight: float = 1.0  # factor on the cost of added steering
    moment_rate: float = 0.0  # s2, weight of the yaw moment's rate

    @property
    def states(self) -> tuple[str, ...]:
        """Names of all states."""
        remembered = _REMEMBERED if self.moment_rate > 0.0 else ()
        return DYNAMIC + _HELD + _DISTURBANCES[self.disturbances] + remembered

    @property
    def cost_weights(self) -> tuple[float, ...]:
        """Weights of sideslip angle, yaw rate, yaw moment and added steering in the cost."""
        gamma = 0.0 if self.kind == ZERO_SLIP else 1.0 / GAMMA_SCALE**2
        steer = self.steer_weight * EFFORT_WEIGHT / STEER_SCALE**2 if self.steers else 0.0
        return 1.0 / BETA_SCALE**2, gamma, EFFORT_WEIGHT, steer


@dataclass(frozen=True)
class DesignModel:
    """The model x+ = G x + H u over a period, with the cost x'Qx + u'Ru + 2 x'Nu."""

    G: Array  # transition of the states, shape (n, n)
    H: Array  # effect of the inputs, shape (n, m)
    Q: Array  # weight of the states, shape (n, n)
    R: Array  # weight of the inputs, shape (m, m)
    N: Array  # cross weight, shape (n, m)
    states: tuple[str, ...]  # names
    n_moved: int = len(DYNAMIC)  # states that inputs move; the others move by themselves alone

    @property
    def order(self) -> list[int]:
        """Indices of the states, those that inputs move first."""
        n = len(self.states)
        d, last = len(DYNAMIC), n - (self.n_moved - len(DYNAMIC))
        return [*range(d), *range(last, n), *range(d, last)]

    def solve(self) -> tuple[Array, Array]:
        """Solve for the best regulator u = -K x, K (m, n), and V (n, n) of its cost to go x'Vx.

        The states that inputs move have the gains of `control.dlqr`. The others need not decay;
        their optimal gains follow from a linear equation for their part of the cost to go.
        V lacks the part that no input changes.
        """
        from scipy.linalg import solve, solve_discrete_are

        if _REMEMBERED[0] in self.states:  # those that inputs move go to the front
            order, back, grid = self.order, np.argsort(self.order), np.ix_(self.order, self.order)
            matrices = self.G[grid], self.H[order], self.Q[grid], self.R, self.N[order]
            K, V = DesignModel(*matrices, tuple(f"state {i}" for i in order), self.n_moved).solve()
            return K[:, back], V[np.ix_(back, back)]
        G, H, Q, R, N, d = self.G, self.H, self.Q, self.R, self.N, self.n_moved
        A, B, W = G[:d, :d], H[:d], G[d:, d:]
        P = solve_discrete_are(A, B, Q[:d, :d], R, s=N[:d])
        whole = np.array(B)  # a view's products differ in the last bit
        K = solve(whole.T @ P @ whole + R, whole.T @ P @ np.array(A) + N[:d].T)
        A12, N2 = G[:d, d:], N[d:]
        closed = A - B @ K
        # P12 = Q12 - K'N2' + (A - BK)'(P A12 + P12 W), stacked by columns
        right = Q[:d, d:] - K.T @ N2.T + closed.T @ P @ A12
        lhs = np.eye(right.size) - np.kron(W.T, closed.T)
        P12 = np.linalg.solve(lhs, right.ravel(order="F")).reshape(right.shape, order="F")
        held_gain = np.linalg.solve(R + B.T @ P @ B, B.T @ (P @ A12 + P12 @ W) + N2.T)
        V = np.block([[P, P12], [P12.T, np.zeros_like(W)]])
        return np.asarray(np.hstack([K, held_gain]), np.float64), V


def make_design_model(vehicle: Vehicle, speed: float, design_spec: DesignSpec) -> DesignModel:
    """Make the model of a vehicle at a speed, in steps of `design_spec.period` ticks."""
    G1, H1, C, D = make_tick_model(vehicle, speed, design_spec)
    n, m = H1.shape
    W = TICK * np.diag(design_spec.cost_weights)
    step, G, H = np.hstack([G1, H1]), np.eye(n), np.zeros((n, m))
    cost_matrix, shares = np.zeros((n + m, n + m)), []  # delivered in each tick
    for _ in range(design_spec.period):
        transition = np.vstack([np.hstack([G, H]), np.hstack([np.zeros((m, n)), np.eye(m)])])
        cost_outputs = np.hstack([C, D]) @ transition
        cost_matrix += cost_outputs.T @ W @ cost_outputs
        shares.append(cost_outputs[2])
        G, H = np.split(step @ transition, [n], axis=1)
    if design_spec.moment_rate > 0.0:
        cost_matrix += _compute_rate_cost(vehicle, design_spec, np.array(shares))
        G[-2:], H[-2:] = np.eye(n)[[2, n - 1]], 0.0
        G[-1], H[-1, 0] = 0.0, 1.0
    cost_matrix = 0.5 * (cost_matrix + cost_matrix.T)
    Q, R, N = cost_matrix[:n, :n], cost_matrix[n:, n:], cost_matrix[:n, n:]
    moved = len(DYNAMIC) + (len(_REMEMBERED) if design_spec.moment_rate > 0.0 else 0)
    return DesignModel(G, H, Q, R, N, design_spec.states, moved)


def _compute_rate_cost(vehicle: Vehicle, design_spec: DesignSpec, shares: Array) -> Array:
    """Compute the cost (n + m, n + m) of the moment's rate from shares (period, n + m)."""
    # a rate is taken over `RATE_TICKS`, in shorter periods over one of them
    ticks, width = shares.shape
    lag, span = make_lag(vehicle.motor_lag, TICK), min(ticks, RATE_TICKS)
    rest = lag.mean * lag.end ** np.arange(ticks)
    before, n = np.zeros((ticks, width)), len(design_spec.states)
    before[:, n - 2], before[:, n - 1] = rest, 1.0 - rest
    changes = shares - np.vstack([before, shares])[ticks - span : 2 * ticks - span]
    weight = design_spec.moment_rate * TICK / (span * TICK) ** 2
    return np.asarray(weight * changes.T @ changes)


def make_tick_model(
    vehicle: Vehicle, speed: float, design_spec: DesignSpec
) -> tuple[Array, Array, Array, Array]:
    """Make G (n, n), H (n, m) of a tick, and C (4, n), D (4, m) from its start to the outputs.

    The cost judges the outputs: e_beta and e_gamma at the tick's end, and the tick's means of the
    delivered fraction of the yaw moment and of the added steering (the applied less the driver's).
    """
    lags = [make_lag(tau, TICK) for tau in (vehicle.motor_lag, vehicle.steering_lag)]
    plane, push = _discretise_plane(vehicle, speed, design_spec)
    n, m = len(design_spec.states), 1 + design_spec.steers  # inputs: N_z, added steering (rad)
    G, H = np.eye(n), np.zeros((n, m))
    G[:2] = 0.0
    G[:2, :4], H[:2, :1], G[:2, 4:5] = plane[:, :4], plane[:, 4:5], plane[:, 5:6]
    if design_spec.steers:
        H[:2, 1:] = plane[:, 5:6]
    C, D = np.zeros((4, n)), np.zeros((4, m))
    C[2, 2], C[3, 3], C[3, 4] = lags[0].mean, lags[1].mean, -lags[1].mean
    for i, lag in enumerate(lags):
        G[2 + i, 2 + i] = lag.end
    G[3, 4] = 1.0 - lags[1].end
    for i in range(m):
        H[2 + i, i], D[2 + i, i] = 1.0 - lags[i].end, 1.0 - lags[i].mean
    if design_spec.disturbances != "none":
        G[:2, 7:9] = push
        if design_spec.disturbances == "forces":
            G[7:9, 7:9] *= math.exp(-TICK / design_spec.disturbance_time)
    C[:2], D[:2] = G[:2], H[:2]
    C[0, 5], C[1, 6] = -1.0, -1.0
    return G, H, C, D


def _discretise_plane(vehicle: Vehicle, speed: float, spec: DesignSpec) -> tuple[Array, Array]:
    """Discretise beta and gamma over a tick: from the plane (2, 6) and the disturbances (2, 2)."""
    # The plane's columns: beta, gamma, both actuators, both commands. An actuator without lag is
    # its command.
    model = make_bicycle_model(vehicle, speed)
    B = model.B[:, ::-1] * np.array([spec.full_scale, 1.0])  # N_z, delta_f, as the inputs stand
    A = np.zeros((4, 4))
    A[:2, :2] = model.A
    inputs = np.zeros((4, 4))  # commands of both actuators, then the disturbances
    for i, tau in enumerate((vehicle.motor_lag, vehicle.steering_lag)):
        if tau > 0.0:
            A[:2, 2 + i] = B[:, i]
            A[2 + i, 2 + i], inputs[2 + i, i] = -1.0 / tau, 1.0 / tau
        else:
            inputs[:2, i] = B[:, i]
    per = (1.0 / (vehicle.mass * speed), 1.0 / vehicle.yaw_inertia)
    inputs[:2, 2:] = np.diag(per if spec.disturbances == "forces" else (1.0, 1.0))
    G, H = LinearModel(A, inputs, np.eye(4), DYNAMIC, (), ()).discretise(TICK)
    return np.hstack([G[:2], H[:2, :2]]), H[:2, 2:]


SPEEDS = tuple(np.geomspace(2.0, 60.0, 48).tolist())  # m/s, of the designs


@jit
def find_cell(axis: Vector, value: Scalar) -> tuple[int, Scalar]:
    """Find a cell's first knot and the value's fraction of the cell; (0, 0) for a single knot.

    Args:
        axis: Rising knots.
        value: Value in the axis's unit, held at the axis's ends.
    """
    if len(axis) < 2:
        return 0, 0.0
    i = 0
    while i < len(axis) - 2 and value >= axis[i + 1]:
        i += 1
    return i, min(max((value - axis[i]) / (axis[i + 1] - axis[i]), 0.0), 1.0)


@jit
def interpolate_gains(
    table: Matrix, axes: tuple[Vector, ...], v: Scalar, front: Scalar, rear: Scalar, K: Matrix
) -> None:
    """Interpolate a table of gains, linear along each axis.

    Args:
        table: Table, shape (speeds, fronts, rears, m, n).
        axes: Knots of the three axes.
        v: Speed (m/s).
        front: Front cornering stiffness of a tyre (N/rad).
        rear: Rear cornering stiffness of a tyre (N/rad).
        K: Gains, shape (m, n), filled.
    """
    i, a = find_cell(axes[0], v)
    j, b = find_cell(axes[1], front)
    k, c = find_cell(axes[2], rear)
    K[:] = 0.0
    for corner in range(8):
        p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
        w = (a if p else 1.0 - a) * (b if q else 1.0 - b) * (c if r else 1.0 - c)
        if w > 0.0:
            K += w * table[i + p, j + q, k + r]


class GainTables(NamedTuple):
    """The regulators on a grid, shape (speeds, fronts, rears, ...): `DesignModel.solve`."""

    gains: Array  # [K S], (..., m, n + m)
    terminal: Array  # T, (..., d, n): what is to come costs |T x|^2, but for what no input changes


@lru_cache(maxsize=128)  # a table has at most 0.3 MB; a matrix comes back to a car often
def make_gains(
    vehicle: Vehicle, spec: DesignSpec, speeds: Sequence[float], fronts: Sequence[float],
    rears: Sequence[float],
) -> GainTables:  # fmt: skip
    """Make the regulators of a car over speed, front and rear stiffness.

    Args:
        vehicle: Vehicle of the design.
        spec: Parameters of the design.
        speeds: Speeds (m/s).
        fronts: Front stiffnesses (N/rad); empty: the vehicle's.
        rears: Rear stiffnesses (N/rad); empty: the vehicle's.
    """
    shape = len(speeds), max(len(fronts), 1), max(len(rears), 1)
    gains, terminal = [], []
    stiffnesses = fronts or (vehicle.front_stiffness,), rears or (vehicle.rear_stiffness,)
    for speed, front, rear in itertools.product(speeds, *stiffnesses):
        car = vehicle.replace(front_stiffness=front, rear_stiffness=rear)
        model = make_design_model(car, speed, spec)
        K, V = model.solve()
        # in one period another input costs (u + K x)'S(u + K x) more
        gains.append(np.hstack([K, model.R + model.H.T @ V @ model.H]))
        terminal.append(_factor_cost(V, model.order, model.n_moved))
    tables = (np.array(parts).reshape(*shape, *parts[0].shape) for parts in (gains, terminal))
    return GainTables(*tables)


def _factor_cost(V: Array, order: Sequence[int], d: int) -> Array:
    """Factor V: T (d, n) with |T x|^2 = x'Vx but for the states that no input moves."""
    V = V[np.ix_(order, order)]  # those that inputs move first
    P = V[:d, :d] + 1e-9 * np.diag(np.diag(V)[:d]) + 1e-15 * np.eye(d)  # without lag: singular
    L = np.linalg.cholesky(P)
    return np.hstack([L.T, np.linalg.solve(L, V[:d, d:])])[:, np.argsort(order)]
