"""The plant on CasADi's symbols: one step of a plan, and its cost."""

from typing import Any, NamedTuple

import casadi as ca

from ...envs.engine.tick import compute_lagged_load, compute_motor_torques
from ...envs.numerics.casadi_backend import SYMBOLS, to_casadi
from ...envs.numerics.jit import as_python
from ...envs.numerics.primitives import Scalar
from ...envs.scenarios.road import NOMINAL_PATH
from ...envs.task import LAGGED, compute_cost_rate, compute_reference
from ...envs.ticks import TICK
from ...envs.vehicle.actuators import apply_lag, compute_yaw_moment
from ...envs.vehicle.dynamics import DisturbanceForces, Motion, compute_sideslip_angle, rk4
from .preview import PlanParams, PlanState, PreviewStep

_rk4, _load_at = to_casadi(rk4), to_casadi(compute_lagged_load)
_motor_torques, _sideslip = to_casadi(compute_motor_torques), to_casadi(compute_sideslip_angle)
_apply_lag, _yaw_moment = to_casadi(apply_lag), to_casadi(compute_yaw_moment)
_reference = to_casadi(compute_reference)
# compute_cost_rate as a plain sum of squares, smooth for the solver: its cap and its `absolute`,
# whose slope is undefined at zero, are identities here
_uncapped_cost_rate = as_python(
    compute_cost_rate, SYMBOLS | {"minimum": lambda rate, cap: rate, "absolute": lambda rate: rate}
)

_TORQUES = ("T_l", "T_r")


class _PlanStep(NamedTuple):
    """The end of one step of the plan."""

    state: PlanState
    effort: Any  # cost of the yaw moment and the added steering within the step
    slewed: Scalar  # change of the added steering's command (rad)


def list_active_states(fixed: PlanParams) -> tuple[str, ...]:
    """List the states that matter to an episode's cost, in the order of `PlanState`.

    Args:
        fixed: Parameters of the episode.

    Returns:
        Names of the states.
    """
    road = fixed.road
    active = {"v_x", "v_y", "gamma", *_TORQUES}
    if fixed.kind.roll:
        active |= {"phi", "phi_dot"}
    if fixed.speed_profile.hold and fixed.speed_profile.k_i:
        active |= {"integral"}
    if fixed.width > 1:
        active |= {"slewing", "added"}
    if road.curvature or road.lateral or road.longitudinal:
        active |= {"psi", "s", "y", "theta"}
    return tuple(name for name in PlanState._fields if name in active)


def compute_node_errors(fixed: PlanParams, x: PlanState, known: PreviewStep) -> tuple[Any, Any]:
    """Compute the errors of sideslip angle (rad) and yaw rate (rad/s) at a step's start.

    Args:
        fixed: Parameters of the episode.
        x: State at the step's start.
        known: Inputs of the step.

    Returns:
        Errors e_beta (rad) and e_gamma (rad/s).
    """
    kind = fixed.kind
    beta = _sideslip(x.v_x, x.v_y, kind.small_angle)
    beta_ref, gamma_ref = known.beta_ref, known.gamma_ref
    if kind.reference != LAGGED:
        beta_ref, gamma_ref = _reference(known.command, x.v_x, fixed.target, kind.reference)
    return beta - beta_ref, x.gamma - gamma_ref


def compute_node_cost(fixed: PlanParams, errors: tuple[Any, Any], known: PreviewStep) -> Any:
    """Compute the cost of the errors at a step's start, by its weight and without the cap.

    Args:
        fixed: Parameters of the episode.
        errors: e_beta (rad) and e_gamma (rad/s).
        known: Inputs of the step.

    Returns:
        Weighted cost.
    """
    return known.weight * _uncapped_cost_rate(*errors, 0.0, 0.0, fixed.kind.reference)


def advance(fixed: PlanParams, x: PlanState, action: Any, known: PreviewStep) -> _PlanStep:
    """Advance a plan by one Runge-Kutta step of the env's own plant over `fixed.ticks` ticks.

    The driver's acceleration is that of the step's start; added steering acts by its mean.

    Args:
        fixed: Parameters of the episode.
        x: State at the step's start.
        action: Fractions of full scale, shape (width,), as the env takes them.
        known: Inputs of the step.

    Returns:
        Next state, cost of the effort, and change of the added steering (rad).
    """
    car = fixed.car._replace(C_f=known.C_f, C_r=known.C_r, mu=known.mu, mu_r=known.mu_r)
    task, kind, q = fixed.task, fixed.kind, fixed.ticks
    speed_profile = fixed.speed_profile._replace(speed=known.speed, acceleration=known.acceleration)
    held = x.v_x, x.integral, speed_profile, car, task.yaw_first
    T_l, T_r, _, integral = _motor_torques(action[0] * task.yaw_scale, 0.0, *held)
    slewing = action[1] * task.authority if fixed.width > 1 else 0.0
    moved = slewing - x.slewing if fixed.width > 1 else 0.0
    # The command (rad) moves at `slew` (rad a tick) and then rests. Its mean over q ticks is
    # command - moved |moved| / (2 q slew), for |moved| <= q slew.
    mean_added = slewing - moved * ca.fabs(moved) / (2.0 * q * task.slew)
    motor, steering, road = fixed.motor, fixed.steering, fixed.road
    if kind.road == NOMINAL_PATH:
        road = road._replace(turn=known.turn)
    loads = tuple(
        _load_at(angle + _apply_lag(mean_added, x.added, rest), T_l, T_r, x, motor_rest, car, kind)
        for angle, rest, motor_rest in (
            (known.steer_start, steering.start, motor.start),
            (known.steer_middle, steering.middle, motor.middle),
            (known.steer_end, steering.end, motor.end),
        )
    )
    start, forces = (
        Motion(*x[: len(Motion._fields)]),
        DisturbanceForces(known.F_d, known.N_d, known.N_x),
    )
    variant = kind.small_angle, kind.law, kind.roll
    motion = _rk4(start, loads, forces, car, road, q * TICK, *variant)
    effort = 0.0
    for tick in range(q):
        motor_tick, steering_tick = fixed.motor_tick, fixed.steering_tick
        rest = motor_tick.mean * motor_tick.end**tick
        moment = _yaw_moment(_apply_lag(T_l, x.T_l, rest), _apply_lag(T_r, x.T_r, rest), car)
        added = _apply_lag(mean_added, x.added, steering_tick.mean * steering_tick.end**tick)
        share = moment / task.yaw_scale
        effort += TICK * _uncapped_cost_rate(0.0, 0.0, share, added, kind.reference)
    torques = _apply_lag(T_l, x.T_l, motor.end), _apply_lag(T_r, x.T_r, motor.end)
    new_integral = x.integral + q * (integral - x.integral)
    new_added = _apply_lag(mean_added, x.added, steering.end)
    next_state = PlanState._make((*motion, *torques, new_integral, slewing, new_added))
    return _PlanStep(next_state, effort, moved)


def get_state_scales(fixed: PlanParams, names: tuple[str, ...]) -> list[float]:
    """Get the unit of each state in the solver, in which all are of order one.

    Args:
        fixed: Parameters of the episode.
        names: Names of states.

    Returns:
        Unit of each of `names`, in the state's own SI unit.
    """
    small = {"phi": 0.1, "phi_dot": 0.5, "slewing": 0.1, "added": 0.1}
    return [fixed.car.T_max if name in _TORQUES else small.get(name, 1.0) for name in names]
