"""Env-steps of all cars on tensors, pure functions that never wait for the device; and tick 0."""

from typing import Any, NamedTuple

from ..engine.layout import SLOW_STATE, ActuatorState, P, Switches
from ..engine.reset import compute_first_row
from ..engine.step import make_step_params
from ..engine.tick import StepVariant
from ..numerics.functions import CHANNELS, clip, draw_normals
from ..numerics.packed import read
from ..numerics.primitives import select
from ..numerics.torch_backend import compile_method, to_torch, torch
from ..record import FAST, Array
from ..scenarios.driver import compute_target_angle
from ..sensors.inertial import NormalDraws
from ..sensors.slow import draw_first_drift
from ..task import BAD_ACTION, NOT_FINITE, REPORT, RUNNING, compute_reference
from ..ticks import NEVER
from ..vehicle.dynamics import Motion, compute_sideslip_angle
from .gradients import GradientGate
from .torch_outputs import Observer, PacketCapacity, SlowSensors, SlowState, TickWindow
from .torch_ticks import InfoValues, Ticks, TickState, make_tick_state

Tensor = torch.Tensor


class TorchState(NamedTuple):
    """State of the cars that an env-step changes; the cars (N) are the last axis."""

    motion: Tensor  # (len(Motion), N)
    drive: Tensor  # (len(ActuatorState), N)
    driver: Tensor  # rad, the driver's steering command, (N,)
    refs: Tensor  # rad, rad/s, references of beta and gamma, (2, N)
    nominal_motion: Tensor  # (len(NominalMotion), N)
    tick: Tensor  # ticks since the start, as floats, (N,)
    failure: Tensor  # places in `FAILURES`, as floats, (N,)
    slow: Tensor  # `SlowState.slow`, (sensors, SLOW_WIDTH, N)
    queue: Tensor  # `SlowState.queue`, (capacity, PACKET_WIDTH, N)
    over: Tensor  # whether the episode has ended, bool, (N,)
    report: Tensor  # (len(StepReport), N)

    @property
    def slow_state(self) -> SlowState:
        """The slow sensors' part."""
        return SlowState(self.slow, self.queue)


class StepOutcome(NamedTuple):
    """Outcome of an env-step."""

    obs: Tensor  # (N, k); zeros where the car had no tick
    rewards: Tensor  # (N,)
    terminated: Tensor  # bool, (N,)
    truncated: Tensor  # bool, (N,)
    refused: Tensor  # whether a running car got an action that is not finite, bool, (N,)
    rows: Tensor  # fast sensors of each tick, (n, FAST_WIDTH, N)
    packets: Tensor  # (max, PACKET_WIDTH, N)
    done: Tensor  # ticks of the step that count, int64, (N,)
    delivered: Tensor  # packets that count, int64, (N,)


class TorchStep:
    """Env-steps of cars of one variant.

    Args:
        kind: Variant of the ticks.
        n: Ticks of an env-step.
        capacities: Capacity of each slow sensor present, by index.
        switches: Switches of the plant and the task.
        bounds: Bounds of the observation's entries, shape (2, k).
        dtype: Type of floats.
        obs_dtype: Type of observations.
        device: Device.
        compile: Whether `torch.compile` is used.
    """

    def __init__(
        self, kind: StepVariant, n: int, capacities: dict[int, PacketCapacity], switches: Switches,
        bounds: Array, dtype: torch.dtype, obs_dtype: torch.dtype, device: torch.device,
        compile: bool,
    ) -> None:  # fmt: skip
        self.kind, self.n, self.dtype = kind, n, dtype
        self._ticks = Ticks(kind, dtype, compile)
        self._slow = SlowSensors(capacities, kind.small_angle, dtype)
        limits = torch.as_tensor(bounds, dtype=dtype, device=device)
        self._observer = Observer(tuple(capacities), switches, limits, dtype, obs_dtype)
        self._clip, self._select = to_torch(dtype, clip, select)
        self.finish_step: Any = compile_method(self._finish_step) if compile else self._finish_step

    def __call__(
        self, p: Tensor, keys: Tensor, state: TorchState, actions: Tensor
    ) -> tuple[TorchState, StepOutcome]:
        """Step all cars; those that are over stand still, those with a non-finite action fail.

        p is (PARAMS_WIDTH, N), keys (2, N) int64, actions (N, width) of the floats of p.
        """
        is_finite = torch.isfinite(actions).all(1)
        gate = GradientGate()  # its hooks run in the backward pass, after `open` is set below
        p, state = gate(p), TorchState(*map(gate, state))
        shares = self._clip(torch.where(is_finite[:, None], actions, 0.0), -1.0, 1.0)
        yaw_share, *steer_shares = map(gate, shares.unbind(1))
        steer_share = steer_shares[0] if steer_shares else torch.zeros_like(state.tick)
        running = is_finite & ~state.over
        start = make_tick_state(*state[:6], running)  # the fields from motion to tick
        tick_state, rows, track = self._ticks.integrate_step(
            p, keys, start, yaw_share, steer_share, self.n
        )
        is_refused = ~is_finite & ~state.over
        next_state: TorchState
        next_state, outcome = self.finish_step(
            p, keys, state, tick_state, rows, track, running, is_refused
        )
        gate.open = next_state.failure != NOT_FINITE
        return next_state, outcome

    def _finish_step(
        self, p: Tensor, keys: Tensor, state: TorchState, tick_state: TickState, rows: Tensor,
        track: Tensor, running: Tensor, refused: Tensor,
    ) -> tuple[TorchState, StepOutcome]:  # fmt: skip
        """Do slow sensors, observation and report of a step whose ticks are integrated."""
        done, duration = tick_state.tick - state.tick, p[P.task.duration]
        window = TickWindow(state.tick, tick_state.tick, running, track)
        slow_state, delivered = self._slow(p, keys, state.slow_state, window)
        obs = self._observer.observe(rows, done, tick_state, slow_state.slow, delivered)
        obs = torch.where(running[:, None], obs, 0.0)
        report = self._observer.report(tick_state, duration, delivered.number)
        report = torch.where(running, report, state.report)
        refusal = self._observer.report_refusal(tick_state, duration, state.report)
        report = torch.where(refused, refusal, report)
        failure = self._select(running, tick_state.failure, state.failure)
        failure = self._select(refused, BAD_ACTION * 1.0, failure)
        stepped = ~state.over
        terminated = stepped & (failure != RUNNING)
        truncated = running & (report[REPORT.ended] == 1.0) & ~terminated
        next_state = TorchState(
            torch.stack(tick_state.motion), torch.stack(tick_state.drive), tick_state.driver,
            torch.stack(tick_state.refs), torch.stack(tick_state.nominal_motion), tick_state.tick,
            failure, *slow_state, terminated | truncated, report,
        )  # fmt: skip
        rewards = torch.where(stepped, -report[REPORT.cost], 0.0)
        return next_state, StepOutcome(
            obs, rewards, terminated, truncated, refused, rows, delivered.packets,
            done.to(torch.int64), delivered.number,
        )  # fmt: skip


class TorchReset:
    """Tick 0 on tensors as `reset_vehicle` makes it, with gradients to motion and parameters.

    A path that a driver follows stays where the reset put it. `sensors` are the indices of the slow
    sensors present.
    """

    def __init__(self, step: TorchStep, sensors: tuple[int, ...]) -> None:
        self._step, self._sensors = step, sensors
        self._make_step_params, self._read, self._draw_normals, self._draw_first_drift = to_torch(
            step.dtype, make_step_params, read, draw_normals, draw_first_drift
        )
        (
            self._compute_target_angle, self._compute_first_row, self._compute_reference,
            self._compute_sideslip_angle,
        ) = to_torch(
            step.dtype, compute_target_angle, compute_first_row, compute_reference,
            compute_sideslip_angle,
        )  # fmt: skip

    def __call__(
        self, p: Tensor, keys: Tensor, state: TorchState
    ) -> tuple[TorchState, StepOutcome]:
        """Compute (state, outcome) at tick 0 from the state that a reset left."""
        kind, params = self._step.kind, self._make_step_params(p)
        zero = torch.zeros_like(state.tick)
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
            motion, steer, params.road, params.car.d_f, params.noise, NormalDraws(*n),
            kind.small_angle,
        )  # fmt: skip
        row = [zero + number for number in row]
        v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
        refs = torch.stack(self._compute_reference(steer, v, params.target, kind.reference))
        all_cars = torch.ones_like(state.over)
        beta = self._compute_sideslip_angle(motion.v_x, motion.v_y, kind.small_angle)
        info_values = InfoValues(beta, refs[0], refs[1], steer, zero)
        tick_state = make_tick_state(
            state.motion, drive, steer, refs, state.nominal_motion, state.tick, all_cars
        )
        empty_queue = torch.full_like(state.queue, NEVER)
        # as if a step of one tick had led here from tick -1: its window holds tick 0 alone
        previous = state._replace(
            tick=state.tick - 1.0, slow=self._rewind_sensors(p, keys, state.slow), queue=empty_queue
        )
        rows = torch.stack(row).expand(self._step.n, -1, -1)  # tick 0 stands for every sample
        tick_state = tick_state._replace(shown=info_values)
        result: tuple[TorchState, StepOutcome] = self._step.finish_step(
            p, keys, previous, tick_state, rows, state.motion[None], all_cars, ~all_cars
        )
        return result

    def _rewind_sensors(self, p: Tensor, keys: Tensor, slow: Tensor) -> Tensor:
        """Compute the slow sensors' state before tick 0 from that after it."""
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
