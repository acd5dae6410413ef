"""Env-steps of all cars on tensors, pure functions that never wait for the device; and tick 0.

Each car is frozen at its end, and nothing branches on values.
"""

from typing import Any, NamedTuple

from ..engine.config import EnvConfig
from ..engine.layout import FLAGS, SLOW_STATE, ActuatorState, P
from ..engine.reset import compute_first_row
from ..engine.step import get_start_variant, make_step_params
from ..engine.tick import StepState, TickInputs, apply_tyre_change, integrate_tick
from ..engine.window import compute_tick_cost
from ..numerics.functions import CHANNELS, NEVER, TICK, clip, draw_normals
from ..numerics.packed import read
from ..numerics.primitives import Scalar, select
from ..numerics.torch_backend import GradientGate, compile_method, to_torch, torch
from ..record import FAST, FAST_WIDTH, PACKET
from ..scenarios.driver import compute_steering, compute_target_angle
from ..scenarios.road import NominalMotion
from ..sensors.inertial import ErrorState, NormalDraws
from ..sensors.slow import WIDTHS, draw_first_drift
from ..task import (
    AGE_CAP,
    BAD_ACTION,
    N_SAMPLED,
    NOT_FINITE,
    REPORT,
    RUNNING,
    StepReport,
    compute_failure_cost,
    compute_reference,
    select_failure,
)
from ..vehicle.dynamics import Motion, compute_sideslip_angle
from .torch_sensors import Capacities, Delivered, SlowSensors, SlowState, TickWindow

Tensor = torch.Tensor
Numbers = tuple[Tensor, ...]


class TorchState(NamedTuple):
    """State of the cars that an env-step changes; the cars (N) are the last axis."""

    motion: Tensor  # (len(Motion), N)
    drive: Tensor  # (len(ActuatorState), N)
    driver: Tensor  # rad, the driver's steering command, (N,)
    refs: Tensor  # rad, rad/s, references of beta and gamma, (2, N)
    nominal_motion: Tensor  # (len(NominalMotion), N)
    errors: Tensor  # (len(ErrorState), N)
    past_efforts: Tensor  # (RATE_TICKS, N)
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


_Stepped = tuple[TorchState, StepOutcome]


class _InfoValues(NamedTuple):
    """Numbers of `info` from the last tick of a car; (N,) each."""

    beta: Scalar  # rad
    beta_ref: Scalar  # rad
    gamma_ref: Scalar  # rad/s
    steer: Scalar  # rad, front wheels
    moment: Scalar  # N m, yaw moment of both motors


class _TickState(NamedTuple):
    """State of the cars within an env-step; (N,) each, or stacked in front of that axis."""

    alive: Tensor  # not frozen yet
    cars: TorchState  # whose slow sensors, end and report are still those before the step
    cost: Tensor  # of the ticks of this step
    shown: Tensor  # `_InfoValues`
    row: Tensor  # the newest fast row
    track: Tensor  # the newest motion, fit for `info` or not


class _Ticked(NamedTuple):
    """Integrated ticks of an env-step."""

    state: _TickState
    rows: Tensor  # fast rows, (n, FAST_WIDTH, N)
    track: Tensor  # motions, (n, len(Motion), N)
    running: Tensor  # whether the car was stepped, (N,)
    refused: Tensor  # whether its action was not finite, (N,)


class TorchStep:
    """Env-steps of cars of one variant.

    Args:
        config: Config of the environment.
        capacities: Capacity of each slow sensor present, by index.
        dtype: Type of floats.
        obs_dtype: Type of observations.
        device: Device of the tensors.
        compile: Whether `torch.compile` is used.
    """

    def __init__(
        self, config: EnvConfig, capacities: Capacities, dtype: torch.dtype,
        obs_dtype: torch.dtype, device: torch.device, compile: bool,
    ) -> None:  # fmt: skip
        start = config.base.start
        self.kind, self.n, self.dtype = get_start_variant(start), int(config.control_period), dtype
        self.sensors, self._obs_dtype = tuple(capacities), obs_dtype
        self._slow = SlowSensors(capacities, self.kind.small_angle, dtype)
        self._switches = read(start.switches, FLAGS)
        self._bounds = torch.as_tensor(config.bounds, dtype=dtype, device=device)[:, :, None]
        self._functions = to_torch(
            dtype, clip, select, compute_failure_cost, draw_normals, compute_steering,
            make_step_params, integrate_tick, apply_tyre_change, select_failure, compute_tick_cost,
        )  # fmt: skip
        self._select = self._functions.select
        parts: list[Any] = [self._finish_step, self._step_tick, self._precompute_window]
        if compile:
            parts = list(map(compile_method, parts))
        self.finish_step, self._tick, self._window = parts

    def __call__(self, p: Tensor, keys: Tensor, state: TorchState, actions: Tensor) -> _Stepped:
        """Step all cars; those that are over stand still, those with a non-finite action fail.

        p is (PARAMS_WIDTH, N), keys (2, N) int64, actions (N, width) of the floats of p.
        """
        is_finite = torch.isfinite(actions).all(1)
        gate = GradientGate()  # its hooks run in the backward pass, after `open` is set below
        p, state = gate(p), TorchState(*map(gate, state))
        shares = self._functions.clip(torch.where(is_finite[:, None], actions, 0.0), -1.0, 1.0)
        yaw_share, *steer_shares = map(gate, shares.unbind(1))
        steer_share = steer_shares[0] if steer_shares else torch.zeros_like(state.tick)
        running = is_finite & ~state.over
        tick_state = _make_tick_state(state, running)
        all_draws, steering = self._window(p, keys, state.tick + 1, self.n)
        rows, track = [], []
        for j in range(self.n):  # of cars that fail or end the last values are repeated
            draws = tuple(normals[j] for normals in all_draws)
            angle = None if steering is None else steering[j]
            tick_state = self._tick(p, yaw_share, steer_share, tick_state, draws, angle)
            rows.append(tick_state.row)
            track.append(tick_state.track)
        is_refused = ~is_finite & ~state.over
        ticked = _Ticked(tick_state, torch.stack(rows), torch.stack(track), running, is_refused)
        next_state: TorchState
        next_state, outcome = self.finish_step(p, keys, state, ticked)
        gate.open = next_state.failure != NOT_FINITE
        return next_state, outcome

    def _precompute_window(
        self, p: Tensor, keys: Tensor, first: Tensor, n: int
    ) -> tuple[Numbers, Any]:
        """Compute (nine normal numbers, profile's steering) of n ticks from `first` on, (n, N)."""
        draw = self._functions.draw_normals
        ticks = first + torch.arange(n, device=first.device)[:, None]
        counter = keys[0], keys[1], ticks.to(torch.int64)
        inertial, wheels = draw(*counter, CHANNELS.inertial), draw(*counter, CHANNELS.wheels)
        vibration = torch.zeros_like(inertial[0])
        if self.kind.has_errors:
            vibration = draw(*counter, CHANNELS.errors)[0]
        draws = (*inertial, *wheels, vibration)
        if self.kind.has_driver:
            return draws, None
        profile = p[P.steering_profile[0] :]
        return draws, self._functions.compute_steering(ticks.to(self.dtype), profile)

    def _step_tick(
        self, p: Tensor, yaw_share: Tensor, steer_share: Tensor, tick_state: _TickState,
        draws: Numbers, next_steer: Any,
    ) -> _TickState:  # fmt: skip
        """Step the cars that are alive by a tick; p is (PARAMS_WIDTH, N), the shares (N,)."""
        functions, pick, cars = self._functions, self._select, tick_state.cars
        start_tick = cars.tick
        params = functions.make_step_params(p)
        task, change = params.task, params.tyre_change
        # the load at the tick's start is None: on tensors `any_lane` holds, and it is computed anew
        state = StepState(
            Motion(*cars.motion), ActuatorState(*cars.drive), None, cars.driver,
            functions.apply_tyre_change(params.car, change, start_tick > change.tick),
            tuple(cars.refs), NominalMotion(*cars.nominal_motion), ErrorState(*cars.errors),
        )  # fmt: skip
        normals = NormalDraws(draws[:4], draws[4:8], draws[8])
        acts = start_tick >= task.lead_in
        N_z = pick(acts, yaw_share * task.yaw_scale, 0.0)
        added = pick(acts, steer_share * task.authority, 0.0)
        inputs = TickInputs(N_z, added, normals, next_steer, cars.past_efforts[0])
        next_state, measured = functions.integrate_tick(
            params, inputs, state, start_tick, self.kind
        )
        alive, is_fit = tick_state.alive, tick_state.alive & ~measured.lost
        tick = start_tick + alive
        tick_cost = functions.compute_tick_cost(
            next_state.motion, measured.cost_inputs, task, params.path, self.kind
        )
        failure = functions.select_failure(measured.lost, tick_cost.spun, tick_cost.off)
        refs = [pick(measured.lost, 0.0, ref) for ref in measured.refs]
        beta = pick(measured.lost, 0.0, tick_cost.beta)
        info_values = (beta, *refs, measured.steer, measured.moment)
        efforts = cars.past_efforts
        if self.kind.has_errors:
            efforts = torch.cat((efforts[1:], measured.cost_inputs.effort[None]))

        def select_cars(where: Tensor, new: Any, old: Tensor) -> Tensor:
            return torch.stack([pick(where, a, b) for a, b in zip(new, old, strict=True)])

        next_cars = cars._replace(
            motion=select_cars(is_fit, next_state.motion, cars.motion),
            drive=select_cars(alive, next_state.drive, cars.drive),
            driver=pick(alive, next_state.driver, cars.driver),
            refs=select_cars(alive, refs, cars.refs),
            nominal_motion=select_cars(alive, next_state.nominal_motion, cars.nominal_motion),
            errors=select_cars(alive, next_state.errors, cars.errors),
            past_efforts=pick(alive, efforts, cars.past_efforts),
            tick=tick, failure=pick(alive, failure, cars.failure),
        )  # fmt: skip
        return _TickState(
            alive & (failure == RUNNING) & (tick < task.duration),
            next_cars,
            tick_state.cost + pick(alive & acts, tick_cost.cost * TICK, 0.0),
            select_cars(alive, info_values, tick_state.shown),
            select_cars(alive, measured.row, tick_state.row),
            select_cars(alive, next_state.motion, tick_state.track),
        )

    def _finish_step(self, p: Tensor, keys: Tensor, state: TorchState, ticked: _Ticked) -> _Stepped:
        """Do slow sensors, observation and report of a step whose ticks are integrated."""
        tick_state, rows, track, running, refused = ticked
        cars = tick_state.cars
        done, duration = cars.tick - state.tick, p[P.task.duration]
        window = TickWindow(state.tick, cars.tick, running, track)
        slow_state, delivered = self._slow(p, keys, state.slow_state, window)
        obs = self._observe(rows, done, tick_state, slow_state.slow, delivered)
        obs = torch.where(running[:, None], obs, 0.0)
        report = self._report(tick_state, duration, delivered.number)
        report = torch.where(running, report, state.report)
        refusal = self._report_refusal(cars.tick, duration, state.report)
        report = torch.where(refused, refusal, report)
        failure = self._select(refused, BAD_ACTION * 1.0, cars.failure)
        stepped = ~state.over
        terminated = stepped & (failure != RUNNING)
        truncated = running & (report[REPORT.ended] == 1.0) & ~terminated
        slow, queue = slow_state
        next_state = cars._replace(
            failure=failure, slow=slow, queue=queue, over=terminated | truncated, report=report
        )
        rewards = torch.where(stepped, -report[REPORT.cost], 0.0)
        return next_state, StepOutcome(
            obs, rewards, terminated, truncated, refused, rows, delivered.packets,
            done.to(torch.int64), delivered.number,
        )  # fmt: skip

    def _observe(
        self, rows: Tensor, done: Tensor, tick_state: _TickState, slow: Tensor, delivered: Delivered
    ) -> Tensor:
        """Compute the observation (N, k) from the first `done` (N,) of rows (n, FAST_WIDTH, N)."""
        entries: list[Tensor] = []
        sampled = rows[:, :N_SAMPLED]
        if self._switches.all_samples:
            entries += sampled.transpose(0, 1).flatten(0, 1).unbind(0)
        else:
            total: Any = 0.0
            for j in range(len(rows)):
                total = total + self._select(j < done, sampled[j], 0.0)
            entries += torch.stack((sampled[-1], total / done), 1).flatten(0, 1).unbind(0)
        entries += rows[-1, FAST.steer : FAST.steer + 4].unbind(0)
        if self._switches.with_map:
            entries.append(rows[-1, FAST.curvature])
        for sensor in self.sensors:
            entries += self._read_sensor(sensor, tick_state.cars.tick, slow[sensor], delivered)
        info_values = _InfoValues(*tick_state.shown)
        entries += [info_values.beta_ref, info_values.gamma_ref]
        clipped: Tensor = self._functions.clip(torch.stack(entries), *self._bounds.unbind(0))
        return clipped.T.to(self._obs_dtype).contiguous()

    def _read_sensor(
        self, sensor: int, tick: Tensor, slow: Tensor, delivered: Delivered
    ) -> list[Tensor]:
        """Read values, age and freshness of one sensor's newest sample."""
        captured = slow[SLOW_STATE.captured]
        age = self._select(captured != NEVER, (tick - captured) * TICK, AGE_CAP)
        packets = delivered.packets
        place = torch.arange(len(packets), device=tick.device)[:, None]
        # the newest sample's own packet, neither an older one nor a duplicate
        is_newest = packets[:, PACKET.arrived] == slow[SLOW_STATE.arrived]
        is_fresh = (place < delivered.number) & (packets[:, PACKET.sensor] == sensor) & is_newest
        values = [slow[i] for i in SLOW_STATE.values[: WIDTHS[sensor]]]
        return [*values, age, is_fresh.any(0).to(tick.dtype)]

    def _report(self, tick_state: _TickState, duration: Tensor, count: Tensor) -> Tensor:
        """Compute the reports (len(StepReport), N) of cars that were stepped."""
        cars, shown = tick_state.cars, _InfoValues(*tick_state.shown)
        failure_cost = self._functions.compute_failure_cost(duration, cars.tick)
        cost = tick_state.cost + self._select(cars.failure != RUNNING, failure_cost, 0.0)
        values = {
            "t": cars.tick * TICK, "beta": shown.beta, "gamma": cars.motion[2],
            "psi": cars.motion[3], "beta_ref": shown.beta_ref, "gamma_ref": shown.gamma_ref,
            "steer": shown.steer, "yaw_moment": shown.moment, "cost": cost, "failure": cars.failure,
            "packets": count.to(cost.dtype), "reward": -cost,
            "ended": (cars.tick >= duration).to(cost.dtype),
        }  # fmt: skip
        return torch.stack([values[name] for name in StepReport._fields])

    def _report_refusal(self, tick: Tensor, duration: Tensor, before: Tensor) -> Tensor:
        """Compute the reports of cars that fail by a non-finite action, from those before."""
        cost = self._functions.compute_failure_cost(duration, tick)
        report = before.clone()
        report[REPORT.cost], report[REPORT.reward], report[REPORT.packets] = cost, -cost, 0.0
        report[REPORT.failure] = BAD_ACTION
        return report


class TorchReset:
    """Tick 0 on tensors as `reset_vehicle` makes it, with gradients to motion and parameters.

    A path that a driver follows stays where the reset put it.

    Args:
        step: Env-steps of the cars.
    """

    def __init__(self, step: TorchStep) -> None:
        self._step = step
        self._functions = to_torch(
            step.dtype, make_step_params, read, draw_normals, draw_first_drift,
            compute_target_angle, compute_first_row, compute_reference, compute_sideslip_angle,
        )  # fmt: skip

    def __call__(self, p: Tensor, keys: Tensor, state: TorchState) -> _Stepped:
        """Compute (state, outcome) at tick 0 from the state that a reset left."""
        kind, functions = self._step.kind, self._functions
        params, zero = functions.make_step_params(p), torch.zeros_like(state.tick)
        motion, steer = Motion(*state.motion.unbind(0)), state.driver
        if kind.has_driver:
            limits = params.road, params.target, params.driver, params.task.stop
            steer = functions.compute_target_angle(motion, params.path, *limits)
        drive = torch.stack(ActuatorState(*state.drive.unbind(0))._replace(delta_f=steer))
        channels = CHANNELS.inertial, CHANNELS.wheels, CHANNELS.errors
        n = [functions.draw_normals(keys[0], keys[1], 0, channel) for channel in channels]
        draws, errors = NormalDraws(n[0], n[1], n[2][0]), ErrorState(*state.errors.unbind(0))
        row = functions.compute_first_row(motion, steer, params, draws, errors, kind)
        row = [zero + number for number in row]
        v, command = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right]), row[FAST.steer_command]
        refs = torch.stack(functions.compute_reference(command, v, params.target, kind.reference))
        all_cars = torch.ones_like(state.over)
        beta = functions.compute_sideslip_angle(motion.v_x, motion.v_y, kind.small_angle)
        started = state._replace(drive=drive, driver=steer, refs=refs)
        shown = torch.stack(_InfoValues(beta, refs[0], refs[1], steer, zero))
        tick_state = _make_tick_state(started, all_cars)._replace(shown=shown)
        empty_queue = torch.full_like(state.queue, NEVER)
        # as if a step of one tick had led here from tick -1: its window holds tick 0 alone
        previous = state._replace(
            tick=state.tick - 1.0, slow=self._rewind_sensors(p, keys, state.slow), queue=empty_queue
        )
        rows = torch.stack(row).expand(self._step.n, -1, -1)  # tick 0 stands for every sample
        result: _Stepped = self._step.finish_step(
            p, keys, previous, _Ticked(tick_state, rows, state.motion[None], all_cars, ~all_cars)
        )
        return result

    def _rewind_sensors(self, p: Tensor, keys: Tensor, slow: Tensor) -> Tensor:
        """Compute the slow sensors' state before tick 0 from that after it."""
        functions, sensors, rewound = self._functions, list(self._step.sensors), slow.clone()
        rewound[sensors] = 0.0
        for i in sensors:
            elapsed = slow[i, SLOW_STATE.frames] * functions.read(p, P.slow[i]).period
            rewound[i, SLOW_STATE.next_capture] = slow[i, SLOW_STATE.next_capture] - elapsed
            rewound[i, SLOW_STATE.captured] = NEVER
            drift = functions.draw_first_drift(i, functions.read(p, P.sky), *keys)
            rewound[i, SLOW_STATE.drift] = drift
        return rewound


def _make_tick_state(state: TorchState, alive: Tensor) -> _TickState:
    """Make the state of cars at the start of an env-step."""
    n_shown = len(_InfoValues._fields)
    zeros = state.tick.new_zeros((1 + n_shown + FAST_WIDTH, len(state.tick)))
    # no tensor stands twice: torch.compile would compile the first tick and the others apart
    shown, row = zeros[1 : 1 + n_shown], zeros[1 + n_shown :]
    return _TickState(alive, state, zeros[0], shown, row, state.motion.clone())
