"""Tick 0 on tensors: what `reset_vehicle` delivers, computed from where the cars start."""

from ..backend.arrays import read
from ..backend.on_torch import to_torch, torch
from ..backend.random import CHANNELS, draw_normals
from ..engine.layout import SLOW_STATE, ActuatorState, P
from ..engine.reset import compute_first_row
from ..engine.step import make_step_params
from ..record import FAST
from ..scenarios.driver import compute_target_angle
from ..sensors.inertial import NormalDraws
from ..sensors.slow import draw_first_drift
from ..task.reference import compute_reference
from ..ticks import NEVER
from ..vehicle.dynamics import Motion, compute_sideslip_angle
from .step import StepOutcome, TorchState, TorchStep
from .ticks import InfoValues, make_tick_state

Tensor = torch.Tensor


class TorchReset:
    """Tick 0 of the rows of a step, so that its gradients reach motion and parameters.

    sensors: the slow ones present. Where a driver follows a path, it stays where the reset laid it.
    """

    def __init__(self, step: TorchStep, sensors: tuple[int, ...]) -> None:
        self._step, self._sensors = step, sensors
        self._make_step_params, self._read, self._draw_normals, self._draw_first_drift = to_torch(
            step.dtype, make_step_params, read, draw_normals, draw_first_drift
        )
        (
            self._compute_target_angle,
            self._compute_first_row,
            self._compute_reference,
            self._compute_sideslip_angle,
        ) = to_torch(
            step.dtype,
            compute_target_angle,
            compute_first_row,
            compute_reference,
            compute_sideslip_angle,
        )

    def __call__(
        self, p: Tensor, keys: Tensor, state: TorchState
    ) -> tuple[TorchState, StepOutcome]:
        """(the state, its outcome) from a state that a reset left; arguments as in `TorchStep`."""
        kind, params, zero = (
            self._step.kind,
            self._make_step_params(p),
            torch.zeros_like(state.tick),
        )
        motion, steer = Motion(*state.motion.unbind(0)), state.driver
        if kind.has_driver:
            road, target, stop = params.road, params.target, params.task.stop
            steer = self._compute_target_angle(
                motion, params.path, road, target, params.driver, stop
            )
        drive = torch.stack(ActuatorState(*state.drive.unbind(0))._replace(delta_f=steer))
        n = [
            self._draw_normals(keys[0], keys[1], 0, c) for c in (CHANNELS.inertial, CHANNELS.wheels)
        ]
        row = self._compute_first_row(
            motion,
            steer,
            params.road,
            params.car.d_f,
            params.noise,
            NormalDraws(*n),
            kind.small_angle,
        )
        row = [zero + number for number in row]
        v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
        refs = torch.stack(self._compute_reference(steer, v, params.target, kind.reference))
        all_rows = torch.ones_like(state.over)
        beta = self._compute_sideslip_angle(motion.v_x, motion.v_y, kind.small_angle)
        info_values = InfoValues(beta, refs[0], refs[1], steer, zero)
        tick_state = make_tick_state(
            state.motion, drive, steer, refs, state.nominal_motion, state.tick, all_rows
        )
        empty_queue = torch.full_like(state.queue, NEVER)
        previous = state._replace(
            tick=state.tick - 1.0, slow=self._rewind_sensors(p, keys, state.slow), queue=empty_queue
        )
        rows = torch.stack(row).expand(self._step.n, -1, -1)
        tick_state = tick_state._replace(shown=info_values)
        result: tuple[TorchState, StepOutcome] = self._step.finish_step(
            p, keys, previous, tick_state, rows, state.motion[None], all_rows, ~all_rows
        )
        return result

    def _rewind_sensors(self, p: Tensor, keys: Tensor, slow: Tensor) -> Tensor:
        """The slow sensors before tick 0, from how they are after it."""
        sensors = list(slow.unbind(0))
        for i in self._sensors:
            after, sky = sensors[i], self._read(p, P.sky)
            period = self._read(p, P.slow[i]).period
            before = list(torch.zeros_like(after).unbind(0))
            elapsed = after[SLOW_STATE.frames] * period
            before[SLOW_STATE.next_capture] = after[SLOW_STATE.next_capture] - elapsed
            before[SLOW_STATE.captured] = before[SLOW_STATE.captured] + NEVER
            before[SLOW_STATE.drift] = before[SLOW_STATE.drift] + self._draw_first_drift(
                i, sky, *keys
            )
            sensors[i] = torch.stack(before)
        return torch.stack(sensors)
