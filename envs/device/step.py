"""One env-step of all rows on tensors, from their state to the next and what they tell: a pure
function that never waits for the device."""

from typing import Any, NamedTuple

from ..backend.elementary import clip
from ..backend.on_torch import compiled, on_tensors, torch
from ..backend.primitives import select
from ..engine.layout import P
from ..engine.tick import Kind
from ..record import Array
from ..task.failures import BAD_ACTION, RUNNING
from ..task.info import REPORT
from .observe import Telling
from .packets import Most, SlowSensors, Under, Window
from .ticks import Now, Ticks, start_of

Tensor = torch.Tensor


class Held(NamedTuple):
    """What an env-step changes of the rows' state; the rows are the last axis."""

    motion: Tensor  # (len(Motion), N)
    drive: Tensor  # (len(Drive), N)
    driver: Tensor  # (N,)
    tick: Tensor
    failure: Tensor
    slow: Tensor  # the fields of `Under`
    queue: Tensor
    over: Tensor  # (N,) of bool
    report: Tensor  # (len(Report), N)

    @property
    def under(self) -> Under:
        """The slow sensors' part."""
        return Under(self.slow, self.queue)


class Brought(NamedTuple):
    """What an env-step brings."""

    obs: Tensor  # (N, k), float32; zeros where the row had no tick
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

    kind: what chooses the plant's text. most: the slow sensors present and their room. compile:
    through `torch.compile`.
    """

    def __init__(
        self,
        kind: Kind,
        n: int,
        most: dict[int, Most],
        all_samples: bool,
        bounds: Array,
        dtype: torch.dtype,
        device: torch.device,
        compile: bool,
    ) -> None:
        self._n = n
        self._ticks = Ticks(kind, dtype, compile)
        self._slow = SlowSensors(most, kind.small_angle, dtype)
        told = torch.as_tensor(bounds, dtype=dtype, device=device)
        self._telling = Telling(tuple(most), all_samples, told, dtype)
        self._clip, self._select = on_tensors(dtype, clip, select)
        self._conclude: Any = compiled(self._concluded) if compile else self._concluded

    def __call__(
        self, p: Tensor, keys: Tensor, held: Held, actions: Tensor
    ) -> tuple[Held, Brought]:
        """(the state after it, what it brings) of one env-step.

        p: (PARAMS_WIDTH, N). keys: (2, N), int64. actions: (N, width), of the floats of p; rows
        whose action is not finite fail. Rows that are over stand still.
        """
        finite = torch.isfinite(actions).all(1)
        shares = self._clip(torch.where(finite[:, None], actions, 0.0), -1.0, 1.0)
        turn = shares[:, 1] if actions.shape[1] > 1 else torch.zeros_like(held.tick)
        running = finite & ~held.over
        start = start_of(held.motion, held.drive, held.driver, held.tick, running)
        now, rows, track = self._ticks.drive_on(p, keys, start, shares[:, 0], turn, self._n)
        refused = ~finite & ~held.over
        after: Held
        after, brought = self._conclude(p, keys, held, now, rows, track, running, refused)
        return after, brought

    def _concluded(
        self,
        p: Tensor,
        keys: Tensor,
        held: Held,
        now: Now,
        rows: Tensor,
        track: Tensor,
        running: Tensor,
        refused: Tensor,
    ) -> tuple[Held, Brought]:
        done, duration = now.tick - held.tick, p[P.task.duration]
        window = Window(held.tick, now.tick, running, track)
        under, came = self._slow(p, keys, held.under, window)
        obs = self._telling.observe(rows, done, now, under.slow, came)
        obs = torch.where(running[:, None], obs, 0.0)
        told = self._telling.report(now, duration, came.number)
        report = torch.where(running, told, held.report)
        refusal = self._telling.refusal(now, duration, held.report)
        report = torch.where(refused, refusal, report)
        failure = self._select(running, now.failure, held.failure)
        failure = self._select(refused, BAD_ACTION * 1.0, failure)
        stepped = ~held.over
        terminated = stepped & (failure != RUNNING)
        truncated = running & (report[REPORT.ended] == 1.0) & ~terminated
        after = Held(
            torch.stack(now.motion),
            torch.stack(now.drive),
            now.driver,
            now.tick,
            failure,
            *under,
            terminated | truncated,
            report,
        )
        rewards = torch.where(stepped, -report[REPORT.cost], 0.0)
        return after, Brought(
            obs,
            rewards,
            terminated,
            truncated,
            refused,
            rows,
            came.packets,
            done.to(torch.int64),
            came.number,
        )
