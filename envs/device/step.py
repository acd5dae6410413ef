"""One env-step of all rows on tensors, from state to state, observation and report: a pure function
that never waits for the device."""

from typing import Any, NamedTuple

from ..backend.elementary import clip
from ..backend.on_torch import compiled, on_tensors, torch
from ..backend.primitives import select
from ..engine.layout import P, Switches
from ..engine.tick import Kind
from ..record import Array
from ..task.failures import BAD_ACTION, NOT_FINITE, RUNNING
from ..task.info import REPORT
from .gradient import Gate
from .observe import Observer
from .packets import Capacity, SlowSensors, SlowState, Window
from .ticks import Now, Ticks, start_of

Tensor = torch.Tensor


class State(NamedTuple):
    """The state of the rows that an env-step changes; the rows are the last axis."""

    motion: Tensor  # (len(Motion), N)
    drive: Tensor  # (len(Drive), N)
    driver: Tensor  # (N,)
    refs: Tensor  # (2, N)
    lead: Tensor  # (len(Lead), N)
    tick: Tensor
    failure: Tensor
    slow: Tensor  # the fields of `SlowState`
    queue: Tensor
    over: Tensor  # (N,) of bool
    report: Tensor  # (len(Report), N)

    @property
    def slow_state(self) -> SlowState:
        """The slow sensors' part."""
        return SlowState(self.slow, self.queue)


class Outcome(NamedTuple):
    """The outcome of an env-step."""

    obs: Tensor  # (N, k); zeros where the row had no tick
    rewards: Tensor  # (N,)
    terminated: Tensor
    truncated: Tensor
    refused: Tensor  # (N,), the action is not finite and counts
    rows: Tensor  # (n, FAST_WIDTH, N)
    packets: Tensor  # (most, PACKET_WIDTH, N)
    done: Tensor  # (N,), how many ticks and packets there are, int64
    delivered: Tensor


class Step:
    """The env-steps of rows of one kind.

    kind: what chooses the plant's text. most: the slow sensors present, each with its
    capacity. obs_dtype: of the observations. compile: through `torch.compile`.
    """

    def __init__(
        self,
        kind: Kind,
        n: int,
        most: dict[int, Capacity],
        switches: Switches,
        bounds: Array,
        dtype: torch.dtype,
        obs_dtype: torch.dtype,
        device: torch.device,
        compile: bool,
    ) -> None:
        self.kind, self.n, self.dtype = kind, n, dtype
        self._ticks = Ticks(kind, dtype, compile)
        self._slow = SlowSensors(most, kind.small_angle, dtype)
        limits = torch.as_tensor(bounds, dtype=dtype, device=device)
        self._observer = Observer(tuple(most), switches, limits, dtype, obs_dtype)
        self._clip, self._select = on_tensors(dtype, clip, select)
        self.conclude: Any = compiled(self._concluded) if compile else self._concluded

    def __call__(
        self, p: Tensor, keys: Tensor, state: State, actions: Tensor
    ) -> tuple[State, Outcome]:
        """(the state after one env-step, its outcome).

        p: (PARAMS_WIDTH, N). keys: (2, N), int64. actions: (N, width), of the floats of p; rows
        whose action is not finite fail. Rows that are over stand still.
        """
        finite = torch.isfinite(actions).all(1)
        gate = Gate()
        p, state = gate(p), State(*map(gate, state))
        shares = self._clip(torch.where(finite[:, None], actions, 0.0), -1.0, 1.0)
        share, *turns = map(gate, shares.unbind(1))
        turn = turns[0] if turns else torch.zeros_like(state.tick)
        running = finite & ~state.over
        where = state.motion, state.drive, state.driver, state.refs, state.lead, state.tick
        start = start_of(*where, running)
        now, rows, track = self._ticks.drive_on(p, keys, start, share, turn, self.n)
        refused = ~finite & ~state.over
        after: State
        after, outcome = self.conclude(p, keys, state, now, rows, track, running, refused)
        gate.open = after.failure != NOT_FINITE
        return after, outcome

    def _concluded(
        self,
        p: Tensor,
        keys: Tensor,
        state: State,
        now: Now,
        rows: Tensor,
        track: Tensor,
        running: Tensor,
        refused: Tensor,
    ) -> tuple[State, Outcome]:
        done, duration = now.tick - state.tick, p[P.task.duration]
        window = Window(state.tick, now.tick, running, track)
        slow_state, delivered = self._slow(p, keys, state.slow_state, window)
        obs = self._observer.observe(rows, done, now, slow_state.slow, delivered)
        obs = torch.where(running[:, None], obs, 0.0)
        report = self._observer.report(now, duration, delivered.number)
        report = torch.where(running, report, state.report)
        refusal = self._observer.refusal(now, duration, state.report)
        report = torch.where(refused, refusal, report)
        failure = self._select(running, now.failure, state.failure)
        failure = self._select(refused, BAD_ACTION * 1.0, failure)
        stepped = ~state.over
        terminated = stepped & (failure != RUNNING)
        truncated = running & (report[REPORT.ended] == 1.0) & ~terminated
        after = State(
            torch.stack(now.motion),
            torch.stack(now.drive),
            now.driver,
            torch.stack(now.refs),
            torch.stack(now.lead),
            now.tick,
            failure,
            *slow_state,
            terminated | truncated,
            report,
        )
        rewards = torch.where(stepped, -report[REPORT.cost], 0.0)
        return after, Outcome(
            obs,
            rewards,
            terminated,
            truncated,
            refused,
            rows,
            delivered.packets,
            done.to(torch.int64),
            delivered.number,
        )
