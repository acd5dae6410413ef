"""Linear model predictive control: the LQR's cost under the actuators' limits, solved by OSQP."""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.ticks import TICK
from ...envs.vehicle.parameters import Vehicle
from ..design.sampled_model import SPEEDS, DesignSpec, make_design_model
from ..env_info import AnyEnv
from .lqr import IN, Lqr, make_design_state

MIN_STEP = 10  # ticks, the shortest of the prediction
NOT_FINITE = "the observation is not finite"
_RHO = 0.1  # OSQP's step size at the start of every call, whatever the last one ended with
_SETTINGS = {  # tolerances of full scale; rho adapts after so many iterations, not after a time
    "verbose": False, "adaptive_rho": 1, "adaptive_rho_interval": 50, "rho": _RHO, "eps_abs": 1e-4,
    "eps_rel": 1e-4, "check_termination": 10, "polishing": False,
}  # fmt: skip


@dataclass(frozen=True)
class _QuadraticProgram:
    """Minimise a'P a / 2 + (F x)'a over the inputs a (h m,) of h steps from the state x (n,).

    Inputs are fractions of their limits, step by step. The mean of P's diagonal is 1.
    """

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
    scale = np.tile(limits[: len(design_spec.inputs)], horizon)
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
    solution starts from the last one, which the memory holds.

    Args:
        env: Env of the controller.
        horizon: Steps of a control period, or of 10 ms where that is shorter.
        iterations: Maximum of the solver's iterations.
        disturbance_time: Time in which F_d and N_d decay (s).
        grip: Grip limit, as for `Controller`.

    Attributes:
        status: Status of each row in the last call: "solved", "solved inaccurate" (ten times the
            tolerance of 1e-4 of full scale), or why there is no solution and the action is NaN.
        solve_time: Time of the solver for each row (s).

    Raises:
        ModuleNotFoundError: The extras `mpc` and `design` are not installed.
        ValueError: An entry is missing, or an option is out of range.
    """

    def __init__(
        self, env: AnyEnv, horizon: int = 30, iterations: int = 20000,
        disturbance_time: float = 0.3, grip: float | None = None,
    ) -> None:  # fmt: skip
        try:
            import osqp
        except ModuleNotFoundError:
            text = "predictive control needs OSQP: pip install 'sideslip[mpc]'"
            raise ModuleNotFoundError(text) from None
        for name, value in (("horizon", horizon), ("iterations", iterations)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} is a positive whole number, got {value!r}")
        super().__init__(env, disturbance_time=disturbance_time, grip=grip)
        self._osqp: Any = osqp
        known = osqp.SolverStatus
        self._accepted = (int(known.OSQP_SOLVED), int(known.OSQP_SOLVED_INACCURATE))
        self.horizon, self.iterations, self._steer_unit = horizon, iterations, 1.0
        period = max(self.control_period, MIN_STEP)
        self.prediction = dataclasses.replace(self.design_spec, period=period)
        self._shift = period == self.control_period
        self._change = self.nominal.steering_rate * period * TICK / self.authority
        inputs = horizon * self.width
        self._rows = inputs + (horizon if self.width > 1 else 0)
        # The last added steering (fraction of authority), the solution, and its dual variables: of
        # the inputs' limits, and of the added steering's rate where the env steers.
        end = 1 + inputs + self._rows
        self.memory = end + self.remembered
        self._primal, self._dual = slice(1, 1 + inputs), slice(1 + inputs, end)
        self._ready_for: dict[float, tuple[_QuadraticProgram, Any]] = {}
        self.status, self.solve_time = list[str](), list[float]()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the solvers, which cannot be copied and are set up anew."""
        return self.__dict__ | {"_ready_for": {}, "_osqp": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Import the solver's module, which cannot be copied either."""
        import osqp

        self.__dict__.update(state | {"_osqp": osqp})

    def _mark_not_finite(self, rows: npt.NDArray[np.bool_], state: Array) -> None:
        for i in np.flatnonzero(rows):
            self.status[i] = NOT_FINITE

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        self.status, self.solve_time = [], []
        z = np.empty(len(self.design_spec.states))
        rows = zip(inputs, state, action, self._compute_max_moment(inputs), strict=True)
        for x, memory, row_action, max_moment in rows:
            make_design_state(x, self.share, z)
            if self.remembered:
                z[-2:], memory[-2] = memory[-2:], z[2]
            speed = 0.5 * (x[IN.wheel_left] + x[IN.wheel_right])
            status, seconds = self._solve(speed, z, memory, row_action, float(max_moment))
            if self.remembered:
                memory[-1] = row_action[0]
            self.status.append(status)
            self.solve_time.append(seconds)

    def _solve(
        self, speed: float, z: Array, memory: Array, row_action: Array, max_moment: float
    ) -> tuple[str, float]:
        """Solve for a row's action (m,) and memory, in place; return status and time (s)."""
        m, count = self.width, self.horizon * self.width
        low, high = -np.ones(self._rows), np.ones(self._rows)
        low[:count:m], high[:count:m] = -max_moment, max_moment
        if m > 1:
            low[count:], high[count:] = -self._change, self._change
            low[count] += memory[0]
            high[count] += memory[0]
        program, solver = self._get_solver(float(min(SPEEDS, key=lambda knot: abs(knot - speed))))
        solver.update_settings(rho=_RHO)
        solver.update(q=program.F @ z, l=low, u=high)
        solver.warm_start(x=memory[self._primal], y=memory[self._dual])
        solution = solver.solve(raise_error=False)
        if solution.info.status_val not in self._accepted:
            row_action[:] = np.nan
            return str(solution.info.status), float(solution.info.run_time)
        row_action[:] = solution.x[:m]
        memory[0] = solution.x[1] if m > 1 else 0.0
        memory[self._primal] = self._shift_solution(solution.x, m)
        duals = [(solution.y[:count], m), (solution.y[count:], 1)]  # of limits, of the rate
        memory[self._dual] = np.concatenate([self._shift_solution(*dual) for dual in duals])
        return str(solution.info.status), float(solution.info.run_time)

    def _shift_solution(self, values: Array, width: int) -> Array:
        """Shift a solution by a step, with the last step repeated."""
        if not self._shift or len(values) == 0:
            return values
        return np.concatenate([values[width:], values[-width:]])

    def _get_solver(self, speed: float) -> tuple[_QuadraticProgram, Any]:
        """Get the program of a speed of `SPEEDS` and its solver, set up at its first use."""
        if speed not in self._ready_for:
            from scipy.sparse import csc_matrix  # slow to load

            design = self.prediction, self.horizon, self.authority
            program, solver = _condense_program(self.nominal, speed, *design), self._osqp.OSQP()
            P, A = csc_matrix(np.triu(program.P)), csc_matrix(program.A)
            gradient, limits = np.zeros(len(program.P)), (-np.ones(self._rows), np.ones(self._rows))
            solver.setup(P, gradient, A, *limits, max_iter=self.iterations, **_SETTINGS)
            self._ready_for[speed] = program, solver
        return self._ready_for[speed]
