"""The observation and the report of an env-step, on tensors."""

from typing import Any

from ..backend.elementary import clip
from ..backend.on_torch import on_tensors, torch
from ..backend.primitives import select
from ..engine.layout import IN_SLOW, Switches
from ..record import FAST, PACKET
from ..sensors.slow import WIDTHS
from ..task.cost import rest_of_cost
from ..task.failures import BAD_ACTION, RUNNING
from ..task.info import Report
from ..task.observation import AGE_CAP, SAMPLED
from ..ticks import NEVER, TICK
from .packets import Delivered
from .ticks import Now, Shown

Tensor = torch.Tensor


class Observer:
    """Observations and reports of a batch.

    sensors: the slow ones present. bounds: (2, k), of the observation's entries. obs_dtype: of the
    observations.
    """

    def __init__(
        self,
        sensors: tuple[int, ...],
        switches: Switches,
        bounds: Tensor,
        dtype: torch.dtype,
        obs_dtype: torch.dtype,
    ) -> None:
        self._obs_dtype = obs_dtype
        self._sensors, self._switches = sensors, switches
        self._bounds = bounds[:, :, None]
        self._clip, self._select, self._rest_of_cost = on_tensors(dtype, clip, select, rest_of_cost)

    def observe(
        self, rows: Tensor, done: Tensor, now: Now, slow: Tensor, delivered: Delivered
    ) -> Tensor:
        """The summary (N, k).

        rows: (n, FAST_WIDTH, N), of which the first `done` (N,) count. slow: as in `Under`.
        """
        entries: list[Tensor] = []
        sampled = rows[:, :SAMPLED]
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
        for sensor in self._sensors:
            entries += self._sensor(sensor, now.tick, slow[sensor], delivered)
        shown = Shown(*now.shown)
        entries += [shown.beta_ref, shown.gamma_ref]
        low, high = self._bounds.unbind(0)
        clipped: Tensor = self._clip(torch.stack(entries), low, high)
        return clipped.T.to(self._obs_dtype).contiguous()

    def _sensor(
        self, sensor: int, tick: Tensor, slow: Tensor, delivered: Delivered
    ) -> list[Tensor]:
        """Values, age and freshness of one sensor's newest sample."""
        captured = slow[IN_SLOW.captured]
        age = self._select(captured != NEVER, (tick - captured) * TICK, AGE_CAP)
        packets = delivered.packets
        place = torch.arange(len(packets), device=tick.device)[:, None]
        newest = packets[:, PACKET.arrived] == slow[IN_SLOW.arrived]  # neither late nor a duplicate
        fresh = (place < delivered.number) & (packets[:, PACKET.sensor] == sensor) & newest
        values = [slow[i] for i in IN_SLOW.values[: WIDTHS[sensor]]]
        return [*values, age, fresh.any(0).to(tick.dtype)]

    def report(self, now: Now, duration: Tensor, count: Tensor) -> Tensor:
        """The reports (len(Report), N) of rows that were stepped."""
        rest = self._rest_of_cost(duration, now.tick)
        cost = now.cost + self._select(now.failure != RUNNING, rest, 0.0)
        shown = Shown(*now.shown)
        named = {
            "t": now.tick * TICK,
            "beta": shown.beta,
            "gamma": now.motion[2],
            "psi": now.motion[3],
            "beta_ref": shown.beta_ref,
            "gamma_ref": shown.gamma_ref,
            "steer": shown.steer,
            "yaw_moment": shown.moment,
            "cost": cost,
            "failure": now.failure,
            "packets": count.to(cost.dtype),
            "reward": -cost,
            "ended": (now.tick >= duration).to(cost.dtype),
        }
        return torch.stack([named[name] for name in Report._fields])

    def refusal(self, now: Now, duration: Tensor, before: Tensor) -> Tensor:
        """The reports of rows that an action which is not finite fails; the rest stays."""
        cost = self._rest_of_cost(duration, now.tick)
        named = dict(zip(Report._fields, before.unbind(0), strict=True))
        named |= {
            "cost": cost,
            "failure": torch.full_like(cost, BAD_ACTION),
            "packets": torch.zeros_like(cost),
            "reward": -cost,
        }
        return torch.stack([named[name] for name in Report._fields])
