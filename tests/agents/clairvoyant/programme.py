"""The best plan on the linear plant, found another way: one quadratic programme, solved by OSQP.

On the small-angle plant with linear tyres at a held speed the env's own tick is affine and its
cost quadratic, so that expanding them at zero loses nothing but the cap of the cost rate.
"""

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import osqp
from scipy import sparse

from sideslip.agents.clairvoyant.forecast import (
    Forecast,
    PlanParams,
    PlanState,
    PreviewStep,
    _advance,
    _compute_node_cost,
    _compute_node_errors,
    _get_state_scales,
    _list_active_states,
)

Array = npt.NDArray[np.float64]

_OPTIONS = {
    "verbose": False, "eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 100_000, "polishing": True,
    "scaled_termination": True,
}  # fmt: skip


@dataclass(frozen=True)
class Programme:
    """min z' P z / 2 + q' z + constant, low <= A z <= high.

    z holds (x_k, u_k) for every period and the last x; the rows of A are the start, the periods'
    equations and the limits of the actions.
    """

    P: sparse.csc_matrix
    q: Array
    constant: float
    A: sparse.csc_matrix
    low: Array
    high: Array
    size: int  # of x
    width: int  # of u

    def actions(self, z: Array) -> Array:
        """(K, width) of a solution."""
        return z[: -self.size].reshape(-1, self.size + self.width)[:, self.size :]


@functools.lru_cache(maxsize=8)
def _expansion(fixed: PlanParams, steps: int, v_x: float) -> tuple[Any, Any]:
    """Two functions of `PreviewStep`: of a period, and of the episode's end.

    They return (next state, its slope, cost, its gradient, its Hessian) at zero, and (cost,
    gradient, Hessian).
    """
    names = tuple(name for name in _list_active_states(fixed) if name not in ("v_x", "integral"))
    scale, size = _get_state_scales(fixed, names), len(names)
    w = ca.SX.sym("w", size + fixed.width)
    known = ca.SX.sym("known", len(PreviewStep._fields), steps)
    rest = PlanState(*(0.0,) * len(PlanState._fields))._replace(v_x=v_x)
    x = rest._replace(**{name: scale[i] * w[i] for i, name in enumerate(names)})
    first, cost = x, ca.SX(0.0)
    for j in range(steps):
        here = PreviewStep(*ca.vertsplit(known[:, j]))
        state, effort = _advance(fixed, x, ca.vertsplit(w[size:]), here)
        cost += _compute_node_cost(fixed, _compute_node_errors(fixed, x, here), here) + effort
        x = rest._replace(**{name: getattr(state, name) for name in names})
    after = ca.vertcat(*(getattr(x, name) for name in names)) / scale
    H, g = ca.hessian(cost, w)
    zero = ca.DM.zeros(w.shape)
    slope = ca.jacobian(after, w)
    inside = ca.Function("inside", [w, known], [after, slope, cost, g, H])
    here = PreviewStep(*ca.vertsplit(known[:, 0]))
    last = _compute_node_cost(fixed, _compute_node_errors(fixed, first, here), here)
    H, g = ca.hessian(last, w)
    end = ca.Function("end", [w, known], [last, g, H])

    def at_zero(function: Any) -> Any:
        return lambda known: [value.full() for value in function(zero, known)]

    return at_zero(inside), at_zero(end)


def programme_of(forecast: Forecast, steps: int) -> Programme:
    """The programme of an episode whose forecast goes tick by tick; steps: in a control period."""
    fixed, start = forecast.fixed, forecast.start
    if fixed.ticks != 1:
        raise ValueError(f"the linear plan is made of ticks, got steps of {fixed.ticks}")
    names = tuple(name for name in _list_active_states(fixed) if name not in ("v_x", "integral"))
    size, K = len(names), fixed.periods // steps
    inside, end = _expansion(fixed, steps, start.v_x)
    known = forecast.known[:, :-1].reshape(len(PreviewStep._fields), K, steps)
    n = size + fixed.width
    q, constant, offsets = np.zeros(K * n + size), 0.0, np.empty((K, size))
    for k in range(K):
        after, slope, cost, g, H = inside(known[:, k])
        offsets[k], q[k * n : (k + 1) * n] = after.ravel(), g.ravel()
        constant += cost.item()
    last = np.tile(forecast.known[:, -1:], (1, steps))
    cost, g, H_end = end(last)
    q[K * n :], constant = g.ravel()[:size], constant + cost.item()
    blocks = [sparse.csc_matrix(H)] * K
    P = sparse.block_diag([*blocks, H_end[:size, :size]], format="csc")
    x_0 = np.array([getattr(start, name) for name in names]) / _get_state_scales(fixed, names)
    ahead = sparse.kron(sparse.eye(K, K), slope, format="csc")
    forward = sparse.hstack([ahead, sparse.csc_matrix((K * size, size))])
    pick_x = sparse.hstack([sparse.eye(size), sparse.csc_matrix((size, fixed.width))])
    at_x = sparse.block_diag([sparse.kron(sparse.eye(K), pick_x), sparse.eye(size)], format="csc")
    pick_u = sparse.hstack([sparse.csc_matrix((fixed.width, size)), sparse.eye(fixed.width)])
    at_u = sparse.hstack(
        [sparse.kron(sparse.eye(K), pick_u), sparse.csc_matrix((K * fixed.width, size))]
    )
    dynamics = forward - at_x[size:]
    A = sparse.vstack([at_x[:size], dynamics, at_u], format="csc")
    equal, most = np.concatenate([x_0, -offsets.ravel()]), np.ones(K * fixed.width)
    return Programme(P, q, constant, A, np.r_[equal, -most], np.r_[equal, most], size, fixed.width)


def solve_linear(forecast: Forecast, steps: int) -> tuple[Array, float, str]:
    """(actions (K, 1), the least cost without the cap, OSQP's status)."""
    made = programme_of(forecast, steps)
    solver = osqp.OSQP()
    solver.setup(sparse.triu(made.P, format="csc"), made.q, made.A, made.low, made.high, **_OPTIONS)
    found = solver.solve(raise_error=False)
    actions = np.clip(made.actions(np.asarray(found.x, np.float64)), -1.0, 1.0)
    return actions, float(found.info.obj_val) + made.constant, str(found.info.status)
