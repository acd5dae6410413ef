"""The ticks of an env-step on tensors: `integrate_tick` for all cars, each frozen at its end.

Nothing branches on values, so the device never waits for the host.
"""

from typing import Any, NamedTuple

from ..engine.layout import ActuatorState, P
from ..engine.step import make_step_params
from ..engine.tick import StepState, StepVariant, apply_tyre_change, integrate_tick
from ..engine.window import compute_tick_cost
from ..numerics.functions import CHANNELS, draw_normals
from ..numerics.primitives import Scalar, select
from ..numerics.torch_backend import compile_method, to_torch, torch
from ..scenarios.road import NominalMotion
from ..scenarios.steering import compute_steering
from ..sensors.inertial import NormalDraws
from ..task import RUNNING, select_failure
from ..ticks import TICK
from ..vehicle.dynamics import Motion

Tensor = torch.Tensor
Numbers = tuple[Tensor, ...]


class InfoValues(NamedTuple):
    """Numbers of `info` from the last tick of a car; (N,) each."""

    beta: Scalar  # rad
    beta_ref: Scalar  # rad
    gamma_ref: Scalar  # rad/s
    steer: Scalar  # rad, front wheels
    moment: Scalar  # N m, yaw moment of both motors


class TickState(NamedTuple):
    """State of the cars within an env-step; (N,) each, or tuples of such."""

    alive: Tensor  # not frozen yet
    motion: Numbers
    drive: Numbers
    driver: Tensor
    refs: Numbers
    nominal_motion: Numbers
    tick: Tensor
    failure: Tensor  # places in `FAILURES`, as floats
    cost: Tensor  # of the ticks of this step
    shown: Numbers  # `InfoValues`
    row: Numbers  # the newest fast row
    track: Numbers  # the newest motion, fit for `info` or not


class Ticks:
    """Ticks of cars.

    Args:
        kind: Variant of the ticks.
        dtype: Type of floats.
        compile: Whether a tick and the window go through `torch.compile`.
    """

    def __init__(self, kind: StepVariant, dtype: torch.dtype, compile: bool) -> None:
        self.kind = kind
        self._draw_normals, self._compute_steering = to_torch(dtype, draw_normals, compute_steering)
        self._make_step_params, self._integrate_tick, self._apply_tyre_change = to_torch(
            dtype, make_step_params, integrate_tick, apply_tyre_change
        )
        self._select_failure, self._select = to_torch(dtype, select_failure, select)
        (self._compute_tick_cost,) = to_torch(dtype, compute_tick_cost)
        self._dtype = dtype
        self.tick: Any = compile_method(self._step_tick) if compile else self._step_tick
        self.precompute_window: Any = (
            compile_method(self._precompute_window) if compile else self._precompute_window
        )

    def _precompute_window(
        self, p: Tensor, keys: Tensor, first: Tensor, n: int
    ) -> tuple[Numbers, Any]:
        """Compute (eight normal numbers, profile's steering) of n ticks from `first` on, (n, N)."""
        ticks = first + torch.arange(n, device=first.device)[:, None]
        tick_numbers = ticks.to(torch.int64)
        inertial = self._draw_normals(keys[0], keys[1], tick_numbers, CHANNELS.inertial)
        wheels = self._draw_normals(keys[0], keys[1], tick_numbers, CHANNELS.wheels)
        if self.kind.has_driver:
            return inertial + wheels, None
        profile = p[P.steering_profile[0] :]
        return inertial + wheels, self._compute_steering(ticks.to(self._dtype), profile)

    def _step_tick(
        self, p: Tensor, yaw_share: Tensor, steer_share: Tensor, tick_state: TickState,
        draws: Numbers, next_steer: Any,
    ) -> TickState:  # fmt: skip
        """Step the cars that are alive by a tick; p is (PARAMS_WIDTH, N), the shares (N,)."""
        pick = self._select
        params = self._make_step_params(p)
        task = params.task
        car = self._apply_tyre_change(
            params.car, params.tyre_change, tick_state.tick > params.tyre_change.tick
        )
        motion, drive = Motion(*tick_state.motion), ActuatorState(*tick_state.drive)
        nominal_motion = NominalMotion(*tick_state.nominal_motion)
        # the load at the tick's start is None: on tensors `any_lane` holds, and it is computed anew
        state = StepState(
            motion, drive, None, tick_state.driver, car, tick_state.refs, nominal_motion
        )
        next_state, measured = self._integrate_tick(
            params, yaw_share * task.yaw_scale, steer_share * task.authority, state,
            tick_state.tick, NormalDraws(draws[:4], draws[4:]), next_steer, self.kind,
        )  # fmt: skip
        alive, is_fit = tick_state.alive, tick_state.alive & ~measured.lost
        tick = tick_state.tick + alive
        tick_cost = self._compute_tick_cost(
            next_state.motion, measured.cost_inputs, task, params.path, self.kind
        )
        failure = self._select_failure(measured.lost, tick_cost.spun, tick_cost.off)
        refs = [pick(measured.lost, 0.0, ref) for ref in measured.refs]
        beta = pick(measured.lost, 0.0, tick_cost.beta)
        info_values = (beta, *refs, measured.steer, measured.moment)

        def select_cars(where: Tensor, new: Any, old: Any) -> Numbers:
            return tuple(pick(where, a, b) for a, b in zip(new, old, strict=True))

        return TickState(
            alive & (failure == RUNNING) & (tick < task.duration),
            select_cars(is_fit, next_state.motion, tick_state.motion),
            select_cars(alive, next_state.drive, tick_state.drive),
            pick(alive, next_state.driver, tick_state.driver),
            select_cars(alive, refs, tick_state.refs),
            select_cars(alive, next_state.nominal_motion, tick_state.nominal_motion),
            tick,
            pick(alive, failure, tick_state.failure),
            tick_state.cost + pick(alive, tick_cost.cost * TICK, 0.0),
            select_cars(alive, info_values, tick_state.shown),
            select_cars(alive, measured.row, tick_state.row),
            select_cars(alive, next_state.motion, tick_state.track),
        )

    def integrate_step(
        self, p: Tensor, keys: Tensor, start: TickState, yaw_share: Tensor, steer_share: Tensor,
        n: int,
    ) -> tuple[TickState, Tensor, Tensor]:  # fmt: skip
        """Integrate ticks, fewer for cars that fail or end, whose last values are repeated.

        Args:
            p: Packed parameters, shape (PARAMS_WIDTH, N).
            keys: Keys of the episodes, int64, shape (2, N).
            start: State at the start.
            yaw_share: Yaw moment as a fraction of full scale, shape (N,).
            steer_share: Added steering as a fraction of full scale, shape (N,).
            n: Number of ticks.

        Returns:
            The state, and the fast rows and motions of all ticks, (n, width, N) each.
        """
        all_draws, steering = self.precompute_window(p, keys, start.tick + 1, n)
        tick_state, rows, track = start, [], []
        for j in range(n):
            draws = tuple(normals[j] for normals in all_draws)
            angle = None if steering is None else steering[j]
            tick_state = self.tick(p, yaw_share, steer_share, tick_state, draws, angle)
            rows.append(torch.stack(tick_state.row))
            track.append(torch.stack(tick_state.track))
        return tick_state, torch.stack(rows), torch.stack(track)
