"""The ticks of an env-step on tensors: the text of `advance` for all rows, each frozen where its
episode ends.

A row that fails or whose time is over stands still from then on while the others drive on: nothing
branches on values, so the device never waits for the host.
"""

from typing import Any, NamedTuple

from ..backend.on_torch import compiled, on_tensors, torch
from ..backend.primitives import select
from ..backend.random import CHANNELS, normals
from ..engine.layout import Drive, P
from ..engine.step import fixed_of
from ..engine.tick import Kind, Moving, advance, changed
from ..engine.window import judge
from ..record import FAST_WIDTH
from ..scenarios.roads import Lead
from ..scenarios.steering import steering_at
from ..sensors.inertial import Chance
from ..task.failures import RUNNING, failure_of
from ..ticks import TICK
from ..vehicle.dynamics import Motion

Tensor = torch.Tensor
Numbers = tuple[Tensor, ...]


class Shown(NamedTuple):
    """Numbers of `info` from the last tick of a row; (N,) each."""

    beta: Any
    beta_ref: Any
    gamma_ref: Any
    steer: Any
    moment: Any


class Now(NamedTuple):
    """Where the rows are within an env-step; (N,) each, or tuples of such."""

    alive: Tensor  # not frozen yet
    motion: Numbers
    drive: Numbers
    driver: Tensor
    refs: Numbers
    lead: Numbers
    tick: Tensor
    failure: Tensor  # codes as floats
    cost: Tensor
    shown: Numbers
    row: Numbers  # the newest fast row
    track: Numbers  # the newest motion, fit for `info` or not


class Ticks:
    """The ticks of rows of one kind. compile: a tick, and the chances of all ticks, are one call of
    `torch.compile` each."""

    def __init__(self, kind: Kind, dtype: torch.dtype, compile: bool) -> None:
        self.kind = kind
        self._normals, self._steering_at = on_tensors(dtype, normals, steering_at)
        self._fixed, self._advance, self._changed = on_tensors(dtype, fixed_of, advance, changed)
        self._failure_of, self._select = on_tensors(dtype, failure_of, select)
        (self._judge,) = on_tensors(dtype, judge)
        self._dtype = dtype
        self.tick: Any = compiled(self._tick) if compile else self._tick
        self.foresee: Any = compiled(self._foresee) if compile else self._foresee

    def _foresee(self, p: Tensor, keys: Tensor, first: Tensor, n: int) -> tuple[Numbers, Any]:
        """(eight normal numbers, the programme's steering) of n ticks from `first` on, (n, N)."""
        ticks = first + torch.arange(n, device=first.device)[:, None]
        whole = ticks.to(torch.int64)
        inertial = self._normals(keys[0], keys[1], whole, CHANNELS.inertial)
        wheels = self._normals(keys[0], keys[1], whole, CHANNELS.wheels)
        if self.kind.follows:
            return inertial + wheels, None
        programme = p[P.programme[0] :]
        return inertial + wheels, self._steering_at(ticks.to(self._dtype), programme)

    def _tick(
        self, p: Tensor, share: Tensor, turn: Tensor, now: Now, chance: Numbers, ahead: Any
    ) -> Now:
        """One tick of the rows that are alive.

        p: (PARAMS_WIDTH, N). share, turn: (N,), of the yaw moment and the added steering.
        """
        pick = self._select
        fixed = self._fixed(p)
        task = fixed.task
        car = self._changed(fixed.car, fixed.change, now.tick > fixed.change.tick)
        # the load at the tick's start is computed anew where `anywhere` holds, and here it does
        motion, drive, lead = Motion(*now.motion), Drive(*now.drive), Lead(*now.lead)
        before = Moving(motion, drive, None, now.driver, car, now.refs, lead)
        after, seen = self._advance(
            fixed,
            share * task.yaw_scale,
            turn * task.authority,
            before,
            now.tick,
            Chance(chance[:4], chance[4:]),
            ahead,
            self.kind,
        )
        alive, fit = now.alive, now.alive & ~seen.lost
        tick = now.tick + alive
        found = self._judge(after.motion, seen.past, task, fixed.path, self.kind)
        failure = self._failure_of(seen.lost, found.spun, found.off)
        refs = [pick(seen.lost, 0.0, each) for each in seen.refs]
        shown = (pick(seen.lost, 0.0, found.beta), *refs, seen.steer, seen.moment)

        def chosen(where: Tensor, new: Any, old: Any) -> Numbers:
            return tuple(pick(where, a, b) for a, b in zip(new, old, strict=True))

        return Now(
            alive & (failure == RUNNING) & (tick < task.duration),
            chosen(fit, after.motion, now.motion),
            chosen(alive, after.drive, now.drive),
            pick(alive, after.driver, now.driver),
            chosen(alive, refs, now.refs),
            chosen(alive, after.lead, now.lead),
            tick,
            pick(alive, failure, now.failure),
            now.cost + pick(alive, found.cost * TICK, 0.0),
            chosen(alive, shown, now.shown),
            chosen(alive, seen.row, now.row),
            chosen(alive, after.motion, now.track),
        )

    def drive_on(
        self, p: Tensor, keys: Tensor, start: Now, share: Tensor, turn: Tensor, n: int
    ) -> tuple[Now, Tensor, Tensor]:
        """n ticks, fewer for rows that fail or end: (where they are then, the fast rows, the
        motions), of the latter (n, width, N); a row's last ones stand for those it does not have.
        """
        chances, ahead = self.foresee(p, keys, start.tick + 1, n)
        now, rows, track = start, [], []
        for j in range(n):
            chance = tuple(each[j] for each in chances)
            now = self.tick(p, share, turn, now, chance, None if ahead is None else ahead[j])
            rows.append(torch.stack(now.row))
            track.append(torch.stack(now.track))
        return now, torch.stack(rows), torch.stack(track)


def start_of(
    motion: Tensor,
    drive: Tensor,
    driver: Tensor,
    refs: Tensor,
    lead: Tensor,
    tick: Tensor,
    alive: Tensor,
) -> Now:
    """Where rows are at the start of an env-step."""
    zeros = tick.new_zeros((2 + len(Shown._fields) + FAST_WIDTH, len(tick)))
    failure, cost, *others = zeros.unbind(0)
    shown, row = others[: len(Shown._fields)], others[len(Shown._fields) :]
    # no tensor stands twice: torch.compile would compile the first tick and the others apart
    return Now(
        alive,
        motion.unbind(0),
        drive.unbind(0),
        driver,
        refs.unbind(0),
        lead.unbind(0),
        tick,
        failure,
        cost,
        tuple(shown),
        tuple(row),
        motion.unbind(0),
    )
