"""The slow sensors of an env-step on tensors: captures, packets under way, deliveries.

A row's packets lie in the order of their arrival, (arrived, captured, sensor), those under way
first and nothing behind them. An env-step puts the new ones to them, puts all in order, and takes
off the front what has arrived.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ..backend.arrays import read
from ..backend.on_torch import on_tensors, torch
from ..backend.primitives import select
from ..engine.layout import IN_SLOW, SLOW_WIDTH, P, Z
from ..engine.packets import FAR, scene_of
from ..record import PACKET, PACKET_WIDTH
from ..sensors.link import Link, arrivals, most_under_way
from ..sensors.slow import BLOCKS, SEES, VALUES, sample
from ..ticks import NEVER
from ..vehicle.dynamics import Motion

Tensor = torch.Tensor
_LATE = 1 << 62  # the place of what never arrives


class SlowState(NamedTuple):
    """The slow sensors' part of the rows' state."""

    slow: Tensor  # (sensors, SLOW_WIDTH, N)
    queue: Tensor  # (capacity, PACKET_WIDTH, N), by arrival


class Delivered(NamedTuple):
    """The packets that arrived in an env-step."""

    packets: Tensor  # (most, PACKET_WIDTH, N)
    number: Tensor  # (N,), how many of them are there


class Window(NamedTuple):
    """The ticks of an env-step: after `first`, up to `last`, (N,) each."""

    first: Tensor
    last: Tensor
    running: Tensor  # rows that were stepped
    track: Tensor  # (n, len(Motion), N), where the car was at each tick


class Capacity(NamedTuple):
    """The most packets of a sensor."""

    frames: int  # captured in an env-step
    under_way: int  # packets at once
    copies: int  # of a packet


def capacity_of(links: Sequence[Link], n: int) -> Capacity:
    """The capacity for sensors with any of these links in an env-step of n ticks."""
    return Capacity(
        max(-int(-n // link.period) for link in links),
        max(most_under_way(link) for link in links),
        2 if any(link.duplicate > 0.0 for link in links) else 1,
    )


class SlowSensors:
    """The slow sensors of a batch: those present, each with its capacity."""

    def __init__(self, most: dict[int, Capacity], small_angle: int, dtype: torch.dtype) -> None:
        self.most, self._small_angle = most, small_angle
        self._sample, self._scene_of, self._arrivals, self._read, self._select = on_tensors(
            dtype, sample, scene_of, arrivals, read, select
        )

    def __call__(
        self, p: Tensor, keys: Tensor, state: SlowState, window: Window
    ) -> tuple[SlowState, Delivered]:
        """The slow sensors' state after an env-step, and what arrived in it."""
        sensors = [list(each.unbind(0)) for each in state.slow.unbind(0)]
        new: list[Tensor] = []
        for sensor, most in self.most.items():
            for _ in range(most.frames):
                sensors[sensor], packets = self._capture(sensor, p, keys, sensors[sensor], window)
                new += packets
        queue = in_order(torch.cat([state.queue, torch.stack(new)]))
        arrived = queue[:, PACKET.arrived]
        due = (arrived != NEVER) & (arrived <= window.last) & window.running
        count = due.sum(0)
        slow = self._newest(sensors, queue, due)
        left = taken_off(queue, count)[: len(state.queue)]
        return SlowState(slow, left), Delivered(queue, count)

    def _capture(
        self, sensor: int, p: Tensor, keys: Tensor, slow: Sequence[Tensor], window: Window
    ) -> tuple[list[Tensor], list[Tensor]]:
        """The next frame of a sensor where it falls into the window: (the sensor's state then, its
        packets, of which those that are none never arrive)."""
        pick = self._select
        frame, tick = slow[IN_SLOW.frames], slow[IN_SLOW.next_capture]
        active = window.running & (tick > window.first) & (tick <= window.last)
        when = tick.to(torch.int64)
        j = (when - window.first.to(torch.int64) - 1).clamp(0, len(window.track) - 1)
        width = window.track.shape[1]
        place = j.expand(1, width, -1)
        motion = Motion(*window.track.gather(0, place)[0].unbind(0))
        link = self._read(p, P.slow[sensor])
        scene = self._scene_of(p, motion, self._small_angle, keys, tick)
        values, quality, drift = self._sample(sensor, scene, link, slow[IN_SLOW.drift])
        sent = [
            each if isinstance(each, Tensor) else torch.full_like(tick, each)
            for each in (quality, frame, *values)
        ]
        packets = []
        both = self._arrivals(link, frame, tick, keys[0], keys[1], BLOCKS[sensor].link)
        for arrived in both[: self.most[sensor].copies]:
            due = pick(active, arrived, NEVER)
            packets.append(torch.stack((torch.full_like(tick, sensor), tick, due, *sent)))
        after = list(slow)
        after[IN_SLOW.frames] = pick(active, frame + 1.0, frame)
        after[IN_SLOW.next_capture] = pick(active, tick + link.period, tick)
        after[IN_SLOW.drift] = pick(active, drift, slow[IN_SLOW.drift])
        return after, packets

    def _newest(self, sensors: list[list[Tensor]], queue: Tensor, due: Tensor) -> Tensor:
        """The sensors' state, as in `SlowState`, once the due packets were looked at in order."""
        pick = self._select
        for i in range(len(queue)):
            packet = queue[i].unbind(0)
            for sensor in self.most:
                slow = sensors[sensor]
                better = due[i] & (packet[PACKET.sensor] == sensor)
                better = better & (packet[PACKET.captured] > slow[IN_SLOW.captured])
                if SEES[sensor]:
                    better = better & (packet[PACKET.quality] > 0.0)
                newest = (
                    packet[PACKET.captured],
                    *packet[PACKET.value : PACKET.value + VALUES],
                    packet[PACKET.arrived],
                )
                for k, value in enumerate(newest, IN_SLOW.captured):
                    slow[k] = pick(better, value, slow[k])
        return torch.stack([torch.stack(each) for each in sensors])


def in_order(queue: Tensor) -> Tensor:
    """Packets (count, PACKET_WIDTH, N) by (arrived, captured, sensor), those that never arrive
    last."""
    whole = queue[:, :3].to(torch.int64)
    arrived = whole[:, PACKET.arrived]
    key = (arrived << 32) + len(Z.slow) * whole[:, PACKET.captured] + whole[:, PACKET.sensor]
    key = torch.where(queue[:, PACKET.arrived] == NEVER, _LATE, key)
    place = torch.arange(len(queue), device=queue.device)[:, None]
    mine, other = key[:, None], key[None]
    ahead = (other < mine) | ((other == mine) & (place[None] < place[:, None]))
    rank = ahead.sum(1)
    order = torch.empty_like(rank).scatter_(0, rank, place.expand_as(rank))
    return queue.gather(0, order[:, None].expand(-1, PACKET_WIDTH, -1))


def taken_off(queue: Tensor, count: Tensor) -> Tensor:
    """The rest of packets in order, (capacity, PACKET_WIDTH, N), without the first `count` (N,)."""
    place = torch.arange(len(queue), device=queue.device)[:, None] + count
    gone = place >= len(queue)
    place = place.clamp(max=len(queue) - 1)
    left = queue.gather(0, place[:, None].expand(-1, PACKET_WIDTH, -1))
    before, after = left[:, : PACKET.arrived], left[:, PACKET.arrived + 1 :]
    arrived = left[:, PACKET.arrived].masked_fill(gone, NEVER)
    return torch.cat((before, arrived[:, None], after), 1)


def read_packed(states: Tensor, capacity: int) -> SlowState:
    """The slow sensors' part of packed states (STATE_WIDTH, N); ValueError where they hold more
    than `capacity` packets."""
    if bool((states[Z.under_way] > capacity).any()):
        raise ValueError(f"a state has more than {capacity} packets under way")
    slow = states[Z.slow[0].frames : Z.queue].reshape(len(Z.slow), SLOW_WIDTH, -1)
    queue = states[Z.queue : Z.driver].reshape(-1, PACKET_WIDTH, states.shape[1])[:capacity].clone()
    place = torch.arange(capacity, device=queue.device)[:, None]
    queue[:, PACKET.arrived].masked_fill_(place >= states[Z.under_way], NEVER)
    return SlowState(slow.clone(), in_order(queue))


def write_packed(state: SlowState, states: Tensor) -> None:
    """Write the slow sensors' part into packed states (STATE_WIDTH, N)."""
    count = states.shape[1]
    states[Z.slow[0].frames : Z.queue] = state.slow.reshape(-1, count)
    states[Z.queue : Z.driver] = 0.0
    flat = state.queue.reshape(-1, count)
    states[Z.queue : Z.queue + len(flat)] = flat
    arrived = state.queue[:, PACKET.arrived]
    states[Z.under_way] = (arrived != NEVER).sum(0).to(states.dtype)
    states[Z.clock.next_due] = torch.where(arrived[0] == NEVER, FAR, arrived[0])
