"""Predictive control: linear by quadratic programs, nonlinear by Gauss-Newton iterations."""

import dataclasses
import math
from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics import require_extra
from ...envs.numerics.functions import TICK, sincos
from ...envs.numerics.jit import jit
from ...envs.numerics.primitives import Matrix, Scalar, Vector
from ...envs.record import Array
from ...envs.task import LAGGED, ReferenceParams, compute_reference
from ...envs.validation import check_int
from ...envs.vehicle.dynamics import CarParams, Motion
from ...envs.vehicle.parameters import GRAVITY, Vehicle, VehicleSource
from ...envs.vehicle.tyres import MIN_SPEED, fit_fiala
from ..design.gauss_newton import MAX_VARIABLES, update_plan
from ..design.prediction import PredictionModel, PredictionState, PredictionTask, make_prediction
from ..design.sampled_model import SPEEDS, DesignSpec, interpolate_gains, make_design_model
from ..env_info import AnyEnv, get_env_facts
from .base import check_positive
from .lqr import IN, AdaptiveLqr, Lqr, make_design_state

MIN_STEP = 10  # ticks, the shortest of the prediction
STATUSES = ("unknown", "solved", "the observation is not finite", "diverged")
SOLVED, NOT_FINITE, DIVERGED = 1, 2, 3
_RHO = 0.1  # OSQP's step size at the start of every call, whatever the last one ended with
_SETTINGS = {  # tolerances of full scale; rho adapts after so many iterations, not after a time
    "verbose": False, "adaptive_rho": 1, "adaptive_rho_interval": 50, "rho": _RHO, "eps_abs": 1e-4,
    "eps_rel": 1e-4, "check_termination": 10, "polishing": False,
}  # fmt: skip


@dataclass(frozen=True)
class _QuadraticProgram:
    """Minimise a'P a / 2 + (F x)'a from x (n,) over a (h m,), fractions of limits step by step."""

    P: Array  # Hessian, (h m, h m)
    F: Array  # effect of the state on the gradient, (h m, n)
    A: Array  # constrained combinations, (rows, h m): inputs, then changes of added steering


@lru_cache(maxsize=4 * len(SPEEDS))
def _condense_program(
    vehicle: Vehicle, speed: float, design_spec: DesignSpec, horizon: int, authority: float
) -> _QuadraticProgram:
    """Condense the design model's steps into a program, with the LQR's cost to go at its end."""
    model, limits = make_design_model(vehicle, speed, design_spec), np.array([1.0, authority])
    n, m = model.H.shape
    Sx, Su = np.zeros(((horizon + 1) * n, n)), np.zeros(((horizon + 1) * n, horizon * m))
    Sx[:n] = np.eye(n)
    for i in range(horizon):  # x = Sx x_0 + Su u, row by row of steps
        rows, next_rows = slice(i * n, (i + 1) * n), slice((i + 1) * n, (i + 2) * n)
        Sx[next_rows], Su[next_rows] = model.G @ Sx[rows], model.G @ Su[rows]
        Su[next_rows, i * m : (i + 1) * m] += model.H
    steps = np.eye(horizon)
    Q, R = np.kron(np.eye(horizon + 1), model.Q), np.kron(steps, model.R)
    Q[-n:, -n:] = model.solve()[1]
    N = np.vstack([np.kron(steps, model.N), np.zeros((n, horizon * m))])
    scale = np.tile(limits[:m], horizon)
    P = scale[:, None] * (Su.T @ Q @ Su + Su.T @ N + N.T @ Su + R) * scale
    F = scale[:, None] * ((Su.T @ Q + N.T) @ Sx)
    size = float(np.diag(P).mean())
    A = np.eye(horizon * m)
    if m > 1:
        A = np.vstack([A, np.kron(steps - np.eye(horizon, k=-1), [[0.0, 1.0]])])
    return _QuadraticProgram(0.5 * (P + P.T) / size, F / size, A)


class Mpc(Lqr):
    """Predictive control: `lqr`'s cost over a horizon with limits, then as if there were none.

    Limits are those of the yaw moment and, where the env steers, of the added angle and its rate.
    Where none is met this is the LQR. The program is that of the nearest speed of `SPEEDS`. Each
    solution starts from the last one, which the memory holds. Raises ModuleNotFoundError without
    the extras `mpc` and `design`, ValueError for a missing entry or an option out of range.

    Args:
        env: Env of the controller.
        horizon: Steps of a control period, or of 10 ms where that is shorter.
        iterations: Maximum of the solver's iterations.
        disturbance_time: Time in which F_d and N_d decay (s).
        grip: Grip limit, as for `Controller`.

    Attributes:
        status: Status of each row in the last call: "solved", "solved inaccurate" (ten times the
            tolerance of 1e-4 of full scale), or why there is no solution and the action is NaN.
    """

    def __init__(
        self, env: AnyEnv, horizon: int = 30, iterations: int = 20000,
        disturbance_time: float = 0.3, grip: float | None = None,
    ) -> None:  # fmt: skip
        with require_extra("mpc", "predictive control needs OSQP"):
            import osqp
        self.horizon = check_int("horizon", horizon, "steps")
        self.iterations = check_int("iterations", iterations, "iterations")
        super().__init__(env, disturbance_time=disturbance_time, grip=grip)
        known = osqp.SolverStatus
        self._accepted = (int(known.OSQP_SOLVED), int(known.OSQP_SOLVED_INACCURATE))
        self._steer_unit = 1.0
        period = max(self.control_period, MIN_STEP)
        self.prediction = dataclasses.replace(self.design_spec, period=period)
        self._shift = period == self.control_period
        self._change = self.nominal.steering_rate * period * TICK / self.authority
        inputs = self.horizon * self.width
        self._rows = inputs + (self.horizon if self.width > 1 else 0)
        # The last added steering (fraction of authority), the solution, and its dual variables: of
        # the inputs' limits, and of the added steering's rate where the env steers.
        end = 1 + inputs + self._rows
        self.memory = end + self.remembered
        self._primal, self._dual = slice(1, 1 + inputs), slice(1 + inputs, end)
        self._solvers: dict[float, tuple[_QuadraticProgram, Any]] = {}
        self.status = list[str]()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the solvers, which cannot be copied and are set up anew."""
        return self.__dict__ | {"_solvers": {}}

    def _mark_not_finite(self, rows: npt.NDArray[np.bool_], state: Array) -> None:
        for i in np.flatnonzero(rows):
            self.status[i] = STATUSES[NOT_FINITE]

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        self.status = []
        z = np.empty(len(self.design_spec.states))
        rows = zip(inputs, state, action, self._compute_max_moment(inputs), strict=True)
        for x, memory, row_action, max_moment in rows:
            make_design_state(x, self.share, z)
            if self.remembered:
                z[-2:] = memory[-2:]  # moments of the steps before
                memory[-2] = z[2]
            speed = 0.5 * (x[IN.wheel_left] + x[IN.wheel_right])
            self.status.append(self._solve(speed, z, memory, row_action, float(max_moment)))
            if self.remembered:
                memory[-1] = row_action[0]

    def _solve(self, v: float, z: Array, memory: Array, action: Array, max_moment: float) -> str:
        """Solve for a row's action (m,) and memory, in place; return the status."""
        m, count = self.width, self.horizon * self.width
        low, high = -np.ones(self._rows), np.ones(self._rows)
        low[:count:m], high[:count:m] = -max_moment, max_moment
        if m > 1:
            low[count:], high[count:] = -self._change, self._change
            low[count] += memory[0]
            high[count] += memory[0]
        program, solver = self._get_solver(float(min(SPEEDS, key=lambda knot: abs(knot - v))))
        solver.update_settings(rho=_RHO)
        solver.update(q=program.F @ z, l=low, u=high)
        solver.warm_start(x=memory[self._primal], y=memory[self._dual])
        solution = solver.solve(raise_error=False)
        if solution.info.status_val not in self._accepted:
            action[:] = np.nan
            return str(solution.info.status)
        action[:] = solution.x[:m]
        memory[0] = solution.x[1] if m > 1 else 0.0
        memory[self._primal] = self._shift_solution(solution.x, m)
        duals = [(solution.y[:count], m), (solution.y[count:], 1)]  # of limits, of the rate
        memory[self._dual] = np.concatenate([self._shift_solution(*dual) for dual in duals])
        return str(solution.info.status)

    def _shift_solution(self, values: Array, width: int) -> Array:
        """Shift a solution by a step, with the last step repeated."""
        if not self._shift or len(values) == 0:
            return values
        return np.concatenate([values[width:], values[-width:]])

    def _get_solver(self, speed: float) -> tuple[_QuadraticProgram, Any]:
        """Get the program of a speed of `SPEEDS` and its solver, set up at its first use."""
        if speed not in self._solvers:
            import osqp
            from scipy.sparse import csc_matrix  # slow to load

            design = self.prediction, self.horizon, self.authority
            program, solver = _condense_program(self.nominal, speed, *design), osqp.OSQP()
            P, A = csc_matrix(np.triu(program.P)), csc_matrix(program.A)
            gradient, limits = np.zeros(len(program.P)), (-np.ones(self._rows), np.ones(self._rows))
            solver.setup(P, gradient, A, *limits, max_iter=self.iterations, **_SETTINGS)
            self._solvers[speed] = program, solver
        return self._solvers[speed]


_FIRST_ITERATIONS = 6  # added to the others at an episode's first decision
_MAX_SIDESLIP = 1.2  # rad: a prediction starts from this sideslip angle at most
# Added steering last commanded (rad) and status; the plan's variables follow, and what
# `Lqr` remembers of the yaw moment.
Memory = namedtuple("Memory", "added_command status")
LAST = Memory(*range(2))
PLAN = len(Memory._fields)


class Design(NamedTuple):
    """The parts that all decisions of a controller share."""

    model: PredictionModel
    target: ReferenceParams  # of the nominal car
    gains: Matrix  # K of `GainTables` for the states of `prediction`, (..., m, 9 or 11)
    terminal: Matrix  # T of `GainTables`, likewise, (..., 4 or 6, 9 or 11)
    axes: tuple[Vector, ...]  # knots of speed, front and rear stiffness
    scheduled: int  # 1: gains follow the stiffnesses of the observation
    blocks: Vector  # steps of each block
    disturbed: int  # disturbances of the observation: 0 none, 1 forces, 2 rates
    steps: float  # steps of the prediction in a control period
    iterations: int  # of a decision


def _make_blocks(steps: int, count: int) -> Array:
    """Make lengths of at most `count` blocks that grow towards the end of a horizon of steps."""
    ends = np.unique(np.rint(np.geomspace(1.0, steps, count)).astype(np.int64))
    return np.diff(ends, prepend=0)


@jit
def _replace_tyres(car: CarParams, C_f: Scalar, C_r: Scalar, mu: Scalar) -> CarParams:
    """Replace a car's stiffnesses of a tyre (N/rad) and its friction, under all wheels."""
    # C_f and C_r are the fields 4 and 5, mu of the left wheels is 10, mu_r of the right ones 19
    tyres, left, right = (C_f, C_r), (mu,), (mu,)
    return CarParams(*(car[:4] + tyres + car[6:10] + left + car[11:19] + right + car[20:]))


@jit
def _shift_plan(plan: Vector, blocks: Vector, m: int, steps: float) -> None:
    """Shift a plan by so many steps of the prediction, each block towards its next."""
    for i in range(len(plan) - m):
        plan[i] += (plan[i + m] - plan[i]) * min(1.0, steps / blocks[i // m])


@jit
def _interpolate_regulator(
    table: Matrix, axes: tuple[Vector, ...], v: Scalar, front: Scalar, rear: Scalar, per: Vector
) -> Matrix:
    """Interpolate a table's rows, shape (rows, 9 or 11), for the states of `prediction`."""
    # per: what turns F_d and N_d into the table's own disturbances, forces or rates
    values = np.empty(table.shape[3:])
    interpolate_gains(table, axes, v, front, rear, values)
    for i in range(len(values)):
        values[i, 7] *= per[0]
        values[i, 8] *= per[1]
    return values


@jit
def _prepare_prediction(
    design: Design, x: Vector, friction: Scalar, roll: Vector, added_command: Scalar,
    max_moment: Scalar, before: Vector,
) -> PredictionTask:  # fmt: skip
    """Prepare the predictions of a row's decision."""
    # x: row of `lqr.Inputs`, roll: angle and rate (rad, rad/s), NaN where they are not measured,
    # added_command: the last one of added steering (rad), max_moment: fraction of full scale,
    # before: yaw moment at the last decision and its command (of full scale), or empty
    model, disturbed = design.model, design.disturbed
    v = max(0.5 * (x[IN.wheel_left] + x[IN.wheel_right]), MIN_SPEED)
    front = x[IN.front_stiffness] if design.scheduled else model.car.C_f
    rear = x[IN.rear_stiffness] if design.scheduled else model.car.C_r
    car = _replace_tyres(model.car, front, rear, friction)
    gamma, driver, steady = x[IN.gamma_hat], x[IN.steer_command], (x[IN.beta_ref], x[IN.gamma_ref])
    if model.kind.reference == LAGGED:
        steady = compute_reference(driver, v, design.target, LAGGED)
    per = (car.m * v, car.I) if disturbed == 2 else (1.0, 1.0)
    F_d = x[IN.disturbance_1] * per[0] if disturbed else 0.0
    N_d = x[IN.disturbance_2] * per[1] if disturbed else 0.0
    phi, phi_rate = roll[0], roll[1]
    if phi != phi:  # not measured: as in a steady turn
        phi, phi_rate = car.S * v * gamma / (car.K_x - car.S * GRAVITY), 0.0
    rolls = float(model.kind.roll)  # 1: the car rolls
    sine, cosine = sincos(min(max(x[IN.beta_hat], -_MAX_SIDESLIP), _MAX_SIDESLIP))
    v_y = v * (x[IN.beta_hat] if model.kind.small_angle else sine / cosine)
    motion = Motion(v, v_y, gamma, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, rolls * phi, rolls * phi_rate)
    T_l, T_r, n = x[IN.torque_left], x[IN.torque_right], len(before)
    start = PredictionState(
        motion, T_l, T_r, x[IN.steer], added_command, x[IN.beta_ref], x[IN.gamma_ref], F_d, N_d,
        before[0] if n > 0 else 0.0, before[1] if n > 0 else 0.0,
    )  # fmt: skip
    a_x = (T_l + T_r) / (car.m * car.r)
    per_force = 1.0 / per[0], 1.0 / per[1]
    K = _interpolate_regulator(design.gains, design.axes, v, front, rear, per_force)
    end = _interpolate_regulator(design.terminal, design.axes, v, front, rear, per_force)
    return PredictionTask(model, start, car, driver, a_x, steady, max_moment, K, end, design.blocks)


@jit
def _nmpc_law(
    x: Vector, state: Matrix, action: Matrix, max_moment: Vector, friction: Vector, rolls: Vector,
    design: Design,
) -> None:  # fmt: skip
    """Compute the actions; state: `Memory` and the plan, rolls: as in `_prepare_prediction`."""
    blocks, m = design.blocks, design.gains.shape[3]
    for row in range(len(x)):
        last_command, end = state[row, LAST.added_command], PLAN + m * len(blocks)
        task = _prepare_prediction(
            design, x[row], friction[row], rolls[row], last_command, max_moment[row],
            state[row, end:],
        )  # fmt: skip
        plan, extra_iterations = state[row, PLAN:end].copy(), _FIRST_ITERATIONS
        if state[row, LAST.status] == SOLVED:
            _shift_plan(plan, blocks, m, design.steps)
            extra_iterations = 0
        J, share, added_command = update_plan(task, plan, design.iterations + extra_iterations)
        if np.isfinite(J):
            state[row, PLAN:end], state[row, LAST.added_command] = plan, added_command
            if state.shape[1] > end:
                car, start = task.car, task.start
                torque_per_share = 2.0 * design.model.full_scale * car.r / car.d_r
                state[row, end] = (start.T_r - start.T_l) / torque_per_share
                state[row, end + 1] = share
            state[row, LAST.status] = SOLVED
            action[row, 0] = share
            if m > 1:
                action[row, 1] = added_command / design.model.authority
        else:
            state[row, :], action[row, :] = 0.0, math.nan
            state[row, LAST.status] = DIVERGED


class Nmpc(Lqr):
    """Real-time Gauss-Newton iterations on the env's own plant and cost, with `lqr`'s cost to go.

    The prediction has steps of a control period, or of 10 ms where that is shorter. Tyres, roll,
    motors and limits are those of the nominal car, or of the true one where the observation has
    them (`stiffness`, `true_friction`). The driver's command and acceleration are held. The plan is
    added to `lqr`'s action, within the limits of moment, `grip`, steering and its rate. Where no
    limit is met and the car is linear the action is `lqr`'s. It also reads phi_hat and phi_rate_hat
    where they are there. Where no prediction is finite the action is NaN.
    Raises ValueError for a missing entry, an option out of range, or rows of different plants.

    Args:
        env: Env of the controller.
        horizon: Length of the prediction (s).
        iterations: Iterations of a decision; an episode's first one has more.
        disturbance_time: Time in which F_d and N_d decay (s).
        vehicle: Vehicle of the design, as for `Lqr`.
        stiffness: Entries of front and rear cornering stiffness, as for `Lqr`.
        knots: Knots of each stiffness axis, as for `Lqr`.
        steer_weight: Factor on the cost of added steering, as for `Lqr`.
        grip: Grip limit, as for `Controller`.
        knows_car: Whether each row's car is in the observation, as for `Lqr`.
    """

    min_period = MIN_STEP
    knows_friction = True

    def __init__(
        self, env: AnyEnv, horizon: float = 0.5, iterations: int = 2, disturbance_time: float = 0.3,
        vehicle: VehicleSource | None = None, stiffness: Sequence[str] = (),
        knots: int = 7, steer_weight: float = 10.0, grip: float | None = None,
        knows_car: bool = False,
    ) -> None:  # fmt: skip
        options = disturbance_time, vehicle, stiffness, knots, steer_weight, grip, knows_car
        super().__init__(env, *options)
        check_int("iterations", iterations, "passes")
        spec = self.design_spec
        steps = max(round(check_positive("horizon", horizon) / (spec.period * TICK)), 1)
        blocks = _make_blocks(steps, MAX_VARIABLES // self.width)
        self.memory = PLAN + self.width * len(blocks) + self.remembered
        self._plant, *others = get_env_facts(env).plants
        if others:
            raise ValueError("rows of a vector env share one prediction, but their plants differ")
        disturbed = ("none", "forces", "rates").index(spec.disturbances)
        lasting = blocks, disturbed, self.control_period / spec.period, iterations
        self.design = self._make_design(*lasting)

    def _make_design(self, *lasting: Any) -> Design:
        """Make the parts of all decisions from the gains and what lasts when these change."""
        spec, target = self.design_spec, self._target
        model = make_prediction(self.vehicle, self._plant, spec, target, self.authority)
        # a prediction's states have both disturbances, which a design may lack: without effect
        columns = [7, 7] if spec.disturbances == "none" else []
        tables = self.table[..., : -self.width], self._terminal
        gains, terminal = (np.insert(table, columns, 0.0, axis=-1) for table in tables)
        return Design(model, target, gains, terminal, self.axes, int(self.scheduled), *lasting)

    def _design_anew(self, car: Vehicle) -> "Nmpc":
        fitted = fit_fiala(car) if self._plant.tyres == "magic-formula" else car
        other = super()._design_anew(fitted)
        assert isinstance(other, Nmpc)
        other.design = other._make_design(*self.design[-4:])
        return other

    def _list_extra_entries(self, names: Sequence[str]) -> tuple[str, ...]:
        rolling = ("phi_hat", "phi_rate_hat")
        self._rolling = set(rolling) <= set(names)
        return rolling if self._rolling else ()

    def _mark_not_finite(self, rows: npt.NDArray[np.bool_], state: Array) -> None:
        state[rows, LAST.status] = NOT_FINITE

    def status(self, state: Array) -> list[str]:
        """List the status of each row's last decision, of `STATUSES`."""
        return [STATUSES[int(code)] for code in state[:, LAST.status]]

    def _compute_actions(self, inputs: Array, state: Array, action: Array) -> None:
        rolls = np.full((len(inputs), 2), np.nan)
        if self._rolling:
            rolls = inputs[:, len(IN) : len(IN) + 2]
        limits = self._compute_max_moment(inputs), np.ascontiguousarray(self._get_friction(inputs))
        _nmpc_law(inputs, state, action, *limits, np.ascontiguousarray(rolls), self.design)


class AdaptiveNmpc(AdaptiveLqr, Nmpc):
    """`Nmpc` that predicts with tyres and friction of `joint`, as `AdaptiveLqr` has them."""
