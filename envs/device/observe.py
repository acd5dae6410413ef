"""The observation and the report of an env-step, on tensors."""

from typing import Any

from ..backend.elementary import clip
from ..backend.on_torch import to_torch, torch
from ..backend.primitives import select
from ..engine.layout import SLOW_STATE, Switches
from ..record import FAST, PACKET
from ..sensors.slow import WIDTHS
from ..task.cost import compute_failure_cost
from ..task.failures import BAD_ACTION, RUNNING
from ..task.info import StepReport
from ..task.observation import AGE_CAP, N_SAMPLED
from ..ticks import NEVER, TICK
from .packets import Delivered
from .ticks import InfoValues, TickState

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
        self._clip, self._select, self._compute_failure_cost = to_torch(
            dtype, clip, select, compute_failure_cost
        )

    def observe(
        self, rows: Tensor, done: Tensor, tick_state: TickState, slow: Tensor, delivered: Delivered
    ) -> Tensor:
        """The summary (N, k).

        rows: (n, FAST_WIDTH, N), of which the first `done` (N,) count. slow: as in `Under`.
        """
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
        for sensor in self._sensors:
            entries += self._read_sensor(sensor, tick_state.tick, slow[sensor], delivered)
        info_values = InfoValues(*tick_state.shown)
        entries += [info_values.beta_ref, info_values.gamma_ref]
        low, high = self._bounds.unbind(0)
        clipped: Tensor = self._clip(torch.stack(entries), low, high)
        return clipped.T.to(self._obs_dtype).contiguous()

    def _read_sensor(
        self, sensor: int, tick: Tensor, slow: Tensor, delivered: Delivered
    ) -> list[Tensor]:
        """Values, age and freshness of one sensor's newest sample."""
        captured = slow[SLOW_STATE.captured]
        age = self._select(captured != NEVER, (tick - captured) * TICK, AGE_CAP)
        packets = delivered.packets
        place = torch.arange(len(packets), device=tick.device)[:, None]
        is_newest = (
            packets[:, PACKET.arrived] == slow[SLOW_STATE.arrived]
        )  # neither late nor a duplicate
        is_fresh = (place < delivered.number) & (packets[:, PACKET.sensor] == sensor) & is_newest
        values = [slow[i] for i in SLOW_STATE.values[: WIDTHS[sensor]]]
        return [*values, age, is_fresh.any(0).to(tick.dtype)]

    def report(self, tick_state: TickState, duration: Tensor, count: Tensor) -> Tensor:
        """The reports (len(Report), N) of rows that were stepped."""
        failure_cost = self._compute_failure_cost(duration, tick_state.tick)
        cost = tick_state.cost + self._select(tick_state.failure != RUNNING, failure_cost, 0.0)
        info_values = InfoValues(*tick_state.shown)
        values = {
            "t": tick_state.tick * TICK,
            "beta": info_values.beta,
            "gamma": tick_state.motion[2],
            "psi": tick_state.motion[3],
            "beta_ref": info_values.beta_ref,
            "gamma_ref": info_values.gamma_ref,
            "steer": info_values.steer,
            "yaw_moment": info_values.moment,
            "cost": cost,
            "failure": tick_state.failure,
            "packets": count.to(cost.dtype),
            "reward": -cost,
            "ended": (tick_state.tick >= duration).to(cost.dtype),
        }
        return torch.stack([values[name] for name in StepReport._fields])

    def report_refusal(self, tick_state: TickState, duration: Tensor, before: Tensor) -> Tensor:
        """The reports of rows that an action which is not finite fails; the rest stays."""
        cost = self._compute_failure_cost(duration, tick_state.tick)
        values = dict(zip(StepReport._fields, before.unbind(0), strict=True))
        values |= {
            "cost": cost,
            "failure": torch.full_like(cost, BAD_ACTION),
            "packets": torch.zeros_like(cost),
            "reward": -cost,
        }
        return torch.stack([values[name] for name in StepReport._fields])
