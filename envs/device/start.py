"""Tick 0 on tensors: what `reset_vehicle` delivers, computed from where the cars start."""

from ..backend.arrays import read
from ..backend.on_torch import on_tensors, torch
from ..backend.random import CHANNELS, normals
from ..engine.layout import IN_SLOW, Drive, P
from ..engine.reset import first_row
from ..engine.step import fixed_of
from ..record import FAST
from ..scenarios.driver import wanted_angle
from ..sensors.inertial import Chance
from ..sensors.slow import first_drift
from ..task.reference import reference
from ..ticks import NEVER
from ..vehicle.dynamics import Motion, sideslip_angle
from .step import Outcome, State, Step
from .ticks import Shown, start_of

Tensor = torch.Tensor


class Start:
    """Tick 0 of the rows of a step, so that its gradients reach motion and parameters.

    sensors: the slow ones present. Where a driver follows a path, it stays where the reset laid it.
    """

    def __init__(self, step: Step, sensors: tuple[int, ...]) -> None:
        self._step, self._sensors = step, sensors
        self._fixed_of, self._read, self._normals, self._first_drift = on_tensors(
            step.dtype, fixed_of, read, normals, first_drift
        )
        self._wanted_angle, self._first_row, self._reference, self._sideslip_angle = on_tensors(
            step.dtype, wanted_angle, first_row, reference, sideslip_angle
        )

    def __call__(self, p: Tensor, keys: Tensor, state: State) -> tuple[State, Outcome]:
        """(the state, its outcome) from a state that a reset left; arguments as in `Step`."""
        kind, fixed, zero = self._step.kind, self._fixed_of(p), torch.zeros_like(state.tick)
        motion, steer = Motion(*state.motion.unbind(0)), state.driver
        if kind.follows:
            road, target, stop = fixed.road, fixed.target, fixed.task.stop
            steer = self._wanted_angle(motion, fixed.path, road, target, fixed.person, stop)
        drive = torch.stack(Drive(*state.drive.unbind(0))._replace(delta_f=steer))
        n = [self._normals(keys[0], keys[1], 0, c) for c in (CHANNELS.inertial, CHANNELS.wheels)]
        row = self._first_row(
            motion, steer, fixed.road, fixed.car.d_f, fixed.noise, Chance(*n), kind.small_angle
        )
        row = [zero + each for each in row]
        v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
        refs = torch.stack(self._reference(steer, v, fixed.target, kind.reference))
        everybody = torch.ones_like(state.over)
        beta = self._sideslip_angle(motion.v_x, motion.v_y, kind.small_angle)
        shown = Shown(beta, refs[0], refs[1], steer, zero)
        now = start_of(state.motion, drive, steer, refs, state.lead, state.tick, everybody)
        nothing = torch.full_like(state.queue, NEVER)
        before = state._replace(
            tick=state.tick - 1.0, slow=self._unused(p, keys, state.slow), queue=nothing
        )
        rows = torch.stack(row).expand(self._step.n, -1, -1)
        now = now._replace(shown=shown)
        begun: tuple[State, Outcome] = self._step.conclude(
            p, keys, before, now, rows, state.motion[None], everybody, ~everybody
        )
        return begun

    def _unused(self, p: Tensor, keys: Tensor, slow: Tensor) -> Tensor:
        """The slow sensors before tick 0, from how they are after it."""
        sensors = list(slow.unbind(0))
        for i in self._sensors:
            after, sky = sensors[i], self._read(p, P.sky)
            period = self._read(p, P.slow[i]).period
            before = list(torch.zeros_like(after).unbind(0))
            taken = after[IN_SLOW.frames] * period
            before[IN_SLOW.next_capture] = after[IN_SLOW.next_capture] - taken
            before[IN_SLOW.captured] = before[IN_SLOW.captured] + NEVER
            before[IN_SLOW.drift] = before[IN_SLOW.drift] + self._first_drift(i, sky, *keys)
            sensors[i] = torch.stack(before)
        return torch.stack(sensors)
